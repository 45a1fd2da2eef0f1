"""The checks that a proposed belief passes before the robot drives by it; pure, and run by the daemon itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.adapter_link import NAMES, Proposal
from disco_hw.config import Control, PoseInput, Prior
from disco_hw.effects import Channel
from disco_hw.errors import InputError
from disco_hw.log.records import BeliefChange
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import BASE_PARAMETERS

Array = NDArray[np.float64]


_RANGES = {parameter.name: parameter for parameter in BASE_PARAMETERS}
_PHYSICAL_LOW = np.array([_RANGES[name].low for name in NAMES])
_PHYSICAL_HIGH = np.array([_RANGES[name].high for name in NAMES])


ASKED_BY_FILE = "control.adaptation"

_LEAST_VARIANCE, _LARGEST_VARIANCE = 1e-14, 1e4


class Outcome(Enum):
    """What was done with a proposal."""

    PUBLISHED = "published"
    CONFIRMING = "confirming"
    AGREES = "agrees"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class GuardSettings:
    """`jump_sigmas`: a mean further off than this must be confirmed by so many later proposals, each from driving that
    goes on for `apart_s` more. `stale_s`: driving older than this decides nothing. `interval_s`: between two changes.
    `news_sigmas`, `narrower`: what makes an agreeing proposal worth a change. `wider`: tolerance of "not wider".
    """

    jump_sigmas: float = 3.0
    confirmations: int = 2
    apart_s: float = 0.9
    stale_s: float = 5.0
    interval_s: float = 2.0
    news_sigmas: float = 0.5
    narrower: float = 0.8
    wider: float = 1.05


@dataclass(frozen=True, eq=False, slots=True)
class Geometry:
    """A Gaussian over the geometry in the order of `link.NAMES`: `mean` (3,), `covariance` (3, 3)."""

    mean: Array
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome, one sentence for a person, and the belief to drive by from now on if it was published."""

    outcome: Outcome
    text: str
    belief: Geometry | None = None


