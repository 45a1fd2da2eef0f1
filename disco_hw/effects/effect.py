"""What an effect is: a named difference between the ideal robot and a real one, with its parameters and its term."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of theta.

    `low` and `high` bound what is physically possible; `start` is a plausible value to begin a fit from and `starts`
    are further ones for parameters whose likelihood has several hills; `neutral` is the value without any effect;
    `realistic` is the smallest size that real robots show, None where that says nothing.
    """

    name: str
    unit: str
    low: float
    high: float
    start: float
    neutral: float = 0.0
    starts: tuple[float, ...] = ()
    realistic: float | None = None


class Channel(enum.Enum):
    """Where in the chain from command to measured pose an effect acts."""

    COMMAND_TO_WHEEL = "command_to_wheel"
    WHEEL_TO_BODY = "wheel_to_body"
    POSE_SENSOR = "pose_sensor"


class Stage(enum.Enum):
    """What of a step an effect's `term` changes, that is what it returns.

    A `term` names what it needs: of the wheels `left`, `right` (commands, rad/s) or `command` and `speed` of one wheel
    at a time, or what both do in the step, `end_left`, `end_right`, `mean_left`, `mean_right` from `wheel_left`,
    `wheel_right`; of the body `wheel_sum`, `difference` (of right and left, rad/s), `change` (of the sum over the
    step), `forward` (m/s), `turn` (half the yaw rate, rad/s); `time_s`; and `coefficients`, None where it is absent.
    """

    COMMAND = "the commands left and right, or the one of a wheel"
    RESPONSE = "wheel speed at the end of the step and its mean; of both wheels left and right, then the means"
    ROLLING = "wheel_sum and difference"
    VELOCITY = "forward and turn"
    FORWARD = "forward"
    TURN = "turn"
    LATERAL = "lateral speed that comes on top (m/s), None where the effect is absent"
    WORLD = "x and y (m) after the step"
    ELSEWHERE = "nothing: what it changes lies outside the step"


class Effect(Protocol):
    """One effect; its file also holds `term`, the compiled scalar function that the step calls where `stage` says.

    `excitation` is the manoeuvre that shows it; `sentence` describes it for a report, with `{parameter}` fields.
    """

    @property
    def name(self) -> str:
        """Name in model files, on the command line and in reports."""

    @property
    def channel(self) -> Channel:
        """Where it acts."""

    @property
    def moves(self) -> bool:
        """Whether it changes motion; if not, it only changes what is measured."""

    @property
    def stage(self) -> Stage:
        """What its term changes."""

    @property
    def order(self) -> int:
        """Place of its term among those of a step, ascending; 70 is the motors' response, 100 on is the body."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in the order of all arrays."""

    @property
    def excitation(self) -> str:
        """The manoeuvre that shows it."""

    @property
    def script(self) -> str:
        """The script of `disco-hw drive --script` that drives this manoeuvre."""

    @property
    def sentence(self) -> str:
        """What it does, for a person; `str.format` fields are the parameters' names."""

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """What `term` needs, worked out once for every parameter point.

        `values` (L, P) in the order of `parameters`, `base` (L, 3) wheel radius, axial distance, x_icr;
        returns arrays of shape (L,).
        """
