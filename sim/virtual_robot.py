"""The robot as the host sees it: the plant, the reference firmware core on its controller, and the controller's clock.

Pure: call `VirtualRobot.step` at 1 kHz of robot time and carry the frames to and fro. `TruthRecorder` writes the truth
that the host does not see, as CSV for scoring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.types import Frame
from firmware_protocol.firmware_core import (
    FirmwareConfig,
    FirmwareCore,
    FirmwareOutputs,
    ResetCause,
    drawn_entropy,
)
from sim.faults import RobotFaults
from sim.plant import Plant, TrueState
from sim.process import TextRecord
from sim.robot import Robot, sensor_inputs
from sim.sensors import PoseMeasurement

STEP_US = 1000
EARLIEST_JUMP_US = 10_000_000
_RELEASED = FirmwareOutputs(0.0, 0.0, False, True, False, "BOOT", 0, 0, "NONE", "NONE", 0, 0, 0, 0, 0)
TRUTH_COLUMNS = (
    "t_ns",
    "x_m",
    "y_m",
    "yaw_rad",
    "left_speed_rad_s",
    "right_speed_rad_s",
    "left_setpoint_rad_s",
    "right_setpoint_rad_s",
    "speed_m_s",
    "yaw_rate_rad_s",
    "state",
    "driver_enabled",
    "brake",
    "session",
    "accepted_commands",
    "fault",
)
FLUSH_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ControllerClock:
    """The controller's microsecond counter: `start_us` at robot time 0, `skew_ppm` too fast."""

    start_us: int = 1_234_567_890
    skew_ppm: float = 40.0

    def at(self, robot_us: int) -> int:
        """What the counter shows at robot time `robot_us`."""
        return self.start_us + robot_us + round(robot_us * self.skew_ppm * 1e-6)


class VirtualRobot:
    """A plant driven by the firmware core, seen through frames.

    Robot time is true microseconds since the robot was switched on, the plant's time. The motor driver takes the
    firmware's setpoints, its enable and its brake one cycle later. `estop_button` is the state of the button on the
    robot; `faults`, if there is one, stands between plant and firmware. At each start the controller draws its
    challenges from the system's entropy, as a real one must; with a `challenge_seed` every run has the same ones, and
    whoever has recorded one run can replay it in the next: for tests alone.
    """

    def __init__(
        self,
        plant: Plant,
        config: FirmwareConfig,
        clock: ControllerClock | None = None,
        challenge_seed: int | None = None,
    ) -> None:
        self.plant = plant
        self.estop_button = False
        self.faults: RobotFaults | None = None
        self._config = config
        self._clock = clock or ControllerClock()
        self._clock_start_us = 0
        self._challenge_seed = challenge_seed
        self._reset_cause = ResetCause.POWER_ON
        self._entropy = self._draw_entropy()
        self._firmware = FirmwareCore(config, self._entropy)
        self._outputs = _RELEASED

    @property
    def now_us(self) -> int:
        """Robot time of the last step."""
        return self.plant.now_us

    @property
    def outputs(self) -> FirmwareOutputs:
        """What the firmware wanted in the last cycle."""
        return self._outputs

    @property
    def firmware(self) -> FirmwareCore:
        """The controller's program, for its counters."""
        return self._firmware

    @property
    def truth(self) -> TrueState:
        """The plant's true state at the last step."""
        return self.plant.truth

    def device_us(self, robot_us: int) -> int:
        """What the controller's clock shows at robot time `robot_us`."""
        return self._clock.at(robot_us - self._clock_start_us)

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame from the link, at robot time `now_us`; the controller's filters let no 29-bit identifier in."""
        if frame.extended:
            return
        self._firmware.receive(self.device_us(now_us), frame.can_id, frame.data)

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us` and run one firmware cycle; return the frames that it sends, in order.

        error_counters: transmit and receive error counter of the link's controller. Raises ValueError if time would go
        backwards.
        """
        plant = self.plant
        outputs, faults = self._outputs, self.faults
        asked = turned = (outputs.left_setpoint_rad_s, outputs.right_setpoint_rad_s)
        if faults is not None:
            turned = faults.setpoints(*asked)
        poses: Sequence[PoseMeasurement] = plant.step(now_us, *turned, outputs.driver_enabled, outputs.brake)
        if faults is not None:
            poses = faults.poses(now_us, poses)
        for pose in poses:
            if pose.sample_us < self._clock_start_us:
                # The controller's clock has no name for a time before it started.
                continue
            self._firmware.pose(
                pose.x_m, pose.y_m, pose.yaw_rad, self.device_us(pose.sample_us), pose.position_std_m, pose.yaw_std_rad
            )
        inputs = sensor_inputs(plant, self.estop_button, error_counters, self._reset_cause)
        if faults is not None:
            inputs = faults.inputs(inputs, asked, outputs.driver_enabled)
        self._outputs = self._firmware.step(self.device_us(now_us), inputs)
        return [Frame(can_id, data) for can_id, data in self._firmware.drain()]

    def kidnap(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Carry the robot off: a step in the world frame and a turn about the tracked point, wheels untouched."""
        self.plant.kidnap(dx_m, dy_m, dyaw_rad)

    def jump_clock(self, step_us: int) -> None:
        """Set the controller's clock forward, or back, though never to before its tenth second."""
        largest_us = max(0, self.device_us(self.now_us) - EARLIEST_JUMP_US)
        self._clock = ControllerClock(self._clock.start_us + max(step_us, -largest_us), self._clock.skew_ppm)

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the controller: it forgets everything, its clock begins anew, the wheels brake until it is up."""
        last_entropy, self._entropy = self._entropy, self._draw_entropy()
        self._reset_cause = cause
        self._clock_start_us = self.plant.now_us
        self._clock = ControllerClock(0, self._clock.skew_ppm)
        self._firmware = FirmwareCore(self._config, self._entropy, last_entropy)
        self._outputs = _RELEASED

    def _draw_entropy(self) -> int:
        if self._challenge_seed is None:
            return drawn_entropy()
        self._challenge_seed += 1
        return self._challenge_seed


def truth_row(robot: Robot, t_ns: int) -> str:
    """The values of `TRUTH_COLUMNS` at the last step, which was at the monotonic time `t_ns`, separated by commas."""
    truth, outputs = robot.truth, robot.outputs
    return (
        f"{t_ns},{truth.x_m:.6f},{truth.y_m:.6f},{truth.yaw_rad:.6f},"
        f"{truth.left_speed_rad_s:.5f},{truth.right_speed_rad_s:.5f},"
        f"{outputs.left_setpoint_rad_s:.5f},{outputs.right_setpoint_rad_s:.5f},"
        f"{truth.speed_m_s:.6f},{truth.yaw_rate_rad_s:.6f},{outputs.state},"
        f"{int(outputs.driver_enabled)},{int(outputs.brake)},{outputs.session},{outputs.accepted_commands},{outputs.fault}"
    )


class TruthRecorder:
    """Writes `TRUTH_COLUMNS` as CSV; what is older than a second is on disk."""

    def __init__(self, record: TextRecord) -> None:
        self._record = record
        record.line(",".join(TRUTH_COLUMNS))
        record.flush()
        self._flushed_ns = 0

    def record(self, robot: Robot, t_ns: int) -> None:
        """Write the state of the last step, which was at the monotonic time `t_ns`."""
        self._record.line(truth_row(robot, t_ns))
        if t_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = t_ns
            self._record.flush()