class BeliefGuard:
    """Judges proposals one after the other against the belief in force.

    `low`, `high` (3,) bound the mean: the prior. A belief that is refused leaves everything as
    it was. Nothing here raises on what a proposal holds.
    """

    def __init__(self, model: Geometry, low: Array, high: Array, settings: GuardSettings | None = None) -> None:
        self._model, self.low, self.high = model, low, high
        self._settings = settings or GuardSettings()
        self.in_force = model
        self.adapted = False
        self._pending: Geometry | None = None
        self._pending_t_ns = 0
        self._confirmed = 0
        self._published_ns: int | None = None

    def restore(self) -> None:
        """Go back to the model file's belief."""
        self.in_force, self.adapted, self._pending = self._model, False, None

    def take_back(self, in_force: Geometry, adapted: bool) -> None:
        """Undo the last publication: what was in force before it still is."""
        self.in_force, self.adapted = in_force, adapted

    def judge(self, now_ns: int, proposal: Proposal) -> Verdict:
        """Judge a proposal; a published belief is in force from here on."""
        fault = self._fault(now_ns, proposal)
        if fault:
            return Verdict(Outcome.REFUSED, fault)
        settings, last = self._settings, self.in_force
        new = _geometry(proposal)
        moved = np.abs(new.mean - last.mean)
        wider = bool((new.std > settings.wider * last.std).any())
        allowed = settings.jump_sigmas * (np.hypot(new.std, last.std) if wider else last.std)
        if bool((moved > allowed).any()):
            return self._jump(now_ns, proposal.t_ns, new, int(np.argmax(moved / allowed)))
        self._pending = None
        if wider:
            return Verdict(Outcome.AGREES, "agrees with the belief in force, which is narrower")
        news = (moved > settings.news_sigmas * last.std).any() or (new.std < settings.narrower * last.std).any()
        if not news:
            return Verdict(Outcome.AGREES, "nothing new")
        return self._publish(now_ns, new, "refined")

    def _fault(self, now_ns: int, proposal: Proposal) -> str:
        """Why a proposal must not be used, or nothing."""
        mean, covariance = np.array(proposal.mean), np.array(proposal.covariance)
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            return "not finite"
        matrix = covariance.reshape(3, 3)
        variances = np.diag(matrix)
        if not ((variances > _LEAST_VARIANCE) & (variances < _LARGEST_VARIANCE)).all():
            return "not a covariance"
        scale = np.sqrt(variances)
        unit = matrix / np.outer(scale, scale)
        if not np.abs(unit).max() < 1.0 + 1e-9 or np.abs(unit - unit.T).max() > 1e-9:
            return "not a covariance"
        if np.linalg.eigvalsh(unit)[0] < 1e-9:
            return "not a covariance"
        if proposal.doubt:
            return proposal.doubt
        if not abs(now_ns - proposal.t_ns) <= self._settings.stale_s * 1e9:
            return f"rests on driving {(now_ns - proposal.t_ns) * 1e-9:.0f} s ago"
        outside = (mean < self.low) | (mean > self.high)
        if outside.any():
            worst = int(np.argmax(outside))
            return f"{NAMES[worst]} {mean[worst]:.4g} is outside [{self.low[worst]:g}, {self.high[worst]:g}]"
        impossible = (mean - 2.0 * scale < _PHYSICAL_LOW) | (mean + 2.0 * scale > _PHYSICAL_HIGH)
        if impossible.any():
            worst = int(np.argmax(impossible))
            return f"{NAMES[worst]} {mean[worst]:.4g} +- {scale[worst]:.2g} reaches what is physically impossible"
        return ""

    def _jump(self, now_ns: int, t_ns: int, new: Geometry, worst: int) -> Verdict:
        settings, pending = self._settings, self._pending
        text = f"{NAMES[worst]} {self.in_force.mean[worst]:.4f} -> {new.mean[worst]:.4f} m"
        agrees = pending is not None and bool(
            (np.abs(new.mean - pending.mean) <= settings.jump_sigmas * np.hypot(new.std, pending.std)).all()
        )
        if not agrees:
            self._pending, self._pending_t_ns, self._confirmed = new, t_ns, 0
        elif t_ns - self._pending_t_ns >= settings.apart_s * 1e9:
            self._pending, self._pending_t_ns = new, t_ns
            self._confirmed += 1
        if self._confirmed < settings.confirmations:
            words = f"{text}: a jump, confirmed {self._confirmed} of {settings.confirmations} times"
            return Verdict(Outcome.CONFIRMING, words)
        return self._publish(now_ns, new, f"jumped, confirmed: {text}")

    def _publish(self, now_ns: int, new: Geometry, text: str) -> Verdict:
        if self._published_ns is not None and now_ns - self._published_ns < self._settings.interval_s * 1e9:
            return Verdict(Outcome.AGREES, "too soon after the last change")
        self._published_ns, self._pending = now_ns, None
        self.in_force, self.adapted = new, True
        return Verdict(Outcome.PUBLISHED, text, new)


def _geometry(proposal: Proposal) -> Geometry:
    covariance = np.array(proposal.covariance).reshape(3, 3)
    return Geometry(np.array(proposal.mean), 0.5 * (covariance + covariance.T))


def check_adaptable(model: Model, uncertainty: str, asked_by: str = "--adapt") -> None:
    """Raise InputError for a model or a planner that cannot be adapted, with what to do.

    `asked_by`: the option or field that asked for adaptation.
    """
    if uncertainty == "point":
        raise InputError(f'{asked_by}: control.uncertainty = "point" plans without a belief; write "ut" or "mc"')
    if model.belief is None or not set(NAMES) <= set(model.belief.names):
        raise InputError(
            f"{asked_by}: the model has no belief over wheel radius, axial distance and x_icr; "
            "write one with `disco-hw infer`"
        )
    others = [s.name for s in model.effects if s.effect.channel is not Channel.COMMAND_TO_WHEEL]
    if others:
        raise InputError(
            f"{asked_by}: the model has the effect {others[0]}, which adaptation would take for a change of the "
            f"geometry; leave {asked_by} out"
        )


