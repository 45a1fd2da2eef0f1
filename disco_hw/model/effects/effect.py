"""What an effect is: a named difference between the ideal robot and a real one, with its parameters and its term."""

from __future__ import annotations

import enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from disco_hw.model.parameter import Parameter

Array = NDArray[np.float64]


class Channel(enum.Enum):
    """Where in the chain from command to measured pose an effect acts."""

    COMMAND_TO_WHEEL = "command_to_wheel"
    WHEEL_TO_BODY = "wheel_to_body"
    POSE_SENSOR = "pose_sensor"


class Effect(Protocol):
    """One effect; its file also holds `term`, the compiled scalar function that `disco_hw.model.step` calls.

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
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in the order of all arrays."""

    @property
    def excitation(self) -> str:
        """The manoeuvre that shows it."""

    @property
    def sentence(self) -> str:
        """What it does, for a person; `str.format` fields are the parameters' names."""

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """What `term` needs, worked out once for every parameter point.

        `values` (L, P) in the order of `parameters`, `base` (L, 3) wheel radius, axial distance, x_icr;
        returns arrays of shape (L,).
        """
