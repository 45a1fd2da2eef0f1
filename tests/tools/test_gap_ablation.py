"""Every threshold of the gap at half and at double, and every rule switched off, on a small set of logs."""

from dataclasses import dataclass, fields

import numpy as np
import pytest

from disco_hw.gap.search import end_to_end
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tools.gap import ablation as gap_ablation
from tools.gap.ablation import Ablation, alike, changed, main, module_numbers, scaled, settings_fields, table
from tools.gap.margins import Margins, watched, watched_number
from tools.gap.rules import RULES
from tools.gap.tuning import TUNING, VALIDATION, Found, tuning_logs

ANSWER = {
    "named": ["slope"],
    "unnamed": [],
    "doubtful": [],
    "offered": "amended",
    "values": {"slope.k": [1.0, 0.0, 2.0]},
}


def found(named=("slope",), over_timed=(0.5, 0.5), held=(True,), cpu_s=3.0):
    return {
        "right": list(named) == ["slope"], "over_timed": list(over_timed), "held": list(held),
        "answer": {**ANSWER, "named": list(named)}, "cpu_s": cpu_s,
    }  # fmt: skip


@dataclass
class Log:
    """A log in which a block of less than 2 s, and a margin below 0.4, answers otherwise."""

    key: str
    searched: list

    def search(self, settings=DEFAULT_SETTINGS):
        self.searched.append(settings)
        other = settings.grid.block_s < 2.0 or settings.grid.lead_share < 0.4
        return Found(**found(named=() if other else ("slope",)))


@pytest.mark.parametrize(
    ("usual", "times", "value"),
    [(3, 0.5, 2), (1, 0.5, 1), (4, 2.0, 8), (0.5, 2.0, 1.0), ((1.0, 2.0), 0.5, (0.5, 1.0)), (True, 2.0, None),
     (DEFAULT_SETTINGS.prediction.folds, 2.0, None)],
)  # fmt: skip
def test_numbers_are_scaled_and_nothing_else(usual, times, value):
    assert scaled(usual, times) == value


def test_thresholds_are_fields_of_the_settings_and_numbers_of_modules():
    assert len(settings_fields()) == sum(
        len(fields(getattr(DEFAULT_SETTINGS, one.name))) for one in fields(DEFAULT_SETTINGS)
    )
    assert "disco_hw.gap.search.end_to_end:_NEGLIGIBLE" in module_numbers()
    # The size of a vector is no threshold.
    assert not [name for name in module_numbers() if "BASE_COUNT" in name or "settings" in name]


def test_only_what_is_named_changes_and_modules_are_put_back():
    number = "disco_hw.gap.search.end_to_end:_NEGLIGIBLE"
    usual = end_to_end._NEGLIGIBLE
    with changed(["grid.block_s", number, "prediction.folds"], 2.0) as settings:
        assert settings.grid.block_s == 2.0 * DEFAULT_SETTINGS.grid.block_s
        assert 2.0 * usual == end_to_end._NEGLIGIBLE
    others = [one.name for one in fields(DEFAULT_SETTINGS) if one.name != "grid"]
    assert [getattr(settings, name) for name in others] == [getattr(DEFAULT_SETTINGS, name) for name in others]
    assert usual == end_to_end._NEGLIGIBLE


def test_answers_are_alike_where_names_errors_and_intervals_are():
    assert alike(found(), {**found(cpu_s=9.0), "answer": {**ANSWER, "values": {}}})
    assert alike(found(over_timed=(0.505, 0.5)), found())
    assert not alike(found(over_timed=(0.5, 0.52)), found())
    assert not alike(found(named=()), found())
    assert not alike(found(held=(False,)), found())
    assert not alike({"error": "ValueError"}, found())


