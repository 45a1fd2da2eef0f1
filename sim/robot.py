"""What the simulator runs: a robot seen through frames, whatever its controller."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareInputs, FirmwareOutputs, ResetCause
from sim.faults import RobotFaults
from sim.plant import Plant, TrueState


class Robot(Protocol):
    """Satisfied by `sim.virtual_robot.VirtualRobot` and `sim.vendor_robot.VendorRobot`; pure, stepped at 1 kHz."""

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
