"""The stack in simulated time: it drives, and under random faults nothing gets through to the wheels.

A short part of what `make fault-campaign` does for hours.
"""

import re

import pytest

from disco_hw.runtime.plausibility import PlausibilityStats
from sim.fault_schedule import KINDS, FaultSchedule, parse_schedule
from tools.faults.campaign import KINDS_LEFT_OUT, markdown, summary
from tools.faults.random_faults import random_schedule
from tools.faults.run import FaultRun

FAST = {"cycle_us": 5000}


def test_without_faults_it_drives_and_nothing_is_reported():
    run = FaultRun(FaultSchedule(0, ()), **FAST)
    outcome = run.run(6.0)
    assert outcome.violations == []
    assert outcome.moving_s > 3.5
    assert outcome.commands_accepted > 200
    assert run.core.last.output.running
    assert run.core.plausibility == PlausibilityStats()


@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.thorough), pytest.param(1, marks=pytest.mark.long)])
def test_random_faults_end_in_a_stop_or_are_tolerated(seed):
    kinds = tuple(kind for kind in KINDS if kind not in KINDS_LEFT_OUT)
    run = FaultRun(random_schedule(seed, 23.0, kinds=kinds, quiet_s=(3.0, 4.0)), seed=seed, **FAST)
    outcome = run.run(28.0)
    assert outcome.violations == []
    assert len(outcome.faults) >= 4
    assert outcome.moving_s > 8.0


def outcomes_of(*faults):
    """Outcomes of faults that strike one after the other, each when the consequences of the one before are known."""
    texts, at_s = [], 3.0
    for fault in faults:
        texts.append(f"[[fault]]\nat_s={at_s}\n{fault}")
        lasts = re.search(r"for_s=(\S+)", fault)
        at_s += (float(lasts[1]) if lasts else 0.0) + 2.6
    outcome = FaultRun(parse_schedule("\n".join(texts)), seed=3, **FAST).run(at_s)
    assert outcome.violations == []
    for fault, seen in zip(faults, outcome.faults, strict=True):
        assert seen.armed_before, fault
        assert seen.counters, fault
    return outcome.faults


STOPPED_FOR = (
    'kind="encoder_stuck"\nfor_s=2',
    'kind="encoder_reversed"\nfor_s=2',
    'kind="motor_stall"\nfor_s=2',
    'kind="battery_sag"\nfor_s=1',
    'kind="clock_jump"\nstep_s=5',
    # Longer than the watchdog, shorter than what lets the driver go: a stop with its ramp.
    'kind="clock_jump"\nstep_s=0.25',
    'kind="clock_jump"\nstep_s=0.05',
    'kind="clock_jump"\nstep_s=-5',
    'kind="sigkill"\nfor_s=0.5',
)


def test_a_fault_that_the_robot_stops_for_is_counted_and_reported():
    for fault, seen in zip(STOPPED_FOR, outcomes_of(*STOPPED_FOR), strict=True):
        assert seen.stopped_s is not None, fault
        assert seen.events, fault


# Faults that the robot does not stop for, and the counter of those that are reported.
TOLERATED = {
    # Within what the core's two clocks may be apart: its own time goes on, and the clock that went back is counted.
    'kind="clock_jump"\nstep_s=-0.015': None,
    'kind="flip_after_crc"\nfor_s=0.5\nprobability=0.2\nto="host"': None,
    'kind="pose_silent"\nfor_s=0.5': None,
    'kind="motor_stall"\nfor_s=0.2': "wheels_not_following",
    'kind="encoder_reversed"\nfor_s=0.15': "wheels_not_following",
    'kind="encoder_stuck"\nfor_s=0.1': "wheels_not_following",
    'kind="battery_sag"\nfor_s=0.5\ndrop_v=2': "supply_dips",
    'kind="pose_frozen"\nfor_s=0.15': "poses_frozen",
}


def test_a_fault_too_short_to_stop_for_is_counted_and_reported():
    for (fault, counter), seen in zip(TOLERATED.items(), outcomes_of(*TOLERATED), strict=True):
        assert seen.stopped_s is None, fault
        if counter:
            assert f"plausibility.{counter}" in seen.counters, fault
            assert seen.events, fault


@pytest.mark.thorough
def test_the_same_seeds_give_the_same_run():
    schedule = random_schedule(5, 7.0, quiet_s=(3.0, 4.0))
    runs = [FaultRun(schedule, seed=5, **FAST) for _ in range(2)]
    outcomes = [run.run(8.0) for run in runs]
    assert outcomes[0] == outcomes[1]
    assert runs[0].robot.plant.truth == runs[1].robot.plant.truth


def test_the_table_counts_what_struck_an_armed_robot():
    fault = {"kind": "drop", "struck": True, "armed": True, "stopped_s": 0.3, "counters": ["x"], "told": ["y"]}
    results = [{"faults": [fault, fault | {"stopped_s": None, "told": []}, fault | {"armed": False}]}]
    assert summary(results)["drop"] == {
        "struck": 2, "tolerated": 1, "stopped": 1, "slowest_s": 0.3, "counted": 2, "told": 2, "stop_untold": 0,
    }  # fmt: skip
    assert "| `drop` | 2 | 1 | 1 | 0.30 s | 2 | 2 |" in markdown(summary(results))


@pytest.mark.parametrize(
    ("to", "growth"),
    [
        ("robot", 0.1),
        pytest.param("both", 1.0, marks=pytest.mark.thorough),
        *(pytest.param(*case, marks=pytest.mark.long) for case in [("robot", 0.2), ("robot", 1.0), ("both", 0.1)]),
        pytest.param("both", 0.2, marks=pytest.mark.long),
    ],
)
def test_commands_that_come_later_and_later_end_in_a_stop(growth, to):
    """Each in its turn, so that neither counter nor watchdog notices."""
    text = f'[[fault]]\nat_s=3\nfor_s=3\nkind="delay"\nto="{to}"\nprobability=1\ndelay_s=0.001\ngrowth={growth}'
    run = FaultRun(parse_schedule(text), seed=3, **FAST)
    (seen,) = run.run(9.0).faults
    assert run.outcome.violations == []
    # Found when commands are 0.15 s late; then what is on its way, the watchdog's 0.1 s and the ramp.
    assert seen.stopped_s < 0.15 * (1 + growth) / growth + 0.25 + 0.15 * (1 + growth) + 0.1 + 0.4
    assert "driver.late_commands" in seen.counters
    assert any("late" in text for text in seen.events)
