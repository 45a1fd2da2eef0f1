"""Every threshold of the gap at half and at double, one at a time, on a small set of logs."""

from dataclasses import asdict, fields

import pytest

from disco_hw.gap.settings import DEFAULT_SETTINGS
from tools.gap import ablation as gap_ablation
from tools.gap.ablation import Variant, logs, main, scaled, table, thresholds
from tools.gap.jobs import Result


def result(named=("motor_lag",), amended_mm=5.0, covered=(True, False), cpu_s=3.0):
    return asdict(
        Result("single", ["motor_lag"], 31, list(named), [], 0, [], 20.0, amended_mm, 4.0, [0.1], list(covered), cpu_s,
               timed_mm=10.0)
    )  # fmt: skip


@pytest.mark.parametrize(
    ("usual", "times", "value"),
    [(3, 0.5, 2), (1, 0.5, 1), (4, 2.0, 8), (0.5, 2.0, 1.0), ((1.0, 2.0), 0.5, (0.5, 1.0)), (True, 2.0, None),
     (DEFAULT_SETTINGS.prediction.folds, 2.0, None)],
)  # fmt: skip
def test_numbers_are_scaled_and_nothing_else(usual, times, value):
    assert scaled(usual, times) == value


def test_a_variant_differs_from_the_usual_settings_in_its_threshold_alone():
    changed = Variant("grid.block_s", 2.0).settings
    assert changed.grid.block_s == 2.0 * DEFAULT_SETTINGS.grid.block_s
    others = [one.name for one in fields(DEFAULT_SETTINGS) if one.name != "grid"]
    assert [getattr(changed, name) for name in others] == [getattr(DEFAULT_SETTINGS, name) for name in others]
    assert Variant().settings is DEFAULT_SETTINGS
    # What is no number has no half.
    assert Variant("prediction.folds", 0.5).settings is None


def test_the_validation_set_shares_no_log_with_the_tuning_set():
    keys = [{job.key for job in logs(first)} for first in (gap_ablation.TUNING, gap_ablation.VALIDATION)]
    assert all(len(each) > 20 for each in keys)
    assert not keys[0] & keys[1]


def test_the_table_compares_with_the_usual_settings_on_the_same_logs():
    found = {
        "usual": {"a": result(), "b": result(amended_mm=10.0)},
        "grid.block_s x2": {"a": result(named=()), "c": result()},
        "grid.block_s x0.5": {"b": result(amended_mm=10.0, cpu_s=9.0)},
    }
    _, _, usual, double, half = table(found)
    assert usual == "| usual | 2 | 2 | 2 | 0.707 | 0.707 | 2 of 4 | 3.0 | 0 |"
    assert double == "| grid.block_s x2 | 1 | 0 | 1 | 0.500 | 0.500 | 1 of 2 | 3.0 | 1 |"
    # Another time taken is no other answer.
    assert half == "| grid.block_s x0.5 | 1 | 1 | 1 | 1.000 | 1.000 | 1 of 2 | 9.0 | 0 |"


def test_what_was_searched_already_is_not_searched_again(monkeypatch, tmp_path, capsys):
    searched = []

    def search(task):
        variant, job = task
        searched.append((variant.key, job.key))
        return variant.key, job.key, result()

    monkeypatch.setattr(gap_ablation, "search", search)
    assert main(["grid.block_s", "--logs", "1", "-o", str(tmp_path)]) == 0
    assert [key for key, _ in searched] == ["usual", "grid.block_s x0.5", "grid.block_s x2"]
    assert main(["grid.block_s", "grid.longest_silence_s", "--logs", "1", "-o", str(tmp_path)]) == 0
    assert [key for key, _ in searched[3:]] == ["grid.longest_silence_s x0.5", "grid.longest_silence_s x2"]
    assert "| grid.longest_silence_s x2 | 1 |" in capsys.readouterr().out
    assert len([*tmp_path.glob("*/gap_ablation.md")]) == 1
    # The validation set is searched with the usual settings alone.
    assert main(["--validate", "--logs", "2", "-o", str(tmp_path)]) == 0
    assert [key for key, _ in searched[5:]] == ["usual", "usual"]
    with pytest.raises(SystemExit):
        main(["no.such", "-o", str(tmp_path)])


def test_every_threshold_is_listed():
    assert len(thresholds()) == sum(
        len(fields(getattr(DEFAULT_SETTINGS, one.name))) for one in fields(DEFAULT_SETTINGS)
    )
