"""Positions without heading in simulated time: by hand until it is known, and then the task, armed anew."""

from __future__ import annotations

import math

import msgspec
import pytest

from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot, UntilHeading, task_pilot
from disco_hw.runtime import State
from disco_hw.runtime.core import TaskPilot
from disco_hw.runtime.pipeline import FollowTask, NoPlanner
from disco_hw.runtime.supervisor import UserRequest
from tests.drive.test_hand_pilot import Hand
from tests.runtime.simulated import simulated_stack

ARM, START = UserRequest.ARM, UserRequest.START


class WithoutHeading:
    """The robot's poses as an antenna gives them: one in five, and positions alone."""

    def __init__(self):
        self.count, self.carried_m = 0, 0.0

    def receive(self, now_ns, from_robot):
        poses = []
        for pose in from_robot:
            self.count += 1
            if self.count % 5 == 0:
                x_m = pose.x_m + self.carried_m
                poses.append(msgspec.structs.replace(pose, x_m=x_m, yaw_rad=math.nan, yaw_std_rad=math.nan))
        return poses

    def close(self):
        pass


class OneRoughHeading(WithoutHeading):
    """One pose with a heading that is good to a radian, and no more."""

    def receive(self, now_ns, from_robot):
        self.count += len(from_robot)
        return [msgspec.structs.replace(pose, yaw_std_rad=1.0) for pose in from_robot if self.count == 1]


@pytest.fixture
def bench():
    stack = simulated_stack(NoPlanner())
    stack.core.pose_source = WithoutHeading()
    stack.hand = Hand()
    stack.hand.wheels = (4.0, 4.0)
    stack.pilot = UntilHeading(TaskPilot(), HandPilot(stack.hand, Coverage(8.0)))
    return stack


def replies(ticks):
    return [reply for tick in ticks for reply in tick.output.replies]


def test_by_hand_a_metre_and_then_the_task_is_armed_anew(bench):
    last = bench.run(1.0)[-1]
    assert last.output.state is State.READY
    assert "heading not known" in last.output.detail
    assert "drive" in bench.pilot.status()
    # Nobody holds the pad: whoever arms finds it disarmed again, and the task is refused.
    ticks = bench.run(1.5, ARM, START)
    assert bench.robot.truth.left_speed_rad_s == pytest.approx(0.0, abs=0.01)
    assert not any(
        tick.output.motion_allowed and isinstance(bench.pilot.step(0, tick).motion, FollowTask) for tick in ticks
    )
    bench.hand.held = True
    driven = bench.run(5.0)
    assert any(tick.output.motion_allowed for tick in driven)
    assert driven[-1].pipeline.estimate.heading_known
    # Still the same hand, although the heading is known by now.
    assert driven[-1].pipeline.source.value == "manual"
    bench.hand.held = False
    stood = bench.run(1.0)
    assert stood[-1].output.state is State.READY
    assert stood[-1].output.detail == "ready to be armed"
    assert not stood[-1].output.running
    assert bench.pilot.status() == {}
    truth, estimate = bench.robot.truth, stood[-1].pipeline.estimate
    assert abs(math.remainder(estimate.yaw_rad - truth.yaw_rad, math.tau)) < 0.15
    started = bench.run(1.0, ARM, START)
    assert all(reply.accepted for reply in replies(started))
    assert started[-1].output.motion_allowed
    assert any(tick.output.running for tick in started)


def test_nobody_is_asked_to_find_a_heading_that_the_source_measures(bench):
    bench.core.pose_source = OneRoughHeading()
    last = bench.run(1.0)[-1]
    assert last.pipeline.estimate.initialised
    assert "heading too uncertain; wait for poses with a heading" in last.output.detail


@pytest.mark.thorough
def test_carried_off_the_task_stops_and_the_hand_is_asked_again(bench):
    bench.run(2.0)
    bench.hand.held = True
    bench.run(6.0)
    bench.hand.held = False
    bench.run(2.0)
    assert bench.run(2.0, ARM, START)[-1].output.motion_allowed
    bench.core.pose_source.carried_m = 3.0
    carried = bench.run(6.0)
    assert not carried[-1].output.motion_allowed
    assert any("task stopped" in event for tick in carried for event in tick.events)
    assert not carried[-1].pipeline.estimate.heading_known
    # Armed, it holds still; a start is refused, and the hand has its turn once it is disarmed.
    (refused,) = replies(bench.run(0.1, START))
    assert "heading not known" in refused.text
    bench.run(1.0, UserRequest.DISARM)
    assert "drive" in bench.pilot.status()


def test_the_page_steers_until_then_and_not_afterwards(bench):
    bench.pilot = task_pilot(bench.core.config)
    bench.run(2.0)
    open_pad = {"forward": 0, "left": 0, "held": False, "stamp": "0"}
    assert bench.pilot.steer(bench.now_us * 1000, 1, open_pad) is None
    bench.core.pose_source = type("Whole", (), {"receive": lambda _self, _now, poses: poses})()
    bench.run(1.0)
    assert "this daemon follows its task" in bench.pilot.steer(bench.now_us * 1000, 1, open_pad)
