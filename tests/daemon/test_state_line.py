"""Tests of the line in which the daemon prints its state and what to do next."""

from pathlib import Path

from disco_hw.daemon.daemon import state_line
from disco_hw.runtime import ARMING, State, by_command
from disco_hw.runtime.supervisor import Output


def line(detail: str) -> str:
    output = Output(
        state=State.READY,
        detail=detail,
        driver_request=None,
        motion_allowed=False,
        zero_only=False,
        running=False,
        send_estop=False,
        estop=False,
        events=(),
        replies=(),
    )
    return state_line(output, None, {}, by_command(Path("mine.toml")))


def test_a_ready_robot_can_be_armed():
    assert line("ready to be armed") == (
        "READY: ready to be armed. Run `disco-hw ctl mine.toml arm`; arming does not move the robot."
    )


def test_while_the_robot_arms_nobody_is_told_to_arm_it_again():
    assert line(ARMING) == "READY: arming. Wait: the robot is arming."
