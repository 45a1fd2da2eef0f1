"""Drives as wheel-speed commands over time: the way a person drives, and protocols; seeded.

Speeds are fractions of the robot's largest wheel speed. A drive is built from manoeuvres; between them the robot rests,
and every change goes through the driver's hand, which is not infinitely fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

LARGEST_RAD_S, RATE_HZ = 8.0, 50.0
"""Largest wheel speed, and how often commands are given."""
REST_S = 0.6
HAND_RAD_S2 = (8.0, 14.0)
SHARP_RAD_S2 = 20.0
TREMOR = 0.012
TREMOR_S = 0.4

Floats = npt.NDArray[np.float64]
Profile = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class ScriptedDrive:
    """Commands held from their time until the next one.

    t_s, left_rad_s, right_rad_s: shape (n,), times from 0 in equal steps of `period_s`; phase: what each is for.
    """

    name: str
    period_s: float
    t_s: Floats
    left_rad_s: Floats
    right_rad_s: Floats
    phase: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """From the first command to the end of the last one."""
        return len(self.t_s) * self.period_s


class _Tape:
    """Collects wanted speeds (fractions: common, difference / 2) and turns them into commands of a human hand."""

    def __init__(self, generator: np.random.Generator) -> None:
        self.generator = generator
        self._desired: list[Floats] = []
        self._slew: list[Floats] = []
        self._phase: list[str] = []

    def about(self, value: float, spread: float = 0.1) -> float:
        """The value as a person hits it: off by up to this share."""
        return value * float(self.generator.uniform(1.0 - spread, 1.0 + spread))

    def play(self, phase: str, seconds: float, speed: Profile, turn: Profile, sharp: bool = False) -> None:
        """Append a manoeuvre given as functions of the time since its start (s)."""
        count = max(round(seconds * RATE_HZ), 1)
        t = np.arange(count) / RATE_HZ
        self._desired.append(np.stack([speed(t), turn(t)], axis=1))
        slew = SHARP_RAD_S2 if sharp else float(self.generator.uniform(*HAND_RAD_S2))
        self._slew.append(np.full(count, slew))
        self._phase += [phase] * count

    def hold(self, phase: str, seconds: float, speed: float, turn: float, sharp: bool = False) -> None:
        """Append a phase of constant speeds."""
        self.play(phase, seconds, _constant(speed), _constant(turn), sharp)

    def rest(self, seconds: float = REST_S) -> None:
        """Append a phase of standstill."""
        self.hold("rest", seconds, 0.0, 0.0)

    def drive(self, name: str, steady: bool = False) -> ScriptedDrive:
        """Put wanted speeds through the hand: tremor (unless `steady`), limits, and the slew of each manoeuvre."""
        desired = np.concatenate(self._desired)
        if not steady:
            desired = desired * (1.0 + self._tremor(desired.shape))
        largest = LARGEST_RAD_S
        wheels = largest * np.stack([desired[:, 0] - desired[:, 1], desired[:, 0] + desired[:, 1]], axis=1)
        wheels *= np.minimum(1.0, largest / np.maximum(np.abs(wheels).max(axis=1, keepdims=True), 1e-9))
        steps = np.concatenate(self._slew) / RATE_HZ
        commands = np.zeros(wheels.shape)
        now = np.zeros(2)
        for k, (target, step) in enumerate(zip(wheels, steps, strict=True)):
            now = now + np.clip(target - now, -step, step)
            commands[k] = now
        period_s = 1.0 / RATE_HZ
        t_s = np.arange(len(commands), dtype=np.float64) * period_s
        return ScriptedDrive(name, period_s, t_s, commands[:, 0], commands[:, 1], tuple(self._phase))

    def _tremor(self, shape: tuple[int, ...]) -> Floats:
        decay = math.exp(-1.0 / (TREMOR_S * RATE_HZ))
        noise = self.generator.standard_normal(shape)
        for k in range(1, shape[0]):
            noise[k] = decay * noise[k - 1] + math.sqrt(1.0 - decay**2) * noise[k]
        return TREMOR * noise


def _constant(value: float) -> Profile:
    return lambda t: np.full(len(t), value)


def _swing(amplitude: float, frequency_hz: float) -> Profile:
    return lambda t: amplitude * np.sin(2.0 * math.pi * frequency_hz * t)


def _there_and_back(top: float, seconds: float) -> Profile:
    """From -top evenly to +top and back, through zero twice."""
    return lambda t: top * (1.0 - 2.0 * np.abs(2.0 * t / seconds - 1.0))


def _straights(tape: _Tape) -> None:
    for phase, seconds, speed in (
        ("straight slow", 3.0, 0.35),
        ("straight fast", 2.5, 0.95),
        ("reverse slow", 3.0, -0.35),
        ("reverse fast", 2.5, -0.8),
    ):
        tape.hold(phase, tape.about(seconds), tape.about(speed, 0.05), 0.0)
        tape.rest()


def _spins(tape: _Tape) -> None:
    rates = [("slow", 0.28), ("fast", 0.65)]
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        for name, rate in rates:
            tape.hold(f"spin {side} {name}", tape.about(2.6), 0.0, sign * tape.about(rate))
            tape.rest()


def _arcs(tape: _Tape) -> None:
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        for name, speed, turn in (("slow", 0.35, 0.14), ("fast", 0.65, 0.26), ("reverse", -0.4, 0.17)):
            tape.hold(f"arc {side} {name}", tape.about(3.6), tape.about(speed), sign * tape.about(turn))
            tape.rest()


def _start_stops(tape: _Tape) -> None:
    for number in range(8):
        direction = -1.0 if number % 4 == 3 else 1.0
        tape.hold("start", tape.about(0.8), direction * tape.about(0.7), 0.0, sharp=True)
        tape.hold("stop", tape.about(0.6), 0.0, 0.0, sharp=True)


def _weave(tape: _Tape) -> None:
    for speed in (0.4, 0.6):
        swing = _swing(tape.about(0.3), tape.about(0.5, 0.2))
        tape.play("fast steering", tape.about(7.0), _constant(speed), swing, sharp=True)
        tape.rest()


def _ramps(tape: _Tape) -> None:
    zero = _constant(0.0)
    for phase in ("ramp straight", "ramp spin"):
        seconds = tape.about(8.0)
        ramp = _there_and_back(tape.about(0.3), seconds)
        speed, turn = (ramp, zero) if phase == "ramp straight" else (zero, ramp)
        tape.play(phase, seconds, speed, turn)
        tape.rest()


def _free(tape: _Tape, seconds: float = 15.0) -> None:
    """A person with a stick: a new wish every second or so, sometimes letting go."""
    end_s = 0.0
    while end_s < seconds:
        wish_s = float(tape.generator.uniform(0.4, 2.2))
        if tape.generator.random() < 0.12:
            tape.hold("free", wish_s, 0.0, 0.0)
        else:
            speed = float(tape.generator.choice([1.0, 1.0, 1.0, -1.0]) * tape.generator.uniform(0.1, 0.8))
            turn = float(np.clip(0.2 * tape.generator.standard_normal(), -0.5, 0.5))
            tape.hold("free", wish_s, speed, turn)
        end_s += wish_s
    tape.rest()


def _rich(tape: _Tape) -> ScriptedDrive:
    blocks = [_straights, _spins, _arcs, _start_stops, _weave, _ramps, _free, _free, _free]
    tape.rest(2.0)
    for block in tape.generator.permutation(len(blocks)):
        blocks[block](tape)
    tape.rest(2.0)
    return tape.drive("rich")


def _only_free(tape: _Tape) -> ScriptedDrive:
    tape.rest(2.0)
    _free(tape, 140.0)
    tape.rest(2.0)
    return tape.drive("free")


def _circle(tape: _Tape) -> ScriptedDrive:
    tape.rest(1.5)
    tape.hold("circle", 60.0, 0.41, 0.12)
    tape.rest(1.5)
    return tape.drive("circle", steady=True)


def _straight(tape: _Tape) -> ScriptedDrive:
    tape.rest(1.5)
    for _ in range(4):
        _straights(tape)
    tape.rest(1.5)
    return tape.drive("straight", steady=True)


def _poor(tape: _Tape) -> ScriptedDrive:
    tape.rest(0.5)
    for _ in range(3):
        tape.hold("crawl", tape.about(4.0), tape.about(0.15), tape.about(0.03, 1.0))
    tape.rest(0.5)
    return tape.drive("poor")


def _random_steps(tape: _Tape) -> ScriptedDrive:
    """Random pairs of wheel speeds, each held for 6 s, evenly over what the wheels can do."""
    tape.rest(1.5)
    for _ in range(24):
        left, right = tape.generator.uniform(-0.9, 0.9, size=2)
        tape.hold("random step", 6.0, 0.5 * (left + right), 0.5 * (right - left), sharp=True)
    tape.rest(1.5)
    return tape.drive("random_steps", steady=True)


DRIVES: Mapping[str, Callable[[_Tape], ScriptedDrive]] = MappingProxyType(
    {
        "rich": _rich,
        "free": _only_free,
        "circle": _circle,
        "straight": _straight,
        "poor": _poor,
        "random_steps": _random_steps,
    }
)


def create_drive(name: str, seed: int) -> ScriptedDrive:
    """Make one of `DRIVES`.

    `rich`: about 150 s of everything that identification asks for, in random order; `free`: 140 s of a person with a
    stick; `circle`: one steady circle of 60 s; `straight`: lines at two speeds, forward and back; `poor`: 13 s of
    crawling; `random_steps`: random wheel speeds held for 6 s.
    """
    return DRIVES[name](_Tape(np.random.default_rng(seed)))
