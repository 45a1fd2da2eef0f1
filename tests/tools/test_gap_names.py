"""The comparison of answers before and after a change sees every bit."""

import copy
import io
import json
import math

from rich.console import Console

from tools.gap import names as gap_names
from tools.gap.names import compare, differences, fixed_jobs

RESULT = {"log": "abc", "names": ["motor_lag"], "report": {"effects": [{"value": 0.1, "ci": [math.nan, 1.0]}]}}


def compared(after):
    console = Console(record=True, file=io.StringIO(), width=300)
    return compare({"one": RESULT}, {"one": after}, console), console.export_text()


def test_the_logs_are_sixty_of_every_kind():
    jobs = fixed_jobs()
    assert len({job.key for job in jobs}) == len(jobs) == 60
    assert [sum(job.kind == kind for job in jobs) for kind in ("single", "none", "pairs", "outside")] == [40, 10, 5, 5]
    assert {job.kind for job in jobs[:12]} == {"single", "none", "pairs", "outside"}


def test_equal_answers_are_equal_and_the_last_bit_is_not():
    equal, output = compared(json.loads(json.dumps(RESULT)))
    assert equal
    assert "other names in 0, equal to the last bit in 1" in output
    other = copy.deepcopy(RESULT)
    other["report"]["effects"][0]["value"] = math.nextafter(0.1, 1.0)
    equal, output = compared(other)
    assert not equal
    assert "report.effects[0].value: 0.1 -> 0.10000000000000002" in output
    assert "largest difference of two numbers: 1.4e-16" in output


def test_other_names_and_other_logs_are_said():
    equal, output = compared({**RESULT, "names": [], "log": "other"})
    assert not equal
    assert "other names in 1" in output
    assert "the logs themselves differ, so nothing follows for: one" in output


def test_what_is_missing_on_one_side_differs():
    assert list(differences({"a": [1], "b": 2}, {"a": [1, 2]})) == [("a", [1], [1, 2]), ("b", 2, None)]


def test_nothing_to_compare_is_not_equal():
    assert not compare({}, {"one": RESULT}, Console(quiet=True))


def test_a_log_that_was_searched_is_not_searched_again(tmp_path, monkeypatch):
    monkeypatch.setattr(gap_names, "find_gap", lambda *_, **__: 1 / 0)
    jobs = fixed_jobs()[:3]
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    for path in (before, after):
        path.write_text(json.dumps({job.key: RESULT for job in jobs}))
    assert gap_names.main([str(after), "--first", "3", "--compare", str(before)]) == 0
