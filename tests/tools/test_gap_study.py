"""The study: a small part of it, and that it counts, keeps and resumes; real searches of a few logs only."""

import dataclasses
import json
import math

import pytest
from rich.console import Console

from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.search.channel_result import ParameterEstimate
from tools.gap import jobs as gap_jobs
from tools.gap import study as gap_study
from tools.gap import tables as gap_tables
from tools.gap.jobs import Job, Result, jobs
from tools.gap.logs import NAMED
from tools.gap.strange_robot import FORMS

pytestmark = pytest.mark.long

QUIET = Console(quiet=True)


def result(kind="single", hidden=("motor_lag",), named=("motor_lag",), seed=1, **changes):
    plain = Result(kind, list(hidden), seed, list(named), [], 0, [], 40.0, 15.0, 14.0, [0.02], [True], 5.0)
    return dataclasses.replace(plain, **changes)


def echo(job):
    return result(job.kind, job.hidden, job.hidden, job.seed)


@pytest.mark.parametrize(
    "job",
    [Job("single", {"turn_slip": 0.09}, 31), Job("none", {}, 32)],
    ids=lambda job: job.key,
)
def test_a_part_of_the_study(job):
    found = gap_jobs.work(job)
    assert found.right, found
    if job.hidden:
        # Of the gap of the fitted geometry; `closed` is of what a timed model leaves, less the motors' lag.
        assert found.refitted_mm - found.amended_mm > 0.8 * (found.refitted_mm - found.floor_mm)
        assert found.closed > 0.5
        assert max(found.errors) < 0.15


def test_what_counts_as_right_depends_on_the_kind():
    assert result().right
    assert not result(named=()).right
    assert not result(named=("motor_lag", "deadband")).right
    # The motors of every robot of the study lag, hidden or not.
    assert result(hidden=("deadband",), named=("motor_lag", "deadband")).right
    assert result("none", (), ("motor_lag",)).right
    assert not result("none", (), ("command_delay",)).right
    assert not result(unnamed=["v_x += 1 v"]).right
    assert result(hidden=("pose_offset",), named=("lateral_icr",)).right
    assert not result("outside", ("x_motor_droop",), ("wheel_gain",), unnamed=["u |u|"]).right
    assert result("outside", ("x_motor_droop",), (), unnamed=["u |u|"]).right
    assert not result("forms", ("x_second_order_motor",), ("motor_lag",)).right
    assert result("forms", ("x_second_order_motor",), ("motor_lag",), residue=1).right
    assert result("strange", ("hysteresis",), ("motor_lag", "command_delay"), unnamed=["u |u|"]).right
    assert not result("strange", ("hysteresis",), ("motor_lag", "deadband")).right
    assert result("strange", ("stribeck_friction",), ("deadband",)).right
    assert result("circle", ("turn_slip",), (), blind=["turn_slip"]).right
    assert not result("circle", ("turn_slip",), (), blind=["slope"]).right
    assert not result("circle", ("turn_slip",), ("slope",), blind=["turn_slip"]).right
    assert result("circle", ("motor_lag",), ("command_delay",), alike=["motor_lag"]).right
    assert not result("circle", ("motor_lag",), ("command_delay",), alike=["deadband"]).right


def test_a_miss_that_the_report_calls_too_small_is_counted_beside_and_never_as_right():
    missed = result("weak", named=(), too_small=["motor_lag"])
    assert not missed.right
    assert missed.told
    assert not result("weak", named=()).told
    assert not result("weak", named=("deadband",), too_small=["motor_lag"]).told
    figures = gap_tables.summary([missed, result("weak", seed=2)])
    assert (figures["gap.weak.right"], figures["gap.weak.told"]) == (0.5, 1.0)
    spot = BlindSpot("turn_slip", "k_s", "s/rad", 0.02, False, "")
    assert gap_jobs.too_small(spot, 0.01)
    assert not gap_jobs.too_small(spot, 0.03)
    limit = BlindSpot("speed_limit", "limit_rad_s", "rad/s", 6.0, False, "")
    assert gap_jobs.too_small(limit, 7.0)
    assert not gap_jobs.too_small(limit, 5.0)


