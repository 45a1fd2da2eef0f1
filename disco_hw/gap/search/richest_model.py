"""The effects as they compete, and the richest model of a channel: all of them and all unnamed terms at once.

What it leaves is noise. A noise model learnt from a poorer one takes what is missing for noise and hides it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from disco_hw.effects import Channel as Place
from disco_hw.effects import CommandedDrive, Effect, Stage
from disco_hw.effects.registry import REGISTRY, in_stages
from disco_hw.gap.data import DELAYED_BY, WHEEL, Layout
from disco_hw.gap.data.free_runs import read_angles
from disco_hw.gap.noise import learn_body_noise, learn_wheel_noise, wheel_mismatch
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise, whiten_wheels
from disco_hw.gap.search.least_squares import sensitivity
from disco_hw.gap.search.unnamed_terms import ResidualChannel
from disco_hw.gap.settings import GRID_STEP_S, FitSettings
from disco_hw.jit import kernel_function

Array = NDArray[np.float64]


def learn_saturated_wheels(channel: WheelChannel, vector: Array) -> tuple[WheelChannel, Array, int]:
    """Estimate the noise of the wheels that the channel's richest model leaves.

    Return the channel with that noise, the residual (E, 2) of the model, and the number of its parameters.

    `vector`: the fit of the smooth effects; on top come any static response of a wheel, quick and slow ones, limited
    changes of speed and the other wheel's influence, each as speed of the wheel itself.
    """
    drive, raw = channel.drive, channel.raw_residual(vector)
    at = np.empty_like(raw)
    columns = []
    for shape in _wheel_shapes(channel, vector):
        read_angles(_integrated(shape, drive.first), drive.encoder.node, drive.encoder.fraction, at)
        columns.append(at.copy())
    many = len(columns) + WHEEL.neutral.size
    if not columns:
        return learn_wheel_noise(channel, raw), raw, many
    # A noise that was learnt from too poor a model lets the richest one leave what that model left, and learns it
    # again; the usual noise does not. Nor does every round come closer: where something is missing the noise grows.
    misfits: list[float] = []
    best, least = channel, raw
    for begin in (channel, channel.with_noise(WheelNoise(reading_rad=channel.noise.reading_rad))):
        estimated = begin
        for _ in range(channel.settings.fit.rounds):
            slope = np.column_stack([(whiten_wheels(c, estimated.gains) * estimated.weight).ravel() for c in columns])
            found = _ridge(
                slope, (whiten_wheels(raw, estimated.gains) * estimated.weight).ravel(), channel.settings.fit
            )
            left = raw + np.tensordot(np.stack(columns, axis=-1), found, axes=1)
            estimated = learn_wheel_noise(estimated, left)
            misfits.append(wheel_mismatch(channel, left)(estimated.noise.vector()))
            if misfits[-1] == min(misfits):
                best, least = estimated, left
    return best, least, many


def learn_saturated_body(
    channel: BodyChannel, names: tuple[str, ...], vector: Array, perturbations: Iterable[Array]
) -> tuple[BodyChannel, Array, Array, int]:
    """Estimate the noise of the body that the channel's richest model leaves.

    Return the channel with that noise, the model's vector, the perturbation (M, 3) that it adds, and the number of its
    parameters.

    `names`: effects whose entries are free; `vector` where they were fitted; `perturbations` (M, 3) each.
    """
    base = channel.residual(vector)
    active = indices(channel, names)
    slopes, steps = [sensitivity(channel, vector, active, base)], []
    for perturbation in perturbations:
        size = float(np.sqrt((perturbation**2).mean()))
        if size < 1e-9:
            continue
        step = 1e-3 / size
        slopes.append(((channel.residual(vector, step * perturbation) - base) / step)[:, None])
        steps.append(perturbation)
    found = _ridge(np.column_stack(slopes), base, channel.settings.fit)
    chosen, layout = list(active), channel.layout
    perturbation = (
        np.tensordot(found[len(chosen) :], np.stack(steps), axes=1) if steps else np.zeros((channel.drive.t_s.size, 3))
    )
    for halving in range(channel.settings.fit.richest_halvings):
        share = 0.5**halving
        moved, extra = vector.copy(), share * perturbation
        moved[chosen] = np.clip(vector[chosen] + share * found[: len(chosen)], layout.low[chosen], layout.high[chosen])
        if np.sum(channel.residual(moved, extra) ** 2) < np.sum(base**2):
            return learn_body_noise(channel, moved, extra), moved, extra, found.size
    return channel, vector, np.zeros_like(perturbation), found.size


def _ridge(slope: Array, residual: Array, settings: FitSettings) -> Array:
    """Coefficients that take most of a residual away; where columns look alike, small ones."""
    scale = np.maximum(np.sqrt((slope**2).sum(axis=0)), 1e-12)
    unit = slope / scale
    normal = unit.T @ unit + settings.ridge * np.eye(unit.shape[1])
    return np.asarray(-np.linalg.solve(normal, unit.T @ residual) / scale)


def _integrated(speed: Array, first: NDArray[np.bool_]) -> Array:
    """Angles (M, 2) of speeds at the nodes, negative: as a residual feels them, each run from 0."""
    angle = -np.cumsum(speed, axis=0) * GRID_STEP_S
    starts = np.flatnonzero(first)
    return np.asarray(angle - np.repeat(angle[starts], np.diff(np.append(starts, first.size)), axis=0))


def _wheel_shapes(channel: WheelChannel, vector: Array) -> Iterator[Array]:
    """Speeds (M, 2) of the wheels that a command may make in ways the named effects do not have."""
    drive, settings = channel.drive, channel.settings.fit
    commanded = drive.delayed_commands(WHEEL.at(vector, DELAYED_BY))
    response_s = sum(WHEEL.at(vector, column) for column in DELAY_COLUMNS if column != DELAYED_BY)
    u = _slow(commanded, max(response_s, 1e-3))
    largest = float(np.abs(u).max(initial=0.0))
    if largest <= 0.0:
        return
    for share in settings.bend_shares:
        yield np.sign(u) * np.maximum(np.abs(u) - share * largest, 0.0)
    other = u[:, ::-1]
    yield from (np.tanh(u / 0.05), u, np.abs(u), u * u, other, np.abs(other) * np.tanh(u / 0.05), np.abs(other) * u)
    # Not time: what wanders slowly would be taken for a trend, and the noise then for less than it is.
    yield from (u * np.sin(drive.angle_rad), u * np.cos(drive.angle_rad))
    for response_s in settings.responses_s:
        behind = _slow(u, response_s) - u
        yield behind
        yield behind[:, ::-1]
        yield _slow(behind, response_s)
    for full_s in settings.slews_s:
        yield _slewed(commanded, largest / full_s) - commanded


def _slow(u: Array, response_s: float) -> Array:
    """`u` (M, 2) through a first-order lag."""
    keep = math.exp(-GRID_STEP_S / response_s)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], u, axis=0))


def _slewed(u: Array, rate: float) -> Array:
    """`u` (M, 2) followed with at most this rate (1/s of its unit)."""
    out = np.empty_like(u)
    _follow(u, rate * GRID_STEP_S, out)
    return out


@kernel_function
def _follow(u: Array, most: float, out: Array) -> None:
    for side in range(u.shape[1]):
        now = u[0, side]
        for k in range(u.shape[0]):
            now += min(max(u[k, side] - now, -most), most)
            out[k, side] = now


Starts = tuple[tuple[float, ...], ...]

# What makes wheels late, from the wheel back to the command.
_DELAYS = [effect for effect in reversed(in_stages(Stage.DELAY, Stage.COMMAND, Stage.RESPONSE)) if effect.delayed_by]
DELAY_NAMES = tuple(effect.name for effect in _DELAYS)
DELAY_COLUMNS = tuple(f"{effect.name}.{effect.delayed_by}" for effect in _DELAYS)
DELAY_STARTS_S = tuple(zip(*(effect.delay_starts for effect in _DELAYS), strict=False))


@dataclass(frozen=True, slots=True)
class Profile:
    """An entry that is searched over values: its name, the values for a channel, and how close to search."""

    column: str
    values: Callable[[ResidualChannel], tuple[float, ...]]
    refine: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect in the competition.

    `columns` are fitted from each of the `starts`, none of which means from neutral, where the effect is smooth.
    `is_alternative`: it begins at some time of the drive, as a patch of the floor would.
    """

    name: str
    columns: tuple[str, ...]
    starts: Callable[[ResidualChannel], Starts] | None = None
    profile: Profile | None = None
    is_alternative: bool = False

    @property
    def parameters(self) -> int:
        """Number of parameters that its evidence must pay for."""
        return len(self.columns) + (self.profile is not None)


