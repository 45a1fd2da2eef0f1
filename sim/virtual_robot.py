"""The robot as the host sees it, through frames: a plant with the reference firmware core, or a vendor's controller.

Pure: call `step` at 1 kHz of robot time and carry the frames to and fro. The reference core runs on its controller's
own clock; `TruthRecorder` writes the truth that the host does not see, as CSV for scoring. A vendor's controller is a
byte-level simulator, and its robot has a pose sensor of its own, whose poses leave by `pose_sink`, as the controller
sends none. A side whose motor is released rolls on: it is given its own speed, a little less of it in each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from drivers.transport import connect_pair
from drivers.types import Exchange, Frame, OutgoingFrame, Transport
from firmware_protocol.firmware_core import (
    FirmwareConfig,
    FirmwareCore,
    FirmwareInputs,
    FirmwareOutputs,
    ResetCause,
    random_entropy,
)
from sim.can_protocol import CanFrame
from sim.encoder_loop import EncoderLoop
from sim.injected_faults import RobotFaults
from sim.plant import Plant, TrueState
from sim.process import TextRecord
from sim.sensors import PoseMeasurement


class Robot(Protocol):
    """A plant with its controller, at the plant's time; pure, stepped at 1 kHz."""

    plant: Plant
    estop_button: bool
    faults: RobotFaults

    @property
    def outputs(self) -> FirmwareOutputs:
        """Outputs of the controller in the last cycle."""

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame from the link, at robot time `now_us`."""

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us`; return the frames that the controller sends, in order."""

    def jump_clock(self, step_us: int) -> None:
        """Set the controller's clock."""

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the robot's controller."""


def sensor_inputs(
    plant: Plant, estop_button: bool, error_counters: tuple[int, int], reset_cause: ResetCause
) -> FirmwareInputs:
    """Return the inputs of a controller now: its sensors, button, and link (transmit and receive errors)."""
    left_ticks, right_ticks = plant.encoder_ticks
    left_speed, right_speed = plant.measured_wheel_speeds_rad_s
    left_current, right_current = plant.electrics.motor_currents_a
    left_temperature, right_temperature = plant.electrics.motor_temperatures_c
    battery = plant.electrics.battery
    return FirmwareInputs(
        left_ticks=left_ticks,
        right_ticks=right_ticks,
        left_speed_rad_s=left_speed,
        right_speed_rad_s=right_speed,
        left_current_a=left_current,
        right_current_a=right_current,
        left_temperature_c=left_temperature,
        right_temperature_c=right_temperature,
        voltage_v=battery.voltage_v,
        battery_current_a=battery.current_a,
        battery_temperature_c=battery.temperature_c,
        tx_error_count=error_counters[0],
        rx_error_count=error_counters[1],
        estop_button=estop_button,
        reset_cause=reset_cause,
    )


COASTING_S = 0.6
"""A released wheel of a robot on the floor slows down so: to a third in this time."""


