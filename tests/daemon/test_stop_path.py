import pytest
from hypothesis import strategies as st

from disco_hw.daemon.process import StopPath
from tests.tables import examples

ERRORS = [None, RuntimeError("broken"), OSError(5, "unplugged"), SystemExit(3), KeyboardInterrupt(), RecursionError()]


@examples(quick=30, every=100, errors=st.lists(st.sampled_from(ERRORS), max_size=8))
def test_the_last_step_added_runs_first_and_each_once_whatever_the_others_raise(errors):
    done, path = [], StopPath()

    def step(number, error):
        done.append(number)
        if error is not None:
            raise error

    for number, error in enumerate(errors):
        path.add(str(number), lambda number=number, error=error: step(number, error))
    failed = path.run()
    assert done == list(range(len(errors)))[::-1]
    assert list(failed) == [str(number) for number in done if errors[number] is not None]
    assert path.run() == {}
    assert len(done) == len(errors)


@pytest.mark.parametrize(
    ("error", "expected"), [(OSError(5, "unplugged"), "OSError: [Errno 5] unplugged"), (SystemExit(3), "SystemExit: 3")]
)
def test_a_failure_is_reported_in_words(error, expected):
    def fail():
        raise error

    path = StopPath()
    path.add("wheels", fail)
    assert path.run() == {"wheels": expected}


def test_a_step_may_add_another():
    done = []
    path = StopPath()
    path.add("outer", lambda: path.add("inner", lambda: done.append("inner")))
    assert path.run() == {}
    assert done == ["inner"]
