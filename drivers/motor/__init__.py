"""Motor controllers, one file each, of which robot.toml's `link.driver` names one; see docs/add-a-motor-driver.md.

And how the wheels are wired to a controller's two sides, where that is not as it believes, for every driver: what its
own fields in [link], or the controller's settings, have right needs nothing here.
"""

from __future__ import annotations

import dataclasses
import pkgutil
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from drivers.types import (
    Driver,
    DriverState,
    DriverStats,
    Identity,
    Limits,
    MotorDriver,
    MotorSample,
    OutgoingFrame,
    Readings,
    ReceivedFrame,
    Request,
    WheelCommand,
    WheelSample,
)

DEFAULT = "reference"


class UnknownDriverError(ValueError):
    """No driver has this name; the message lists the names that there are."""


@cache
def motor_drivers() -> Mapping[str, MotorDriver]:
    """Return the drivers by name: the `DRIVER` of each module in this folder that has one.

    Found when first asked for, not on import: `find_driver` reads the one that is asked for, and an e-stop no other.
    """
    modules = (import_module(f"{__name__}.{name}") for name in _module_names())
    found: list[MotorDriver] = [module.DRIVER for module in modules if hasattr(module, "DRIVER")]
    return MappingProxyType({driver.name: driver for driver in sorted(found, key=lambda driver: driver.name)})


def find_driver(name: str | None) -> MotorDriver:
    """Return the driver of this name, the default one for None. Raises UnknownDriverError for a name not known."""
    requested = DEFAULT if name is None else name
    module = import_module(f"{__name__}.{requested}") if requested in _module_names() else None
    found: MotorDriver | None = getattr(module, "DRIVER", None)
    if found is None:
        raise UnknownDriverError(f'there is no driver "{name}"; write one of {", ".join(motor_drivers())}')
    return found


def _module_names() -> list[str]:
    """Return the modules of this folder; a driver's has its name."""
    return [each.name for each in pkgutil.iter_modules(__path__)]


def create_driver(name: str | None, settings: Any = None, key: bytes | None = None) -> Driver:
    """Make the driver that `link.driver` names, the default one for None.

    `settings`: of its type, None for its defaults. `key` (16 bytes): of authenticated mode. Raises UnknownDriverError.
    """
    found = find_driver(name)
    return found.make(found.settings() if settings is None else settings, key)


_Sign = Literal[-1, 1]


