"""A wheel that ceases to obey, with each driver's simulated controller in the tick; the whole campaign is long."""

import sys

import pytest

from disco_hw.runtime import State
from disco_hw.runtime.supervisor import UserRequest
from tools.faults import wheel_campaign as wheel_fault_campaign
from tools.faults.wheel_campaign import drive_healthy, strike
from tools.faults.wheel_run import WheelFaultRun, WheelRun

SUBSET = [
    ("reference", "frozen", 0.03, "circle", "left", 11),
    ("odrive", "blocked", 0.05, "straight", "right", 12),
    ("roboclaw", "disconnected", 0.03, "circle", "left", 13),
    ("agilex", "reversed", 0.08, "straight", "left", 14),
    ("vesc", "frozen", 0.03, "circle", "right", 15),
    ("ros2_base", "runs away", 0.2, "circle", "right", 16),
]


@pytest.mark.parametrize("job", SUBSET, ids=lambda job: f"{job[0]}-{job[1]}")
def test_a_wheel_that_ceases_to_obey_stops_the_robot_in_time_and_for_the_right_cause(job, monkeypatch):
    monkeypatch.setattr(wheel_fault_campaign, "WARM_UP_S", (2.4, 2.6))
    run = strike(job)
    assert not run.is_missed, f"{run.stopped_s:.2f} s, {run.travel_rad:.2f} rad"
    assert run.status_text
    assert not run.is_wrong, run.status_text


@pytest.mark.parametrize("driver", ["reference", pytest.param("roboclaw", marks=pytest.mark.thorough)])
def test_mended_and_reset_it_can_be_armed_again_and_drives(driver):
    run = WheelFaultRun(driver, 0.2, "straight", seed=5)
    assert run.drive(1.2) == []
    run.strike(WheelRun(driver, "disconnected", 0.2, "straight", "left"), 1.0)
    assert run.stack.core.last.output.state is State.FAULT
    run.board.faults.set_active([])
    run.stack.run(0.5)
    run.stack.run(1.0, UserRequest.RESET)
    run.stack.run(0.5, UserRequest.ARM)
    run.stack.run(0.1, UserRequest.START)
    assert all(tick.output.motion_allowed for tick in run.stack.ticks(0.5))


def test_a_healthy_robot_on_rough_ground_is_left_alone():
    _, stopped = drive_healthy(2, 5.0)
    assert stopped == []


@pytest.mark.long
def test_the_campaign_misses_nothing_blames_nothing_wrongly_and_stops_no_healthy_robot(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["wheel_fault_campaign", "--seed", "20000"])
    assert wheel_fault_campaign.main() == 0, capsys.readouterr().out
