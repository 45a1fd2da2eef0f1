"""The pilot of `disco-hw run` leaves everything to the task."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from disco_hw.runtime import State
from disco_hw.runtime.core import PilotTick, TaskPilot
from disco_hw.runtime.pipeline import FollowTask, Manual, NoPlanner, Source
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from sim.body_dynamics import BodyPose
from tests.runtime import simulated
from tests.runtime.path_robot import path_robot
from tests.runtime.simulated import arm, simulated_stack


def test_a_task_is_followed_and_nothing_is_added():
    pilot = TaskPilot()
    assert pilot.step(0, None) == PilotTick((), FollowTask(), ())
    assert pilot.status() == {}
    assert not pilot.done


class Eager:
    """Wants to drive whatever the state, and asks for nothing."""

    done, needs_pose = False, True

    def step(self, now_ns, last):
        return PilotTick(motion=Manual(3.0, 3.0))

    def learn(self, now_ns, tick, replies):
        self.replies = replies

    def status(self):
        return {}


def test_what_a_pilot_wants_counts_only_where_the_supervisor_allows_motion():
    stack = simulated_stack()
    stack.pilot = Eager()
    assert all(tick.command is None for tick in stack.run(1.5))
    armed = stack.run(0.5, UserRequest.ARM)
    assert {tick.pipeline.source for tick in armed} <= {Source.OFF, Source.HOLD}
    running = stack.run(0.5, UserRequest.START)
    assert running[-1].pipeline.source is Source.MANUAL
    assert running[-1].command.left_rad_s == 3.0
    # Replies to others are none of the pilot's.
    assert stack.pilot.replies == ()


def test_a_pilot_that_drives_past_the_end_of_a_path_is_not_stopped_there(tmp_path):
    stack = simulated_stack(robot_file=path_robot(tmp_path, "x_m,y_m\n0,0\n1,0\n"), start=BodyPose(0.9, 0.0, 0.0))
    stack.pilot = Eager()
    stack.run(1.5)
    stack.run(0.5, UserRequest.ARM)
    assert stack.run(1.0, UserRequest.START)[-1].output.running
    assert stack.robot.truth.x_m > 1.0


@pytest.mark.parametrize("needs_pose", [True, False])
def test_only_who_needs_a_pose_waits_for_one(monkeypatch, needs_pose):
    def without_pose(path):
        setup = load_setup(path)
        estimation = msgspec.structs.replace(setup.config.estimation, pose_timeout_s=1e-9)
        return replace(setup, config=msgspec.structs.replace(setup.config, estimation=estimation))

    monkeypatch.setattr(simulated, "load_setup", without_pose)
    stack = simulated_stack(NoPlanner(), needs_pose=needs_pose)
    stack.pilot = Eager()
    arm(stack)
    assert stack.core.last.output.state is State.ARMED
    last = stack.run(0.5, UserRequest.START)[-1]
    assert not last.pipeline.estimate.pose_ok
    assert (last.command.left_rad_s == 3.0) is not needs_pose
