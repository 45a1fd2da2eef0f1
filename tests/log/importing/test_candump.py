import can
import numpy as np
import pytest

from disco_hw.config import Link, Robot, RobotConfig
from disco_hw.errors import LogError
from disco_hw.experiments.simulated_time import SimulatedRun
from disco_hw.log.importing.candump import read_candump
from disco_hw.log.records import Command, FrameIn, FrameOut
from disco_hw.runtime.core import PilotTick, TaskPilot
from disco_hw.runtime.pipeline import Manual, NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.types import PoseSample, WheelSample
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareConfig
from sim.effects import hidden_effects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import RobotInProcess, VirtualRobot
from tests.runtime.simulated import START, arm, recorded, robot_toml

ROBOT = Robot(name="test", wheel_radius_m=0.06, axial_distance_m=0.3, ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
CONFIG = RobotConfig(robot=ROBOT, link=Link(channel="vcan0"))
BEGAN_S = 1_700_000_000.0
COUNT = 200
CODEC = Codec()


def dumped(path, spoil=lambda number, data: data):
    """Ten seconds at 20 Hz: commands for 5 s, both wheels at 2 and 3 rad/s, a pose with every sample."""
    with can.CanutilsLogWriter(path) as writer:
        for k in range(COUNT):
            t_s = 0.05 * k
            counter, ticks = k % 16, 2048 / (2.0 * np.pi) * t_s
            stamp = (50_000 * k) % (20 << 16)
            frames = [
                CODEC.encode("WHEEL_SPEED", counter, **wheel_speed(stamp)),
                CODEC.encode("WHEEL_TICKS", counter, left_ticks=round(2.0 * ticks), right_ticks=round(3.0 * ticks)),
                CODEC.encode("POSE_POSITION", counter, x=0.1 * t_s, y=-0.2 * t_s, valid=1),
                CODEC.encode("POSE_HEADING", counter, **heading(0.01 * k, (50_000 * k) % (100 << 16))),
            ]
            if t_s < 5.0:
                frames.append(CODEC.encode("WHEEL_COMMAND", counter, **command()))
            for number, frame in enumerate(frames):
                message = can.Message(
                    timestamp=BEGAN_S + t_s + 1e-4 * number,
                    arbitration_id=frame.can_id,
                    data=spoil(k, frame.data),
                    is_extended_id=False,
                    channel="can0",
                )
                writer.on_message_received(message)
    return path


def wheel_speed(stamp):
    flags = {"left_valid": 1, "right_valid": 1, "driver_enabled": 1, "limited": 0}
    return {"left_speed": 2.0, "right_speed": 3.0, "sample_time": stamp, **flags}


def heading(yaw, stamp):
    return {"yaw": yaw, "valid": 1, "sample_time": stamp, "position_std": 0.01, "yaw_std": 0.01}


def command():
    return {"mode": "SPEED", "left_speed": 2.0, "right_speed": 3.0, "valid_for": 0.1, "session": 1}


def test_a_dump_of_the_protocol_becomes_a_drive(tmp_path):
    drive = read_candump(dumped(tmp_path / "dump.log"), CONFIG)
    assert drive.segments == 1
    assert drive.notes == ()
    # The first frames only qualify their sender.
    assert COUNT - 5 < drive.wheels.t_s.size <= COUNT
    assert np.diff(drive.wheels.t_s) == pytest.approx(0.05, abs=1e-6)
    assert drive.wheels.left_speed_rad_s == pytest.approx(2.0)
    rolled = drive.wheels.right_angle_rad - drive.wheels.right_angle_rad[0]
    assert rolled == pytest.approx(3.0 * (drive.wheels.t_s - drive.wheels.t_s[0]), abs=0.004)
    assert drive.poses.y_m == pytest.approx(-2.0 * drive.poses.x_m, abs=2e-3)
    assert np.diff(drive.poses.yaw_rad) == pytest.approx(0.01, abs=1e-3)


def test_a_command_counts_no_longer_than_it_is_valid(tmp_path):
    commands = read_candump(dumped(tmp_path / "dump.log"), CONFIG).commands
    assert commands.left_rad_s[:-1] == pytest.approx(2.0)
    assert np.isnan(commands.left_rad_s[-1])
    assert commands.t_s[-1] - commands.t_s[-2] == pytest.approx(0.1, abs=1e-6)


def test_frames_that_fail_their_check_are_left_out_and_counted(tmp_path):
    def spoil(k, data):
        return bytes([data[0] ^ 0xFF, *data[1:]]) if k == 100 else data

    drive = read_candump(dumped(tmp_path / "dump.log", spoil), CONFIG)
    assert drive.wheels.t_s.size < COUNT - 1
    assert "frames of can0: 4 of 900 failed their check" in drive.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("(1.0) can0 7FF#00\n", "1 frames, none of them a command"),
        ("(x) can0 7FF#00\n", "not a candump"),
        ("(inf) can0 7FF#00\n", "not a candump"),
        ("(1.0) can0 7FF#00\n(1.1) can0 7FF#00\n(1.", "2 frames, none of them a command"),
        ("(1.0) can0 7FF#00\nx\ny\n", r"lines: 2 of 3 are no frame .*the first is line 2 \(67 %\); correct them"),
        ("can0  110   [8]  00 01 02 03 04 05 06 07\n", "screen format without time stamps; record with `candump -L`"),
        ("\n\n", "holds no frame"),
    ],
)
def test_what_is_no_such_dump_is_refused(tmp_path, text, message):
    path = tmp_path / "dump.log"
    path.write_text(text)
    with pytest.raises(LogError, match=message):
        read_candump(path, CONFIG)