def test_a_number_that_is_watched_tells_where_half_or_double_would_decide_otherwise():
    margins = Margins()
    limit = watched_number(4.0, {"a": (2.0, 8.0)}, margins)
    assert not limit < 1.0
    assert (limit < 10.0, np.float64(10.0) > limit) == (True, True)
    assert (margins.compared["a"], margins.flipped["a"], margins.lost["a"]) == (3, 0, 0)
    assert not margins.matter("a")
    # Arithmetic is followed, also by others' thresholds.
    twice = 2.0 * limit + watched_number(1, {"b": (1, 2)}, margins)
    assert twice == 9.0
    assert twice < 16.0
    assert margins.flipped == {"a": 2, "b": 1}
    assert list(np.array([1.0, 5.0]) > limit) == [False, True]
    assert margins.flipped["a"] == 3
    # What becomes part of an array is lost from sight, where it is another number.
    assert list(np.minimum(np.array([1.0, 1.5]), limit)) == [1.0, 1.5]
    assert not margins.lost["a"]
    assert list(np.minimum(np.array([1.0, 3.0]), limit)) == [1.0, 3.0]
    assert margins.lost["a"] == 1
    assert (round(limit), int(limit), abs(-limit)) == (4, 4, 4.0)
    assert margins.matter("never seen")


def test_watched_settings_are_the_usual_ones():
    settings, margins = watched()
    assert settings == DEFAULT_SETTINGS
    before = margins.flipped["grid.block_s"]
    assert settings.grid.block_s > 2.9
    assert margins.flipped["grid.block_s"] == before + 1


def test_thresholds_that_answer_otherwise_are_found_by_bisection_and_searched_once(tmp_path):
    log = Log("one", [])
    done = Ablation(tmp_path / "found.json")
    names = ["grid.block_s", "grid.longest_s", "grid.lead_share", "grid.start_every_s"]
    # lead_share of 0.25 is below the margin as it is: usual answers name nothing.
    assert done.screen(log, names, 0.5) == []
    assert done.screen(log, names, 2.0) == ["grid.lead_share"]
    count = len(log.searched)
    again = Ablation(tmp_path / "found.json")
    assert again.screen(log, names, 2.0) == ["grid.lead_share"]
    assert len(log.searched) == count


def test_a_threshold_that_decided_in_a_log_is_left_as_it_is_in_the_next(monkeypatch, tmp_path, capsys):
    logs = [Log("one", []), Log("two", [])]
    monkeypatch.setattr(gap_ablation, "tuning_logs", lambda first: logs)
    assert main(["grid.lead_share", "grid.longest_s", "-o", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "| grid.lead_share x2 | 1 of 1 | 1 | 1 of 1 (0 of 1) |" in out
    assert "| grid.longest_s x2 | 0 of 2 | 0 |" in out
    assert Ablation(tmp_path / "gap_ablation.json").by_log["two"]["searched"] == ["grid.longest_s"]
    assert (tmp_path / "gap_ablation.md").read_text() == out
    with pytest.raises(SystemExit):
        main(["no.such", "-o", str(tmp_path)])


def test_the_table_has_a_line_for_each_rule_and_compares_where_it_decides():
    name = RULES[0].name
    never, once = ({rule.name: [3, int(decides and rule.name == name)] for rule in RULES} for decides in (False, True))
    by_log = {
        "a": {"variants": {"usual": found()}, "rules": never},
        "b": {"variants": {"usual": found(), name: found(named=(), over_timed=(1.0, 1.0))}, "rules": once},
    }
    lines = [*table(by_log)]
    assert lines[2] == "| usual | 2 logs | | 2 of 2 | 0.500 | 2 of 2 | 3.0 |"
    assert lines[3] == f"| {name} | 1 of 2 | 1 | 0 of 1 (1 of 1) | 1.000 (0.500) | 1 of 1 (1 of 1) | 3.0 (3.0) |"
    assert lines[4] == f"| {RULES[1].name} | 0 of 2 | 0 | | | |  |"


def test_the_validation_set_shares_no_log_and_no_robot_day_with_the_tuning_set(monkeypatch):
    monkeypatch.setenv("DISCO_HW_DATA", "/nowhere")
    sets = [{log.key for log in tuning_logs(first)} for first in (TUNING, VALIDATION)]
    assert all(len(each) > 10 for each in sets)
    days = [
        {key.partition("#")[0].rpartition("_run")[0] or key.partition("#")[0] for key in each if "#" in key}
        for each in sets
    ]
    assert not days[0] & days[1]
    simulated = [{(log.key, log.seed) for log in tuning_logs(first) if not log.half} for first in (TUNING, VALIDATION)]
    assert not simulated[0] & simulated[1]
    monkeypatch.delenv("DISCO_HW_DATA")
    assert not [log for log in tuning_logs(TUNING) if log.half]