class Controller(Protocol):
    """A vendor's motor controllers, all that one robot has; wheel speeds and ticks are those of the wheels."""

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The speeds that the motors hold, left and right; None for one that is released and coasts."""

    @property
    def brakes(self) -> bool:
        """Whether the motors brake by themselves."""

    @property
    def regulates(self) -> bool:
        """Whether its speed loops run; without them a motor has a fixed duty, is released or braked."""

    def create_loop(self) -> EncoderLoop:
        """Return the motor loops at rest, as they are with an encoder that reports wrongly."""

    @property
    def state(self) -> str:
        """State in one word, for the truth record."""

    @property
    def obeyed(self) -> int:
        """Number of speed commands accepted since power-on."""

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; return the replies."""

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond with what the sensors say; return the frames that it sends."""

    def restart(self) -> None:
        """Switch off and on."""


class VendorRobot:
    """Virtual robot with a vendor's controllers.

    `pose_sink` gets each measured pose and the robot time (us) at which it is there.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        pose_sink: Callable[[PoseMeasurement, int], None] | None = None,
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.estop_button = False
        self.faults = RobotFaults()
        self.pose_sink = pose_sink
        self._coasting = [0.0, 0.0]
        self._loop = controller.create_loop()
        self._replies: list[CanFrame] = []

    @property
    def outputs(self) -> FirmwareOutputs:
        """Outputs of the controller now, in the terms of the reference firmware."""
        left, right = self.controller.wheels_rad_s
        driven = left is not None or right is not None
        state, accepted = self.controller.state, self.controller.obeyed
        return FirmwareOutputs(
            left or 0.0, right or 0.0, driven, self.controller.brakes, False, state, accepted_commands=accepted
        )

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame from the link, at robot time `now_us`; the replies leave with the next step."""
        self._replies += self.controller.receive(now_us, CanFrame(frame.can_id, frame.data, frame.extended))

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us` and run one cycle; return the frames that the controller sends, in order."""
        plant, faults = self.plant, self.faults
        wheels, regulates = self.controller.wheels_rad_s, self.controller.regulates
        setpoints = self._setpoints(wheels)
        driven = self._loop.drive(setpoints) if regulates else setpoints
        turned = faults.setpoints(*driven, is_driven=regulates)
        enabled = wheels != (None, None)
        dt_s = 1e-6 * (now_us - plant.now_us)
        poses = faults.poses(now_us, plant.step(now_us, *turned, enabled, self.controller.brakes))
        if self.pose_sink is not None:
            for pose in poses:
                self.pose_sink(pose, now_us)
        true = sensor_inputs(plant, self.estop_button, error_counters, ResetCause.POWER_ON)
        inputs = faults.inputs(true, setpoints, enabled)
        self._loop.see(setpoints, true, inputs, dt_s, regulates)
        frames, self._replies = [*self._replies, *self.controller.step(now_us, inputs)], []
        return [Frame(frame.can_id, frame.data, frame.extended) for frame in frames]

    def jump_clock(self, step_us: int) -> None:
        """Do nothing, because these controllers send no time."""

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the controllers, which lose their state; the wheels roll until the next command."""
        self.controller.restart()

    def _setpoints(self, wheels: tuple[float | None, float | None]) -> tuple[float, float]:
        """Return the plant's setpoints (rad/s); a released side beside a driven one keeps its own speed."""
        given = []
        for side, (speed, own) in enumerate(zip(wheels, self.plant.wheel_speeds_rad_s, strict=True)):
            if speed is not None:
                self._coasting[side] = own
                given.append(speed)
            else:
                self._coasting[side] *= 1.0 - 1e-3 / COASTING_S
                given.append(self._coasting[side])
        return given[0], given[1]


# A cycle of the firmware core (cycle_us of robot_config.c).
STEP_US = 1000
# Chosen: keeps the controller's clock away from 0, before which it has no times.
EARLIEST_JUMP_US = 10_000_000
_RELEASED = FirmwareOutputs(0.0, 0.0, False, True, False, "BOOT")
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
# Chosen: what a crash may lose of the record; more often writes more.
FLUSH_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ControllerClock:
    """The controller's microsecond counter: `start_us` at robot time 0, `skew_ppm` too fast."""

    start_us: int = 1_234_567_890
    skew_ppm: float = 40.0

    def at(self, robot_us: int) -> int:
        """Return the counter's value (us) at robot time `robot_us`."""
        return self.start_us + robot_us + round(robot_us * self.skew_ppm * 1e-6)