def driven(channel: ResidualChannel) -> CommandedDrive:
    """Return the commanded drive of a channel as effects see it."""
    inner = channel.inner
    commands, geometry = inner.drive.command_rad_s, inner.geometry
    t_s = inner.samples.t_s if isinstance(inner, BodyChannel) else inner.drive.t_s
    known = commands[np.isfinite(commands[:, 0])]
    return CommandedDrive(known, (float(geometry[0]), float(geometry[1])), float(t_s[0]), float(t_s[-1]))


# What makes poses older than their stamps.
OLD_POSE_COLUMNS = tuple(f"{effect.name}.{effect.parameters[0].name}" for effect in in_stages(Stage.POSE_TIME))


def delay_columns(layout: Layout) -> tuple[str, ...]:
    """Return the parameters that delay one side of a channel against the other."""
    return (DELAYED_BY,) if layout.of_wheels else OLD_POSE_COLUMNS


def delays_of(layout: Layout) -> tuple[str, ...]:
    """Return the effects that delay one side of a channel against the other."""
    return tuple(column.partition(".")[0] for column in delay_columns(layout))


def with_delay(channel: ResidualChannel, vector: Array) -> Array:
    """Return a parameter vector with the first estimate of the delay of commands or poses."""
    delayed, layout, drive = vector.copy(), channel.layout, channel.inner.drive
    places = [layout.place[column] for column in delay_columns(layout)]
    seen_s = drive.commands_moved_s if layout.of_wheels else drive.pose_delay_s
    delayed[places] = np.clip(seen_s, layout.low[places], layout.high[places])
    return delayed