class Wiring(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Left before right, of the robot's real sides.

    `sides_swapped`: the controller's left drives the right wheels. `encoders_swapped`: the encoder of a wheel is on the
    other side than its motor. `motor_direction`, `encoder_direction`: -1 where forward is backward. `turn_ratio`: true
    turns of a wheel for each turn that the controller believes.
    """

    sides_swapped: bool = False
    encoders_swapped: bool = False
    motor_direction: tuple[_Sign, _Sign] = (1, 1)
    encoder_direction: tuple[_Sign, _Sign] = (1, 1)
    turn_ratio: Annotated[float, Meta(ge=0.01, le=100.0)] = 1.0

    def to_controller(self, left_rad_s: float, right_rad_s: float) -> tuple[float, float]:
        """Return the speeds to command of the controller's two sides for these true speeds of the wheels."""
        left, right = self.motor_direction[0] * left_rad_s, self.motor_direction[1] * right_rad_s
        if self.sides_swapped:
            left, right = right, left
        return left / self.turn_ratio, right / self.turn_ratio

    def from_controller(self, left_rad_s: float, right_rad_s: float) -> tuple[float, float]:
        """Return the true speeds of the wheels for which the controller's two sides are commanded these."""
        left, right = (right_rad_s, left_rad_s) if self.sides_swapped else (left_rad_s, right_rad_s)
        return self.motor_direction[0] * left * self.turn_ratio, self.motor_direction[1] * right * self.turn_ratio

    def true_wheels(self, sample: WheelSample) -> WheelSample:
        """Return the controller's sample for the true wheels."""
        angles = [sample.left_angle_rad, sample.right_angle_rad]
        speeds = [sample.left_speed_rad_s, sample.right_speed_rad_s]
        if self.sides_swapped != self.encoders_swapped:
            angles.reverse()
            speeds.reverse()
        left, right = (self.turn_ratio * direction for direction in self.encoder_direction)
        turned = (left * angles[0], right * angles[1], left * speeds[0], right * speeds[1])
        return WheelSample(sample.t_ns, sample.received_ns, *turned)


AS_CONFIGURED = Wiring()
# Limits of a controller that count its own turns; `ticks_per_rev` is of the controller on both sides.
_OF_WHEELS = ("max_wheel_speed_rad_s", "max_wheel_acceleration_rad_s2", "stop_deceleration_rad_s2")


class RewiredDriver:
    """A driver behind a wiring; satisfies `drivers.types.Driver`."""

    def __init__(self, driver: Driver, wiring: Wiring) -> None:
        self._driver = driver
        self._wiring = wiring

    @property
    def state(self) -> DriverState:
        """State of the wrapped driver with its robot."""
        return self._driver.state

    @property
    def detail(self) -> str:
        """Text of the wrapped driver on why the state is what it is."""
        return self._driver.detail

    @property
    def identity(self) -> Identity | None:
        """Identity of the controller, from the wrapped driver."""
        return self._driver.identity

    @property
    def limits(self) -> Limits | None:
        """Limits of the controller, from the wrapped driver, in true turns of the wheels."""
        limits = self._driver.limits
        if limits is None:
            return None
        of_wheels = {
            name: dataclasses.replace(limit, value=self._wiring.turn_ratio * limit.value)
            for name, limit in limits.known().items()
            if name in _OF_WHEELS
        }
        return dataclasses.replace(limits, **of_wheels)

    @property
    def stats(self) -> DriverStats:
        """Counters of the wrapped driver."""
        return self._driver.stats

    @property
    def clock_offset_ns(self) -> int | None:
        """Offset from the controller's clock to the host's monotonic clock, in ns, from the wrapped driver."""
        return self._driver.clock_offset_ns

    @property
    def is_stop_over(self) -> bool:
        """Whether the stop of the wrapped driver is over."""
        return self._driver.is_stop_over

    def link_up(self, now_ns: int) -> None:
        """Tell the wrapped driver that the link is up."""
        self._driver.link_up(now_ns)

    def link_down(self, now_ns: int) -> None:
        """Tell the wrapped driver that the link is down."""
        self._driver.link_down(now_ns)

    def request(self, request: Request) -> None:
        """Pass a request to the wrapped driver."""
        self._driver.request(request)

    def release(self, why: str) -> None:
        """Pass a release to the wrapped driver."""
        self._driver.release(why)

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Return the wrapped driver's e-stop frames, which are the same for any wiring."""
        return self._driver.estop(now_ns)

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Return the readings of the wrapped driver, with the wheels as they are wired."""
        readings = self._driver.receive(now_ns, frames)
        return msgspec.structs.replace(
            readings,
            wheels=tuple(self._wiring.true_wheels(sample) for sample in readings.wheels),
            motors=tuple(self._motors(sample) for sample in readings.motors),
        )

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Frames due now, with the command for the sides as they are wired."""
        if command is not None:
            sides = self._wiring.to_controller(command.left_rad_s, command.right_rad_s)
            command = WheelCommand(*sides, command.valid_for_s)
        return self._driver.transmit(now_ns, command)

    def _motors(self, sample: MotorSample) -> MotorSample:
        if not self._wiring.sides_swapped:
            return sample
        return MotorSample(
            sample.t_ns,
            sample.right_current_a,
            sample.left_current_a,
            sample.right_temperature_c,
            sample.left_temperature_c,
        )


def rewired(driver: Driver, wiring: Wiring) -> Driver:
    """Return the driver for wheels that are wired so; the driver itself where nothing is to be changed."""
    return driver if wiring == AS_CONFIGURED else RewiredDriver(driver, wiring)
