"""What the simulator runs: a robot seen through frames, whatever its controller; and the one with a vendor's.

That one has the plant, a byte-level simulator and a pose sensor of its own, whose poses leave by `pose_sink`, as a
vendor's controller sends none. A side whose motor is released rolls on: it is given its own speed, a little less of it
in each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareInputs, FirmwareOutputs, ResetCause
from sim.can_frame import CanFrame
from sim.faults import RobotFaults
from sim.plant import Plant, TrueState
from sim.sensors import PoseMeasurement


class Robot(Protocol):
    """Satisfied by `sim.virtual_robot.VirtualRobot` and `sim.robot.VendorRobot`; pure, stepped at 1 kHz."""

    plant: Plant
    estop_button: bool
    faults: RobotFaults | None

    @property
    def now_us(self) -> int:
        """Robot time of the last step."""

    @property
    def outputs(self) -> FirmwareOutputs:
        """What the controller wanted in the last cycle."""

    @property
    def truth(self) -> TrueState:
        """The plant's true state at the last step."""

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame from the link, at robot time `now_us`."""

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us`; return the frames that the controller sends, in order."""

    def kidnap(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Carry the robot off."""

    def jump_clock(self, step_us: int) -> None:
        """Set the controller's clock."""

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the controller."""


def sensor_inputs(
    plant: Plant, estop_button: bool, error_counters: tuple[int, int], reset_cause: ResetCause
) -> FirmwareInputs:
    """What a controller's sensors say of the plant, its button and its link (transmit and receive errors) now."""
    left_ticks, right_ticks = plant.encoder_ticks
    left_speed, right_speed = plant.measured_wheel_speeds_rad_s
    left_current, right_current = plant.motor_currents_a
    left_temperature, right_temperature = plant.motor_temperatures_c
    battery = plant.battery
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
    def state(self) -> str:
        """In one word, for the truth record."""

    @property
    def obeyed(self) -> int:
        """How many speed commands it has taken."""

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; return the replies."""

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond with what the sensors say; return the frames that it sends."""

    def restart(self) -> None:
        """Switch off and on."""


class VendorRobot:
    """Satisfies `sim.robot.Robot`. `pose_sink` gets each measured pose and the robot time (us) at which it is there."""

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        pose_sink: Callable[[PoseMeasurement, int], None] | None = None,
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.estop_button = False
        self.faults: RobotFaults | None = None
        self.pose_sink = pose_sink
        self._coasting = [0.0, 0.0]
        self._replies: list[CanFrame] = []

    @property
    def now_us(self) -> int:
        """Robot time of the last step."""
        return self.plant.now_us

    @property
    def truth(self) -> TrueState:
        """The plant's true state at the last step."""
        return self.plant.truth

    @property
    def outputs(self) -> FirmwareOutputs:
        """What the controller wants now, in the words of the reference firmware."""
        left, right = self.controller.wheels_rad_s
        driven = left is not None or right is not None
        return FirmwareOutputs(
            left or 0.0, right or 0.0, driven, self.controller.brakes, False, self.controller.state, 0, 0, "NONE",
            "NONE", self.controller.obeyed, 0, 0, 0, 0,
        )  # fmt: skip

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame from the link, at robot time `now_us`; the replies leave with the next step."""
        self._replies += self.controller.receive(now_us, CanFrame(frame.can_id, frame.data, frame.extended))

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us` and run one cycle; return the frames that the controller sends, in order."""
        plant, faults = self.plant, self.faults
        wanted = self.controller.wheels_rad_s
        asked = self._setpoints(wanted)
        turned = asked if faults is None else faults.setpoints(*asked)
        enabled = wanted != (None, None)
        poses: Sequence[PoseMeasurement] = plant.step(now_us, *turned, enabled, self.controller.brakes)
        if faults is not None:
            poses = faults.poses(now_us, poses)
        if self.pose_sink is not None:
            for pose in poses:
                self.pose_sink(pose, now_us)
        inputs = sensor_inputs(plant, self.estop_button, error_counters, ResetCause.POWER_ON)
        if faults is not None:
            inputs = faults.inputs(inputs, asked, enabled)
        frames, self._replies = [*self._replies, *self.controller.step(now_us, inputs)], []
        return [Frame(frame.can_id, frame.data, frame.extended) for frame in frames]

    def kidnap(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Carry the robot off: a step in the world frame and a turn about the tracked point, wheels untouched."""
        self.plant.kidnap(dx_m, dy_m, dyaw_rad)

    def jump_clock(self, step_us: int) -> None:
        """Nothing: these controllers tell no time."""

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Restart the controller: it forgets everything, and the wheels roll until it is told again."""
        self.controller.restart()

    def _setpoints(self, wanted: tuple[float | None, float | None]) -> tuple[float, float]:
        """What the plant is given: a side that is released beside one that is driven keeps its own speed."""
        truth = self.plant.truth
        given = []
        for side, (speed, own) in enumerate(
            zip(wanted, (truth.left_speed_rad_s, truth.right_speed_rad_s), strict=True)
        ):
            if speed is not None:
                self._coasting[side] = own
                given.append(speed)
            else:
                self._coasting[side] *= 1.0 - 1e-3 / COASTING_S
                given.append(self._coasting[side])
        return given[0], given[1]