LEAST_RATE_HZ, MOST_POSITION_STD_M, MOST_YAW_STD_RAD, MOST_LATENCY_S = 10.0, 0.01, 0.01, 0.3
"""Poses from which the filter learns without being asked to."""


@dataclass(frozen=True, slots=True)
class AdaptationChoice:
    """Which adaptation runs, and why."""

    kind: Literal["off", "fast", "audited"]
    why: str


def choose_adaptation(control: Control, pose: PoseInput, model: Model) -> AdaptationChoice:
    """What `control.adaptation` asks for; for "auto" the filter where [pose] says poses that are good enough for it.

    Raises InputError for one that is asked for and that the model does not allow.
    """
    asked = control.adaptation
    if asked != "auto":
        if asked != "off":
            check_adaptable(model, control.uncertainty, ASKED_BY_FILE)
        return AdaptationChoice(asked, f'{ASKED_BY_FILE} = "{asked}"')
    try:
        check_adaptable(model, control.uncertainty, ASKED_BY_FILE)
    except InputError as error:
        return AdaptationChoice("off", str(error))
    if pose.rate_hz is None:
        text = (
            f"pose.rate_hz is not given; write it, pose.position_std_m and pose.yaw_std_rad where poses come at "
            f"{LEAST_RATE_HZ:g} Hz or more with {MOST_POSITION_STD_M:g} m and {MOST_YAW_STD_RAD:g} rad or less"
        )
        return AdaptationChoice("off", text)
    if pose.rate_hz < LEAST_RATE_HZ:
        return AdaptationChoice("off", f"pose.rate_hz is {pose.rate_hz:g}, less than {LEAST_RATE_HZ:g}")
    for name, most in (
        ("position_std_m", MOST_POSITION_STD_M), ("yaw_std_rad", MOST_YAW_STD_RAD), ("latency_s", MOST_LATENCY_S),
    ):  # fmt: skip
        given = getattr(pose, name)
        if given > most:
            return AdaptationChoice("off", f"pose.{name} is {given:g}, more than {most:g}")
    return AdaptationChoice(
        "fast", f"poses at {pose.rate_hz:g} Hz with {pose.position_std_m:g} m and {pose.yaw_std_rad:g} rad"
    )


def believed_geometry(model: Model) -> Geometry:
    """Moments of the model's belief over the geometry; it must have one."""
    assert model.belief is not None
    order = [model.belief.names.index(name) for name in NAMES]
    return Geometry(model.belief.mean()[order], model.belief.covariance()[np.ix_(order, order)])


def possible_range(prior: Prior) -> tuple[Array, Array]:
    """Lowest and highest geometry (3,) that is physically possible and within the prior of robot.toml."""
    physical = {parameter.name: parameter for parameter in BASE_PARAMETERS}
    ranges = [(physical[name], getattr(prior, name)) for name in NAMES]
    low = np.array([max(parameter.low, given[0]) for parameter, given in ranges])
    high = np.array([min(parameter.high, given[1]) for parameter, given in ranges])
    return low, high


def with_geometry(model: Model, geometry: Geometry) -> Model:
    """The model with this belief over its geometry, independent of what else it believes."""
    belief = model.belief
    assert belief is not None
    order = [belief.names.index(name) for name in NAMES]
    mean, covariance = belief.mean().copy(), belief.covariance().copy()
    covariance[order, :] = 0.0
    covariance[:, order] = 0.0
    mean[order] = geometry.mean
    covariance[np.ix_(order, order)] = geometry.covariance
    return replace(model, belief=Gaussian(belief.names, mean, covariance))


def geometry_of(change: BeliefChange) -> Geometry | None:
    """The geometry of a recorded change, None for the model file's."""
    if change.source == "model":
        return None
    return Geometry(np.array(change.mean), np.array(change.covariance).reshape(3, 3))