def test_the_gap_to_close_is_that_of_the_timed_model_where_more_than_times_is_hidden():
    strange = result("strange", ("backlash",), (), timed_mm=24.0, amended_mm=19.0)
    assert strange.closed == pytest.approx(0.5)
    assert result(timed_mm=24.0).closed == pytest.approx(25.0 / 26.0)
    assert result(hidden=("motor_lag", "deadband"), timed_mm=24.0).closed == pytest.approx(0.9)
    figures = gap_tables.summary([strange, result("strange", ("backlash",), (), timed_mm=24.0, amended_mm=20.0)])
    assert (figures["gap.strange.closed_by_half"], figures["gap.strange.closed_of"]) == (0.5, 2)
    assert figures["gap.strange.written_by_half"] == 0.5
    # What no model can carry is not in the one that is written.
    lacking = dataclasses.replace(strange, written_mm=24.0)
    assert (lacking.closed, lacking.closed_as_written) == (pytest.approx(0.5), 0.0)
    assert gap_tables.summary([strange, lacking])["gap.strange.written_by_half"] == 0.5
    assert any(line.startswith("| `backlash` |") for line in gap_tables.per_effect([strange]))
    assert [next(iter(job.hidden)) for job in jobs("strange", [7])] == list(FORMS)


def test_a_study_goes_on_where_it_was_broken_off(tmp_path, monkeypatch):
    todo = list(jobs("single", range(1, 3)))
    assert len({job.key for job in todo}) == len(todo) == 2 * len(NAMED)
    done = []

    def broken_off(job):
        if len(done) == 7:
            raise KeyboardInterrupt
        done.append(job.key)
        return echo(job)

    monkeypatch.setattr(gap_jobs, "work", broken_off)
    with pytest.raises(KeyboardInterrupt):
        gap_study.study(todo, tmp_path, 1, QUIET)
    again = []
    monkeypatch.setattr(gap_jobs, "work", lambda job: again.append(job.key) or echo(job))
    results = gap_study.study(todo, tmp_path, 1, QUIET)
    assert len(results) == len(todo)
    assert set(again) == {job.key for job in todo} - set(done)
    assert (tmp_path / "gap_confusion.png").stat().st_size > 1000
    assert len(json.loads((tmp_path / "gap_study.json").read_text())["results"]) == len(todo)
    # Other code: nothing of it counts any more.
    monkeypatch.setattr(gap_study, "revision", lambda: "other")
    again.clear()
    gap_study.study(todo, tmp_path, 1, QUIET)
    assert len(again) == len(todo)


def test_figures_have_their_numbers_and_intervals():
    found = [result(seed=seed) for seed in range(9)] + [result(named=(), errors=[], covered=[False], amended_mm=40.0)]
    figures = gap_tables.summary(found)
    assert figures["gap.single.logs"] == 10
    assert figures["gap.single.right"] == pytest.approx(0.9)
    # Wilson's interval of 9 in 10 is known.
    assert (figures["gap.single.right_low"], figures["gap.single.right_high"]) == pytest.approx(
        (0.596, 0.982), abs=1e-3
    )
    assert figures["gap.single.closed_median"] == pytest.approx(25.0 / 26.0)
    assert figures["gap.single.covered"] == pytest.approx(0.9)
    rows, columns, counts = gap_tables.confusion(found)
    row = rows.index("motor_lag")
    assert counts[row, columns.index("motor_lag")] == 9
    assert counts[row, columns.index("nothing")] == 1


def test_parameter_errors_are_of_the_parameters_that_were_hidden():
    exact = {"drift_x_m_s": ParameterEstimate(0.0, -1.0, 1.0), "drift_y_m_s": ParameterEstimate(0.02, 0.01, 0.03)}
    assert gap_jobs.judged("slope", (0.02, math.pi / 2), exact) == (pytest.approx(0.0), [True, True])
    off = {"left": ParameterEstimate(0.03, 0.02, 0.04), "right": ParameterEstimate(0.05, 0.045, 0.055)}
    error, covered = gap_jobs.judged("wheel_gain", 0.04, off)
    assert error == pytest.approx(0.25)
    assert covered == [True, False]