class ByHand(TaskPilot):
    """Turns to the left."""

    def step(self, now_ns, last):
        return PilotTick(motion=Manual(0.5, 1.5), by_hand=True)


REWIRED = """
[wheels]
turn_ratio = 0.5
sides_swapped = true
motor_direction = [-1, 1]
encoder_direction = [-1, 1]
[pose]
origin = [3.0, -1.0, 0.5]
offset = [0.2, 0.1]
yaw_unit = "deg"
latency_s = 0.25
"""


def test_wheels_and_poses_are_those_of_the_daemons_own_log(tmp_path):
    setup = load_setup(robot_toml(tmp_path, REWIRED))
    limits = FirmwareConfig(2048, max_wheel_speed_rad_s=20.0, max_wheel_acceleration_rad_s2=100.0)
    robot = RobotInProcess(VirtualRobot(Plant(PlantParameters(), hidden_effects({}), 1, START), limits))
    stack = SimulatedRun(setup, robot, NoPlanner(), needs_pose=False)
    stack.core.directions = None
    arm(stack)
    stack.pilot = ByHand()
    stack.run(0.6, UserRequest.START)
    dump = tmp_path / "dump.log"
    frames = [*recorded(stack, FrameIn), *(frame for frame in recorded(stack, FrameOut) if frame.sent)]
    lines = [f"({f.t_ns * 1e-9:.9f}) can0 {f.can_id:03X}#{f.data.hex()}" for f in sorted(frames, key=lambda f: f.t_ns)]
    dump.write_text("\n".join(lines) + "\n")
    drive = read_candump(dump, stack.core.config)
    wheels, poses, commands = (recorded(stack, kind)[-20:] for kind in (WheelSample, PoseSample, Command))
    left, right = drive.wheels.left_angle_rad[-20:], drive.wheels.right_angle_rad[-20:]
    assert left - left[0] == pytest.approx([w.left_angle_rad - wheels[0].left_angle_rad for w in wheels])
    assert right - right[0] == pytest.approx([w.right_angle_rad - wheels[0].right_angle_rad for w in wheels])
    assert drive.wheels.right_speed_rad_s[-20:] == pytest.approx([w.right_speed_rad_s for w in wheels])
    for name in ("x_m", "y_m", "yaw_rad"):
        assert getattr(drive.poses, name)[-20:] == pytest.approx([getattr(pose, name) for pose in poses])
    # An import knows of no other time than that of reception.
    late_s = (poses[-1].received_ns - wheels[-1].received_ns) * 1e-9 - 0.25
    assert drive.poses.t_s[-1] - drive.wheels.t_s[-1] == pytest.approx(late_s, abs=1e-6)
    # The last command of an import is followed by its end.
    assert drive.commands.left_rad_s[-21:-1] == pytest.approx([c.left_rad_s for c in commands], abs=1e-3)
    assert drive.commands.right_rad_s[-21:-1] == pytest.approx([c.right_rad_s for c in commands], abs=1e-3)
    assert drive.commands.right_rad_s[-2] == pytest.approx(1.5, abs=1e-3)
