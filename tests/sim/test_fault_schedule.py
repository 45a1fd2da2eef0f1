"""Schedules: read back as written, the same from the same seed, and refused in one line when wrong."""

from contextlib import contextmanager

import pytest
from hypothesis import strategies as st

from sim.fault_schedule import KINDS, FaultFileError, kinds_table, parse_schedule
from tests.tables import examples
from tools.faults.random_faults import random_schedule


@contextmanager
def one_line_at_most():
    """Nothing is raised but the one line for the user."""
    reported = ""
    try:
        yield
    except FaultFileError as error:
        reported = str(error)
    assert "\n" not in reported


def test_a_schedule_is_in_order_with_defaults_and_numbers():
    schedule = parse_schedule(
        'seed = 7\n[[fault]]\nkind = "unplug"\nat_s = 9\nfor_s = 0.5\n[[fault]]\nkind = "drop"\nat_s = 1.5\nfor_s = 2\n'
        'to = "host"\n[[fault]]\nkind = "brown_out"\nat_s = 3\n'
    )
    assert schedule.seed == 7
    assert [(f.number, f.kind.name, f.begin_ns, f.end_ns) for f in schedule.faults] == [
        (1, "drop", 1_500_000_000, 3_500_000_000),
        (2, "brown_out", 3_000_000_000, 3_000_000_000),
        (3, "unplug", 9_000_000_000, 9_500_000_000),
    ]
    assert dict(schedule.faults[0].values) == {"to": "host", "id": -1, "probability": 0.3}
    assert str(schedule.faults[0]) == "drop to=host id=-1 probability=0.3"


@examples(quick=30, every=100, seed=st.integers(0, 2**40), duration_s=st.floats(10, 300))
def test_a_seed_draws_the_same_faults_one_after_the_other(seed, duration_s):
    schedule = random_schedule(seed, duration_s)
    assert random_schedule(seed, duration_s) == schedule
    assert all(
        before.end_ns < after.begin_ns for before, after in zip(schedule.faults, schedule.faults[1:], strict=False)
    )


def test_all_kinds_are_drawn_in_time():
    assert {fault.kind.name for fault in random_schedule(1, 5000).faults} == set(KINDS)


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("fault = [", ["not TOML"]),
        ("seed = " + "1" * 5000, ["not TOML", "5000 digits"]),
        ("faults = 1", ["faults", "unknown"]),
        ("seed = -1", ["seed", "-1"]),
        ("seed = true", ["seed", "True"]),
        ("fault = 3", ["fault", "[[fault]]"]),
        ("fault = [3]", ["fault", "[[fault]]"]),
        ("[[fault]]\nat_s = 1", ["fault 1", "kind", "None"]),
        ("[[fault]]\nkind = []", ["fault 1", "kind"]),
        ('[[fault]]\nkind = "dorp"', ["fault 1", "dorp", "write one of drop"]),
        ('[[fault]]\nkind = "drop"\nfor_s = 1', ["drop", "at_s", "missing"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1', ["drop", "for_s", "missing"]),
        ('[[fault]]\nkind = "drop"\nat_s = nan\nfor_s = 1', ["at_s", "nan"]),
        ('[[fault]]\nkind = "drop"\nat_s = -1\nfor_s = 1', ["at_s", "-1"]),
        ('[[fault]]\nkind = "drop"\nat_s = true\nfor_s = 1', ["at_s", "True"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 1\nprobability = 2', ["probability", "2", "to 1"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 1\nto = "moon"', ["to", "moon", "robot, host, both"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 1\nto = [1]', ["to", "[1]"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 1\nid = 1.5', ["id", "1.5", "whole"]),
        ('[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 1\nspeed = 2', ["speed", "unknown", "at_s, for_s, to, id"]),
        ('[[fault]]\nkind = "brown_out"\nat_s = 1\nfor_s = 1', ["brown_out", "for_s", "unknown"]),
    ],
)
def test_a_wrong_schedule_gets_one_line(text, fragments):
    with pytest.raises(FaultFileError) as caught:
        parse_schedule(text, "faults.toml")
    message = str(caught.value)
    assert message.startswith("faults.toml: ")
    assert "\n" not in message
    assert all(fragment in message for fragment in fragments), message


@examples(quick=30, every=100, text=st.text(max_size=200) | st.binary(max_size=200).map(lambda b: b.decode("latin-1")))
def test_any_text_is_a_schedule_or_refused(text):
    with one_line_at_most():
        parse_schedule(text)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)


@examples(
    quick=30,
    every=100,
    kind=st.sampled_from(sorted(KINDS)),
    entry=st.dictionaries(st.sampled_from(["at_s", "for_s", "to", "id", "wheel"]), values),
)
def test_any_values_are_taken_or_refused(kind, entry):
    from sim.fault_schedule import _fault

    with one_line_at_most():
        fault = _fault({"kind": kind, **entry}, "here")
        assert 0 <= fault.begin_ns <= fault.end_ns


def test_every_kind_is_in_the_table():
    assert [line.split()[0] for line in kinds_table().splitlines()] == list(KINDS)