def _pose_starts(channel: ResidualChannel) -> Starts:
    """Return the start of the fit of the poses' delay: its first estimate."""
    seen = with_delay(channel, channel.neutral)
    return ((float(seen[channel.layout.place[OLD_POSE_COLUMNS[0]]]),),)


def _delay_starts(channel: ResidualChannel, starts: Starts) -> Starts:
    """Return the starts of the fit of a dead time, moved by its first estimate."""
    return tuple((start + channel.inner.drive.commands_moved_s, *rest) for start, *rest in starts)


def _starts(effect: Effect) -> Callable[[ResidualChannel], Starts] | None:
    begin = effect.starts
    if effect.stage is Stage.POSE_TIME:
        return _pose_starts
    if begin is None:
        return None
    if effect.stage is Stage.DELAY:
        return lambda channel: _delay_starts(channel, begin(driven(channel)))
    return lambda channel: begin(driven(channel))


def _candidate(effect: Effect) -> Candidate:
    scan, profile = effect.scan, None
    if scan is not None:
        column = f"{effect.name}.{scan.parameter}"
        profile = Profile(column, lambda channel: scan.values(driven(channel)), scan.refine)
    columns = tuple(column for column in effect.columns if profile is None or column != profile.column)
    return Candidate(effect.name, columns, _starts(effect), profile, effect.like_a_patch is not None)


# What mimics another effect is decided after the others, in `analysis`.
CANDIDATES: Mapping[str, Candidate] = MappingProxyType(
    {name: _candidate(effect) for name, effect in REGISTRY.items() if effect.mimics is None}
)


def candidates_of(layout: Layout) -> tuple[str, ...]:
    """Names of the effects that compete in the channel of a layout."""
    return tuple(name for name in CANDIDATES if (REGISTRY[name].channel is Place.COMMAND_TO_WHEEL) == layout.of_wheels)


def smooth_of(layout: Layout) -> tuple[str, ...]:
    """Return the candidates that a fit finds from their neutral values, in the order in which they act."""
    acting = [effect.name for effect in in_stages(*Stage) if effect.smooth]
    return tuple(name for name in acting if name in candidates_of(layout))


def parameters_of(names: tuple[str, ...]) -> int:
    """Return the number of parameters of a set of effects."""
    return sum(CANDIDATES[name].parameters for name in names)


def indices(channel: ResidualChannel, names: tuple[str, ...]) -> tuple[int, ...]:
    """Places in the parameter vector of what a set of effects frees, after those that are always free."""
    place = channel.layout.place
    return (*channel.free, *(place[column] for name in names for column in CANDIDATES[name].columns))
