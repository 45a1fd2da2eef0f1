"""Definition of an effect: a named difference between the ideal robot and a real one, with equations and traits.

Each file beside this one holds all that anyone needs to know of one of them.
"""

from __future__ import annotations

import enum
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Of one state or of many at once.
Value = float | Array
Values = tuple[Value, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of theta.

    `low` and `high` bound what is physically possible; `start` is a plausible value to begin a fit from; `neutral` is
    the value without any effect; `realistic` is the smallest size that real robots show (of a limit the largest), None
    where that says nothing. `expected` is how far from neutral it lies as a rule, `least_fitted` a bound below `low`
    that a fit may reach, so that a wrong clock shows.
    """

    name: str
    unit: str
    low: float
    high: float
    start: float
    neutral: float = 0.0
    realistic: float | None = None
    expected: float = math.inf
    least_fitted: float | None = None


class Channel(enum.Enum):
    """Channels, from command to measured pose, in which an effect acts."""

    COMMAND_TO_WHEEL = "command_to_wheel"
    WHEEL_TO_BODY = "wheel_to_body"
    POSE_SENSOR = "pose_sensor"


class Stage(enum.Enum):
    """Stages of a step that an effect can change, in order; each value says what its `term` and `plain` return.

    Both ask by name for what they need: `left`, `right` (commands, rad/s), or `command` and the wheel's `speed` of one
    wheel at a time; of the response `end_left`, `end_right`, `mean_left`, `mean_right` and `wheel_left`, `wheel_right`
    (at the start), with `left` and `right` what is aimed for, or `end`, `mean` and `speed` of one wheel at a time; of
    the body `wheel_sum`, `difference` (of right
    and left, rad/s), `change` (of the sum over the step), `forward` (m/s), `turn` (half the yaw rate, rad/s), `x`, `y`;
    and the time at the step's start, `time_s`.
    """

    DELAY = "mean command over a step, of the one in force after whole steps of delay and the older one"
    COMMAND = "the commands left and right, or the one of a wheel"
    RESPONSE = "wheel speed at the end of the step and its mean; of both wheels left and right, then the means"
    ROLLING = "wheel_sum and difference"
    VELOCITY = "forward and turn"
    FORWARD = "forward"
    TURN = "turn"
    LATERAL = "lateral speed that comes on top (m/s), None where the effect is absent"
    WORLD = "x and y (m) after the step"
    ENCODERS = "angles or speeds of the wheels, left and right, as the encoders report them"
    POSE = "x, y and yaw as the pose sensor reports them"
    POSE_TIME = "when a pose with the time stamp time_s was true"
    TERMS = "a command or a velocity of the body, by one of the terms without a name"


# What only changes what is measured.
_MEASURING = (Stage.ENCODERS, Stage.POSE, Stage.POSE_TIME)
# Stages that act one after the other; those in one group by their `order`.
STAGE_GROUPS = (
    (Stage.DELAY,),
    (Stage.COMMAND,),
    (Stage.RESPONSE,),
    (Stage.ROLLING,),
    (Stage.VELOCITY, Stage.FORWARD, Stage.TURN, Stage.LATERAL),
    (Stage.WORLD,),
    (Stage.ENCODERS,),
    (Stage.POSE_TIME,),
    (Stage.POSE,),
    (Stage.TERMS,),
)

_WHEELS = ("left", "right", "command", "speed", "wheel_left", "wheel_right", "time_s")
_RESPONSE = (
    "left", "right", "end_left", "end_right", "mean_left", "mean_right", "end", "mean", "speed", "wheel_left",
    "wheel_right",
)  # fmt: skip
_ROLLING = ("wheel_sum", "difference", "change", "time_s")
_BODY = (*_ROLLING, "forward", "turn")
# What `term` and `plain` of a stage may ask for.
INPUTS = {
    Stage.DELAY: ("recent", "older"),
    Stage.COMMAND: _WHEELS,
    Stage.RESPONSE: (*_RESPONSE, "time_s"),
    Stage.ROLLING: _ROLLING,
    Stage.VELOCITY: _BODY,
    Stage.FORWARD: _BODY,
    Stage.TURN: _BODY,
    Stage.LATERAL: _BODY,
    Stage.WORLD: ("x", "y", "wheel_sum", "difference", "time_s"),
    Stage.ENCODERS: ("left", "right"),
    Stage.POSE: ("x", "y", "yaw"),
    Stage.POSE_TIME: ("time_s",),
}


class Symptom(enum.Enum):
    """A pattern that an effect leaves between measured wheels and poses when only the geometry is fitted."""

    DELAYED_POSITIONS = "positions lag behind the wheels' motion"
    SIDEWAYS_WITH_SPEED = "the robot moves sideways on straights"
    SIDEWAYS_IN_FAST_TURNS = "the robot slides outwards the faster it turns"
    FORWARD_WITH_TURNING = "turning shifts the robot forward or back"
    DOWNHILL = "motion adds a drift in one direction of the floor"
    SHORTER_AT_SPEED = "the distance per turn of the wheels changes with speed"
    DISTANCE_CHANGES = "the distance per turn of the wheels changes during the drive"
    TURNS_ON_STRAIGHTS = "the robot turns with equal wheel speeds"
    LESS_TURN_AT_SPEED = "turning falls short the faster it is"
    DELAYED_YAW = "yaw lags behind the wheels' turning"
    LEFT_UNLIKE_RIGHT = "left and right turns differ"
    TURNING_CHANGES = "turning per turn of the wheels changes during the drive"


@dataclass(frozen=True, slots=True)
class CommandedDrive:
    """Drive as the search for an effect sees it.

    `commands` (N, 2) rad/s, known ones; wheel radius and axial distance (m) of `geometry`; when its poses begin and end
    (s).
    """

    commands: Array
    geometry: tuple[float, float]
    first_s: float
    last_s: float

    @property
    def largest_speed_rad_s(self) -> float:
        """Largest wheel speed that was commanded."""
        return float(np.abs(self.commands).max(initial=0.0))

    @property
    def largest_yaw_rate_rad_s(self) -> float:
        """Largest yaw rate that was commanded."""
        half = np.abs(0.5 * (self.commands[:, 1] - self.commands[:, 0]))
        return float(half.max(initial=0.0)) * (2.0 * self.geometry[0] / self.geometry[1])


@dataclass(frozen=True, slots=True)
class Scan:
    """Parameter in which the residual is not smooth, so that values are tried one by one.

    It states which ones for a drive, and how close to the best to search on.
    """

    parameter: str
    values: Callable[[CommandedDrive], tuple[float, ...]]
    refine: float


@dataclass(frozen=True, slots=True)
class Mimicked:
    """Another effect, by its module, confounded with this one in every drive, and what decides (`decided_by`).

    `seen_too_as` is the effect of the other channel that the same cause shows as, if it shows in two; `seen_too` the
    value that its first parameter then has, from the values of the mimicked effect.
    """

    module: Any
    decided_by: str
    seen_too_as: Any = None
    seen_too: Callable[[Values], float] | None = None

    @property
    def effect(self) -> Effect:
        """Effect that can be mistaken for this one."""
        found: Effect = self.module.EFFECT
        return found


Wording = str | Callable[[Mapping[str, float]], str]
"""A text with `{parameter}` fields, or what returns it for the parameters' values."""


def parameters_as_they_are(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Return the parameters themselves, (L,) each: the coefficients of an effect that needs no others."""
    return tuple(values.T)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One effect, as its file describes it; docs/add-an-effect.md shows a whole one.

    What it does: `term` is the compiled scalar function that the step calls, with `coefficients`, None where the effect
    is absent; `plain` is the same in float64 numpy, written for reading, with the parameters' `values`, the `geometry`
    (wheel radius, axial distance, x_icr) and the step's length `step_s`. Both ask for what they need by name, see
    `Stage`. `coefficients(values, base, step_s)` works out what `term` needs once for every parameter point: `values`
    (L, P) in the order of `parameters`, `base` (L, 3) the geometry; arrays of shape (L,), by default the parameters
    themselves. `order` is the place among the effects of a stage, ascending.

    How it is reported: `sentence` for a report, with `{parameter}` fields, of a time `{parameter_s}` in s or
    `{parameter_ms}` in ms; `sentence_below` in its place where the first parameter is below zero, with its size;
    `other_symptoms`, pairs of a parameter and what follows the sentence where that one is known, too, a text or a
    function that returns it for the values; `excitation`, the manoeuvre that shows it, and `script`, the one of
    `disco-hw drive --script` that drives it; `symptoms`; `pose_key`, the key of [pose] in robot.toml that corrects it,
    and the sign with which its parameters are added there.

    Traits: `uses_geometry`, whether its coefficients depend on the geometry; `may_turn_more`, whether it can make the
    robot turn faster than its wheels say; `delayed_by`, the parameter that is the delay of the wheels behind commands,
    fitted from `delay_starts`; `dead_by`, the parameter that is what a drive takes off a command;
    `also_seen_as`, an effect of the other channel, by its module, and its parameter that is the same quantity as the
    first one here; `like_a_patch`, what decides between it and a patch of the floor if that leaves the same traces;
    `mimics`, an effect that competes in its place.

    How it is searched for: all parameters from neutral; or from the best of `starts` for a drive; or one by a `scan`.
    `limited(commands, geometry)` is, for a limit, what it limits, (N,); `trials` are sizes to try in turn where it is
    not smooth.

    Raises ValueError for a description that contradicts itself.
    """

    name: str
    channel: Channel
    stage: Stage
    parameters: tuple[Parameter, ...]
    plain: Callable[..., Any]
    sentence: str
    excitation: str
    script: str
    term: Callable[..., Any] | None = None
    coefficients: Callable[[Array, Array, float], tuple[Array, ...]] = parameters_as_they_are
    order: int = 0
    sentence_below: str | None = None
    other_symptoms: tuple[tuple[str, Wording], ...] = ()
    symptoms: tuple[Symptom, ...] = ()
    pose_key: tuple[str, float] | None = None
    uses_geometry: bool = False
    may_turn_more: bool = False
    delayed_by: str | None = None
    dead_by: str | None = None
    delay_starts: tuple[float, ...] = ()
    also_seen_as: tuple[Any, str] | None = None
    like_a_patch: str | None = None
    mimics: Mimicked | None = None
    starts: Callable[[CommandedDrive], tuple[tuple[float, ...], ...]] | None = None
    scan: Scan | None = None
    limited: Callable[[Array, tuple[float, float]], Array] | None = None
    trials: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        keys = [parameter.name for parameter in self.parameters]
        scanned = None if self.scan is None else self.scan.parameter
        for key in (self.delayed_by, self.dead_by, scanned, *dict(self.other_symptoms)):
            if key is not None and key not in keys:
                raise ValueError(f"{self.name}: has no parameter {key!r}, only {', '.join(keys)}")
        try:
            for text in (self.sentence, self.sentence_below or "", *dict(self.other_symptoms).values()):
                self.fill(text, {parameter.name: parameter.start for parameter in self.parameters})
        except (KeyError, IndexError) as error:
            raise ValueError(f"{self.name}: its sentence names {error}, which is no parameter") from None
        if self.stage is Stage.TERMS:
            return
        if self.moves and self.term is None:
            raise ValueError(f"{self.name}: changes {self.stage.value}; give the `term` that does")
        inputs = INPUTS[self.stage]
        self._check_inputs("term", self.term, (*inputs, "coefficients"))
        self._check_inputs("plain", self.plain, (*inputs, "values", "geometry", "step_s"))
        self._check_geometry()

    def _check_inputs(self, what: str, function: Callable[..., Any] | None, known: tuple[str, ...]) -> None:
        for argument in () if function is None else arguments_of(function):
            if argument not in known:
                raise ValueError(f"{self.name}: its `{what}` asks for {argument!r}, but may for {', '.join(known)}")

    def _check_geometry(self) -> None:
        values = np.array([[parameter.start for parameter in self.parameters]])
        one, other = (self.coefficients(values, np.array([base]), 0.1) for base in ((0.1, 0.5, 0.1), (0.2, 0.7, 0.3)))
        differs = any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True))
        if differs and not self.uses_geometry:
            raise ValueError(f"{self.name}: its coefficients depend on the geometry; say uses_geometry=True")

    def possible(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the nearest values in the parameters' ranges, but a first one of which `sentence_below` tells."""
        inside = {
            parameter.name: min(max(values[parameter.name], parameter.low), parameter.high)
            for parameter in self.parameters
            if parameter.name in values
        }
        first = self.parameters[0].name
        if self.sentence_below is not None and first in values:
            inside[first] = values[first]
        return inside

    def describe(self, values: Mapping[str, float]) -> str:
        """Return the sentence with these values of the parameters."""
        first = self.parameters[0].name
        if self.sentence_below is not None and values[first] < 0.0:
            return self.fill(self.sentence_below, {**values, first: -values[first]})
        return self.fill(self.sentence, values)

    def fill(self, wording: Wording, values: Mapping[str, float]) -> str:
        """Fill the fields of a text with values of the parameters, times in s or in ms."""
        text = wording if isinstance(wording, str) else wording(values)
        times = {name: value for name, value in values.items() if name.endswith("_s")}
        in_ms = {f"{name.removesuffix('_s')}_ms": 1e3 * value for name, value in times.items()}
        return text.format(**in_ms, **values)

    def pose_correction(self, values: Mapping[str, float]) -> tuple[str, tuple[float, ...]] | None:
        """Return the key of [pose] that corrects the effect, and what is to be added to it; None without such a key."""
        if self.pose_key is None:
            return None
        key, sign = self.pose_key
        return key, tuple(sign * values[parameter.name] for parameter in self.parameters if parameter.name in values)

    @property
    def moves(self) -> bool:
        """Whether the effect changes motion, and not only what is measured."""
        return self.stage not in _MEASURING

    @property
    def columns(self) -> tuple[str, ...]:
        """Full names of its parameters, as models and logs have them."""
        return tuple(f"{self.name}.{parameter.name}" for parameter in self.parameters)

    @property
    def witness(self) -> str | None:
        """Full name of the other channel's parameter that is the same quantity as the first one, if there is one."""
        return None if self.also_seen_as is None else f"{self.also_seen_as[0].EFFECT.name}.{self.also_seen_as[1]}"

    @property
    def is_limit(self) -> bool:
        """Whether the effect vanishes for a large first parameter: the largest size is what a drive can show."""
        return math.isinf(self.parameters[0].neutral)

    @property
    def smooth(self) -> bool:
        """Whether a fit finds it from neutral."""
        return self.scan is None and self.limited is None and not self.trials


def arguments_of(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the parameters of a `term` or `plain`."""
    return tuple(inspect.signature(getattr(function, "py_func", function)).parameters)