class VirtualRobot:
    """A plant driven by the firmware core, seen through frames.

    Robot time is true microseconds since the robot was switched on, the plant's time. The motor driver takes the
    firmware's setpoints, its enable and its brake one cycle later. `estop_button` is the state of the button on the
    robot; `faults` stands between plant and firmware. At each start the controller draws its
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
        self.faults = RobotFaults()
        self._config = config
        self._clock = clock or ControllerClock()
        self._clock_start_us = 0
        self._challenge_seed = challenge_seed
        self._reset_cause = ResetCause.POWER_ON
        self._entropy = self._draw_entropy()
        self._firmware = FirmwareCore(config, self._entropy)
        self._outputs = _RELEASED

    @property
    def outputs(self) -> FirmwareOutputs:
        """Outputs of the firmware in the last cycle."""
        return self._outputs

    @property
    def firmware(self) -> FirmwareCore:
        """The controller's program, for its counters."""
        return self._firmware

    def device_us(self, robot_us: int) -> int:
        """Return the time (us) of the controller's clock at robot time `robot_us`."""
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
        setpoints = (outputs.left_setpoint_rad_s, outputs.right_setpoint_rad_s)
        turned = faults.setpoints(*setpoints, is_driven=outputs.driver_enabled)
        for pose in faults.poses(now_us, plant.step(now_us, *turned, outputs.driver_enabled, outputs.brake)):
            if pose.sample_us < self._clock_start_us:
                # The controller's clock has no name for a time before it started.
                continue
            self._firmware.pose(
                pose.x_m, pose.y_m, pose.yaw_rad, self.device_us(pose.sample_us), pose.position_std_m, pose.yaw_std_rad
            )
        inputs = sensor_inputs(plant, self.estop_button, error_counters, self._reset_cause)
        inputs = faults.inputs(inputs, setpoints, outputs.driver_enabled)
        self._outputs = self._firmware.step(self.device_us(now_us), inputs)
        return [Frame(can_id, data) for can_id, data in self._firmware.drain()]

    def jump_clock(self, step_us: int) -> None:
        """Set the controller's clock forward, or back, though never to before its tenth second."""
        largest_us = max(0, self.device_us(self.plant.now_us) - EARLIEST_JUMP_US)
        self._clock = ControllerClock(self._clock.start_us + max(step_us, -largest_us), self._clock.skew_ppm)

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the controller, which loses its state: its clock begins again, the wheels brake until it is up."""
        last_entropy, self._entropy = self._entropy, self._draw_entropy()
        self._reset_cause = cause
        self._clock_start_us = self.plant.now_us
        self._clock = ControllerClock(0, self._clock.skew_ppm)
        self._firmware = FirmwareCore(self._config, self._entropy, last_entropy)
        self._outputs = _RELEASED

    def _draw_entropy(self) -> int:
        if self._challenge_seed is None:
            return random_entropy()
        self._challenge_seed += 1
        return self._challenge_seed


def truth_row(robot: Robot, t_ns: int) -> str:
    """Return the values of `TRUTH_COLUMNS` at the last step, at the monotonic time `t_ns`, separated by commas."""
    truth, outputs = robot.plant.truth, robot.outputs
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


# A century and more: these frames have no deadline.
_FOREVER_NS = 1 << 62


class RobotInProcess:
    """A virtual robot on an in-process link; `host` is the host's end of it, open, and `link` the robot's.

    Time begins at 0 and moves on by `advance` alone. `board` may be exchanged for another one between two steps.
    `exchange`: how a vendor's controllers are asked on a half-duplex line; a reply is there before the next request.
    `step_us`: period of the controller, which for the reference firmware is its configuration's.
    """

    def __init__(
        self, board: VirtualRobot | VendorRobot, exchange: Exchange | None = None, step_us: int = STEP_US
    ) -> None:
        host, self.link = connect_pair()
        self.host: Transport = host
        self.board = board
        self._exchange = exchange
        self._step_us = step_us
        host.open()
        self.link.open()
        self._now_us = 0

    @property
    def truth(self) -> TrueState:
        """The true state of the plant now."""
        return self.board.plant.truth

    def advance(self, until_us: int) -> None:
        """Let time pass until then; frames wait at both ends."""
        while self._now_us < until_us:
            self._now_us += self._step_us
            for received in self.link.receive():
                self._receive(received.frame)
            for frame in self.board.step(self._now_us):
                self._send(frame)

    def _receive(self, frame: Frame) -> None:
        if self._exchange is None:
            self.board.receive(self._now_us, frame)
            return
        assert isinstance(self.board, VendorRobot)
        frames = self.board.controller.receive(self._now_us, CanFrame(0, self._exchange.request(frame)))
        reply = self._exchange.reply(frame, b"".join(each.data for each in frames))
        if reply is not None:
            self._send(reply)

    def _send(self, frame: Frame) -> None:
        self.link.send(OutgoingFrame(frame, _FOREVER_NS), self._now_us * 1000)
