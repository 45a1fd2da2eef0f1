"""The tick takes its poses from the source that robot.toml names."""

import socket

import msgspec
import pytest

from disco_hw.config import load_robot_config
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime import assembly
from disco_hw.runtime.assembly import pose_source_of
from disco_hw.runtime.obstacles import obstacle_source_of
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.pose import PoseSourceError
from drivers.pose.robot import RobotPoses
from drivers.types import PoseSample, WheelSample
from tests.drive.test_hand_pilot import Hand
from tests.runtime.simulated import ROBOT_FILE, recorded, replies, robot_toml, simulated_stack


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


@pytest.mark.parametrize(
    "lines",
    [
        # 192.0.2.1 is of a network for examples (RFC 5737), as an address that is not up yet.
        'source = "udp"\naddress = "192.0.2.1"\n',
        'source = "natnet"\nnatnet_version = "3.1"\naddress = "192.0.2.1"\n',
    ],
)
def test_an_address_that_is_not_up_yet_is_no_bad_input(tmp_path, lines):
    """As when the service starts before the network: exit code 2 would keep it from being started again."""
    with pytest.raises(WorkError, match=r"^robot\.toml: pose\.source: .*192\.0\.2\.1.*pose\.address"):
        pose_source_of(load_robot_config(robot_toml(tmp_path, f"[pose]\n{lines}")))


def test_a_port_for_obstacles_that_is_held_is_no_bad_input(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        port = holder.getsockname()[1]
        config = load_robot_config(robot_toml(tmp_path, f"[fence]\nobstacles_port = {port}\n"))
        with pytest.raises(WorkError, match=rf"obstacles_port: 127\.0\.0\.1:{port}: Address already in use"):
            obstacle_source_of(config)
