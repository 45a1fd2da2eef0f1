"""The tick takes its poses from the source that robot.toml names."""

import msgspec
import pytest

from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.errors import InputError
from disco_hw.runtime import assembly
from disco_hw.runtime.assembly import pose_source_of
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.pose import PoseSourceError
from drivers.pose.robot import RobotPoses
from drivers.types import PoseSample, WheelSample
from tests.drive.test_hand_pilot import Hand
from tests.runtime.simulated import ROBOT_FILE, recorded, replies, simulated_stack


class Elsewhere:
    """Says in every tick that the robot is at one place."""

    def receive(self, now_ns, from_robot):
        return [PoseSample(now_ns, now_ns, 7.0, -3.0, 0.5, 0.01, 0.01)]

    def close(self):
        pass


def test_the_estimate_rests_on_the_sources_poses_in_place_of_the_robots(monkeypatch):
    monkeypatch.setattr(assembly, "pose_source_of", lambda _config: Elsewhere())
    stack = simulated_stack(planner=NoPlanner())

    estimate = stack.run(1.0)[-1].pipeline.estimate
    assert (estimate.x_m, estimate.y_m, estimate.yaw_rad) == pytest.approx((7.0, -3.0, 0.5), abs=1e-3)
    assert estimate.pose_ok


def test_without_poses_the_robot_is_driven_by_hand_and_recorded(monkeypatch):
    stack = simulated_stack(NoPlanner())
    stack.core.pose_source = Elsewhere()
    monkeypatch.setattr(Elsewhere, "receive", lambda _self, _now_ns, _from_robot: [])
    hand = Hand()
    stack.pilot = HandPilot(hand, Coverage(8.0))
    stack.run(1.5)
    hand.held = True
    assert stack.run(1.5)[-1].output.motion_allowed
    assert recorded(stack, WheelSample)
    assert not recorded(stack, PoseSample)


def test_without_wheels_poses_are_recorded_and_nothing_is_armed(monkeypatch):
    """Whoever pushes the robot, or drives it by its own remote control, has its poses; no blind motion."""
    stack = simulated_stack(NoPlanner())
    driver = stack.core.driver
    receive = driver.receive
    monkeypatch.setattr(driver, "receive", lambda *of: msgspec.structs.replace(receive(*of), wheels=()))
    stack.core.pose_source = Elsewhere()
    stack.pilot = HandPilot(Hand(), Coverage(8.0))
    stack.run(1.5)
    (reply,) = replies(stack.run(0.1, UserRequest.ARM))
    assert (reply.accepted, reply.text) == (
        False,
        "not connected to the robot: the robot sends no wheel data; check the encoders and the controller",
    )
    assert recorded(stack, PoseSample)
    assert not recorded(stack, WheelSample)


def test_the_robots_own_poses_are_the_default():
    assert isinstance(pose_source_of(load_setup(ROBOT_FILE).config), RobotPoses)


def test_a_source_that_cannot_be_had_is_bad_input(monkeypatch):
    def refuse(**_fields):
        raise PoseSourceError("port 5005: in use; choose another")

    monkeypatch.setattr(assembly, "create_pose_source", refuse)
    with pytest.raises(InputError, match=r"pose\.source: port 5005: in use; choose another$"):
        pose_source_of(load_setup(ROBOT_FILE).config)
