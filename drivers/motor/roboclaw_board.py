"""What is known of one RoboClaw board, by the questions that it has answered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.motor import roboclaw_protocol as protocol
from drivers.motor import vendor_parts as parts

_ESTOP, _ERRORS = 0x1, 0xFFFF
_WORDS = {
    0x2: "it is too hot",
    0x4: "it is too hot",
    0x8: "the main supply's voltage is too high",
    0x10: "the logic supply's voltage is too high",
    0x20: "the logic supply's voltage is too low",
    0x40: "the power stage of motor 1 failed",
    0x80: "the power stage of motor 2 failed",
    0x100: "motor 1 does not keep its speed",
    0x200: "motor 2 does not keep its speed",
    0x1000: "motor 1 takes too much current",
    0x2000: "motor 2 takes too much current",
    0x4000: "the main supply's voltage is too low",
    0x8000: "the main supply's voltage is too high",
}
TO_KNOW = ("version", "velocity_pid_m1", "velocity_pid_m2", "status", "serial_timeout", "speeds", "encoders")


@dataclass(slots=True)
class Board:
    """What is known of one board, by question; `turned` of both motors.

    `stopped`: it has taken a stop since the last command. `waits_ns`: since when it has not answered, `refuses_ns`
    since when it has taken no command.
    """

    address: int
    known: dict[str, Mapping[str, protocol.Value]] = field(default_factory=dict)
    turned: tuple[parts.Odometer, parts.Odometer] = field(default_factory=lambda: (parts.Odometer(), parts.Odometer()))
    stopped: bool = False
    zeros: int = 0
    waits_ns: int | None = None
    refuses_ns: int | None = None

    @property
    def errors(self) -> int:
        """The bits of its status that are no warnings."""
        return int(self.known["status"]["status_u32"]) & _ERRORS if "status" in self.known else 0

    @property
    def timeout_ds(self) -> int | None:
        """Its serial timeout as read last, in steps of 0.1 s."""
        return int(self.known["serial_timeout"]["timeout_ds"]) if "serial_timeout" in self.known else None

    @property
    def fastest_counts_s(self) -> float:
        """What both motors can do at full duty."""
        return float(min(int(self.known[f"velocity_pid_m{motor}"]["qpps"]) for motor in (1, 2)))

    @property
    def speeds(self) -> tuple[float, float]:
        """As measured, in counts/s."""
        read = self.known["speeds"]
        return float(read["speed_m1"]), float(read["speed_m2"])

    @property
    def is_known(self) -> bool:
        """Whether it has answered all that must be known of it."""
        return all(name in self.known for name in TO_KNOW)

    @property
    def is_pressed(self) -> bool:
        """Whether its e-stop input is, or was and is latched."""
        return bool(self.errors & _ESTOP)

    @property
    def error_words(self) -> str:
        """Its first error, for a person."""
        if self.is_pressed:
            return f"board {self.address}: its e-stop input is pressed"
        bit = self.errors & -self.errors
        return f"board {self.address}: {_WORDS.get(bit, f'error {self.errors:#06x}')}"

    def take_counts(self, read: Mapping[str, protocol.Value], t_ns: int, looked_ns: int) -> bool:
        """Whether its motors can have turned so far since they were counted last."""
        if not {"velocity_pid_m1", "velocity_pid_m2"} <= self.known.keys():
            return True
        first, second = self.turned
        fastest = 1.5 * self.fastest_counts_s
        is_first_plausible = first.take_wrapping(int(read["encoder_m1"]), t_ns, looked_ns, fastest, 100.0)
        return second.take_wrapping(int(read["encoder_m2"]), t_ns, looked_ns, fastest, 100.0) and is_first_plausible

    def meet_anew(self) -> None:
        """Nothing is known of it but what its motors have turned."""
        self.known, self.waits_ns = {}, None
        for motor in self.turned:
            motor.begin_anew()
