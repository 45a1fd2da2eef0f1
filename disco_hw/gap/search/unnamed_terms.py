"""Unnamed terms: physical features of the motion that a channel may depend on, whatever the cause.

Features are made of what was measured or commanded, once, so that they do not change while parameters are fitted, and
their effect goes through the free run: nothing is differentiated but the wheels' speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data import Layout
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.settings import GRID_STEP_S, GapSettings, TermSettings
from disco_hw.model import EffectSetting
from disco_hw.model.terms import (
    BODY_FEATURES,
    BODY_MEMORIES,
    BODY_TARGETS,
    COMMAND,
    COMMAND_FEATURES,
    COMMAND_MEMORIES,
    REACH,
    TERMS,
    GenericTerm,
    term_name,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Term:
    """A feature at the nodes, (M, 2) in rad/s of command or (M, 3) in m/s, m/s, rad/s of motion, and how it is written.

    `form` has a place for the coefficient. `model_name`: the term of `disco_hw.model.terms` that it is; None if a model
    cannot carry it, because it depends on what a model's state does not hold. `geometry`: wheel radius and axial
    distance (m) that the speeds in it are made with. `disc`: x, y and radius (m) of the floor that it is about.
    `further_waves`: those of which it is the first, each with a coefficient of its own, and `usual` the standard
    deviation that is expected of these. `highest`: a coefficient can be no larger.
    """

    form: str
    perturbation: Array
    model_name: str | None = None
    geometry: tuple[float, float] = (1.0, 1.0)
    disc: tuple[float, float, float] | None = None
    further_waves: tuple[Array, ...] = ()
    usual: float = math.inf
    highest: float = math.inf

    @property
    def features(self) -> tuple[Array, ...]:
        """Return the columns that the term's coefficients multiply, one array a coefficient."""
        return (self.perturbation, *self.further_waves)

    def written(self, coefficients: Array) -> str:
        """Format the equation with its coefficients: one, or of waves the root mean square of their sum."""
        size = float(coefficients[0]) if not self.further_waves else float(np.sqrt(0.5 * (coefficients**2).sum()))
        return self.form.format(size)


def wheel_terms(channel: WheelChannel, delay_s: float) -> Iterator[Term]:
    """Yield the terms that may be added to both wheels' commands; `delay_s` is the dead time that was found."""
    drive = channel.drive
    u = drive.delayed_commands(delay_s)
    other, t = u[:, ::-1], drive.t_s[:, None]
    for form, feature in COMMAND_FEATURES.items():
        name = term_name(COMMAND, form)
        yield Term(_with_place(name), feature(u, other, t), name)
    for form, memory in COMMAND_MEMORIES.items():
        name = term_name(COMMAND, form)
        yield Term(_with_place(name), memory.at_nodes(GRID_STEP_S, u, other), name)
    growth = np.gradient(u, GRID_STEP_S, axis=0)
    sign = COMMAND_FEATURES["sign(u)"](u, other, t)
    angle = drive.angle_rad
    features = {
        "du/dt": growth,
        "|du/dt| sign(u)": np.abs(growth) * sign,
        "u |du/dt|": u * np.abs(growth),
        "u sin(wheel angle)": u * np.sin(angle),
        "u cos(wheel angle)": u * np.cos(angle),
    }
    for form, perturbation in features.items():
        yield Term(_with_place(term_name(COMMAND, form)), perturbation)


def motion(drive: GriddedDrive, p: Array) -> tuple[Array, Array, Array]:
    """Forward speed (m/s), yaw rate (rad/s) and acceleration (m/s^2) from the wheels, (M,) each."""
    speed = drive.speed_rad_s
    v = 0.5 * p[0] * speed.sum(axis=1)
    return v, p[0] / p[1] * (speed[:, 1] - speed[:, 0]), np.gradient(smoothed(v, drive.settings.terms), GRID_STEP_S)


def body_terms(channel: BodyChannel, p: Array) -> Iterator[Term]:
    """Yield the terms that may be added to the body's velocity; `p` is the vector of the channel."""
    drive = channel.drive
    v, w, a = motion(drive, p)
    dw = np.gradient(smoothed(w, drive.settings.terms), GRID_STEP_S)
    moving = np.minimum(np.abs(drive.speed_rad_s).max(axis=1) * p[0] / drive.settings.noise.slip_onset_m_s, 1.0)
    beyond = {"moving": moving, "domega/dt": dw, "v domega/dt": v * dw}
    geometry = float(p[0]), float(p[1])
    for axis, target in enumerate(BODY_TARGETS):
        for form, feature in BODY_FEATURES.items():
            name = term_name(target, form)
            # Nothing makes a robot slide aside ever more: a gyro's yaw drifts, and another drive begins anew.
            carried = None if target == "v_y" and form.startswith("t/100") else name
            yield Term(_with_place(name), _on(axis, feature(v, w, a, drive.t_s)), carried, geometry)
        for form, memory in BODY_MEMORIES[target].items():
            name = term_name(target, form)
            # No robot runs ahead of wheels that spin up.
            highest = 0.0 if memory.slews else math.inf
            perturbation = _on(axis, memory.at_nodes(GRID_STEP_S, v, w))
            yield Term(_with_place(name), perturbation, name, geometry, highest=highest)
        for form, perturbation in beyond.items():
            yield Term(_with_place(term_name(target, form)), _on(axis, perturbation))
    left, right = drive.speed_rad_s[:, 0] * p[0] / 2.0, drive.speed_rad_s[:, 1] * p[0] / 2.0
    yield from _waves(drive, v, w)
    angle = drive.angle_rad
    for wave, turn in (("sin", np.sin), ("cos", np.cos)):
        rim = (left * turn(angle[:, 0]), right * turn(angle[:, 1]))
        perturbation = np.column_stack([rim[0] + rim[1], np.zeros_like(v), 2.0 * (rim[1] - rim[0]) / p[1]])
        yield Term(f"rim speed += {{:.4g}} {wave}(wheel angle) of itself", perturbation)


def _waves(drive: GriddedDrive, v: Array, w: Array) -> Iterator[Term]:
    """Ground that carries more and less in turn: the slowest cosines of the time over the whole log."""
    since_s, settings = drive.t_s - drive.t_s[0], drive.settings.terms
    waves = [np.cos(math.pi * number * since_s / float(since_s[-1])) for number in range(1, settings.waves + 1)]
    for axis, speed, name in ((0, v, "v_x += {:.2g} v"), (2, w, "omega += {:.2g} omega")):
        first, *others = (_on(axis, wave * speed) for wave in waves)
        yield Term(
            f"{name} times what varies slowly with time", first, further_waves=tuple(others), usual=settings.usual_wave
        )


def with_known_terms(drive: GriddedDrive, effects: Iterable[EffectSetting], p: Array, delay_s: float) -> GriddedDrive:
    """Return the drive with what the terms among `effects` add; `p` is the parameter vector of the body."""
    u, (v, w, a) = drive.delayed_commands(delay_s), motion(drive, p)
    of_commands: list[Array] = []
    of_motion: list[Array] = []
    for setting in effects:
        term = TERMS.get(setting.name)
        if term is None:
            continue
        is_of_commands = term.target == COMMAND
        feature = _of_commands(term, u, drive.t_s) if is_of_commands else _of_body(term, v, w, a, drive.t_s)
        reach = setting.values[REACH.name]
        added = setting.values["k"] * np.clip(feature, -reach, reach)
        if is_of_commands:
            of_commands.append(added)
        else:
            of_motion.append(_on(BODY_TARGETS.index(term.target), added))
    command, moved = (sum(each[1:], each[0]) if each else None for each in (of_commands, of_motion))
    return replace(drive, known_command=command, known_motion=moved)


def _of_commands(term: GenericTerm, u: Array, t_s: Array) -> Array:
    """Evaluate the feature of a term of the commands at the nodes, (M, 2)."""
    if term.memory is not None:
        return term.memory.at_nodes(GRID_STEP_S, u, u[:, ::-1])
    return np.asarray(COMMAND_FEATURES[term.feature](u, u[:, ::-1], t_s[:, None]))


def _of_body(term: GenericTerm, v: Array, w: Array, a: Array, t_s: Array) -> Array:
    """Evaluate the feature of a term of the body at the nodes, (M,)."""
    if term.memory is not None:
        return term.memory.at_nodes(GRID_STEP_S, v, w)
    return np.asarray(BODY_FEATURES[term.feature](v, w, a, t_s))


def _with_place(name: str) -> str:
    """Replace the k in a term's equation by a format field for its value."""
    return name.replace("+= k ", "+= {:.4g} ")


def places(channel: BodyChannel, p: Array) -> Iterator[Term]:
    """Discs of the floor in which turning is different."""
    settings = channel.settings.terms
    x, y = _where(channel)
    low_x, high_x, low_y, high_y = (*np.quantile(x, (0.02, 0.98)), *np.quantile(y, (0.02, 0.98)))
    if (high_x - low_x) * (high_y - low_y) > settings.largest_floor_m2:
        return
    across, along = (
        np.arange(low, high + 1e-9, settings.disc_spacing_m) for low, high in ((low_x, high_x), (low_y, high_y))
    )
    yield from _discs(
        channel, p, ((cx, cy, radius) for cx in across for cy in along for radius in settings.disc_radii_m)
    )


def places_near(channel: BodyChannel, p: Array, disc: tuple[float, float, float]) -> Iterator[Term]:
    """Discs of the floor closer around one than `places` lie to each other."""
    x, y, radius = disc
    settings = channel.settings.terms
    sizes = [size for size in (radius + step for step in settings.disc_size_steps_m) if size > 0.0]
    steps = [settings.disc_spacing_m * share for share in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    yield from _discs(channel, p, ((x + dx, y + dy, size) for dx in steps for dy in steps for size in sizes))


def _where(channel: BodyChannel) -> tuple[Array, Array]:
    """Measured position at the nodes, (M,) each."""
    t_s, samples, measured = channel.drive.t_s, channel.samples, channel.measured
    return np.interp(t_s, samples.t_s, measured[:, 0]), np.interp(t_s, samples.t_s, measured[:, 1])


def _discs(channel: BodyChannel, p: Array, discs: Iterable[tuple[float, float, float]]) -> Iterator[Term]:
    """Yield terms for the discs inside and outside of which much of all turning was done."""
    x, y = _where(channel)
    settings = channel.settings.terms
    speed = channel.drive.speed_rad_s
    w = p[0] / p[1] * (speed[:, 1] - speed[:, 0])
    turning = np.abs(w)
    turned = max(float(turning.sum()), 1e-9)
    centre, squares = (math.nan, math.nan), np.empty(0)
    for centre_x, centre_y, radius in discs:
        if centre != (centre_x, centre_y):
            centre, squares = (centre_x, centre_y), (x - centre_x) ** 2 + (y - centre_y) ** 2
        inside = squares < radius * radius
        if settings.least_inside < float(turning @ inside) / turned < settings.most_inside:
            where = f"within {radius:.2f} m of ({centre_x:.2f}, {centre_y:.2f}) m"
            perturbation = _on(2, np.where(inside, w, 0.0))
            disc = (float(centre_x), float(centre_y), float(radius))
            yield Term(f"omega += {{:.4g}} omega {where}", perturbation, disc=disc)


def _on(axis: int, feature: Array) -> Array:
    perturbation = np.zeros((feature.size, 3))
    perturbation[:, axis] = feature
    return perturbation


def smoothed(values: Array, settings: TermSettings) -> Array:
    """Values at the nodes without what changes from one to the next."""
    window = np.hanning(2 * settings.smooth_nodes + 1)
    return np.convolve(values, window / window.sum(), "same")


@dataclass(frozen=True)
class WithTerms:
    """The channel `inner` with unnamed terms, whose coefficients are further entries of the vector, always free.

    The other fields are those of `inner`, and wider where they speak of the vector.
    """

    inner: WheelChannel | BodyChannel
    terms: tuple[Term, ...]
    layout: Layout
    neutral: Array
    free: tuple[int, ...]
    settings: GapSettings
    block: Index
    count: int
    trusted_blocks: float
    # What the terms add with the coefficients that were asked for last.
    kept: dict[bytes, Array] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, inner: WheelChannel | BodyChannel, terms: tuple[Term, ...]) -> WithTerms:
        """Return a channel extended by unnamed terms."""
        plain = inner.layout
        names = tuple(
            f"term{k}" if part == 0 else f"term{k}.{part}"
            for k, term in enumerate(terms)
            for part in range(len(term.features))
        )
        features = [feature for term in terms for feature in term.features]
        sizes = [max(float(np.sqrt((feature**2).mean())), 1e-12) for feature in features]
        usual = np.array([term.usual for term in terms for _ in term.features])
        first, none = len(plain.columns), np.zeros(len(features))
        layout = replace(
            plain,
            columns=plain.columns + names,
            neutral=np.append(plain.neutral, none),
            step=np.append(plain.step, [1e-3 / size for size in sizes]),
            low=np.append(plain.low, none - math.inf),
            high=np.append(plain.high, [term.highest for term in terms for _ in term.features]),
            precision=np.append(plain.precision, usual**-2.0),
            place={**plain.place, **{name: first + k for k, name in enumerate(names)}},
        )
        neutral, free = np.append(inner.neutral, none), (*inner.free, *range(first, first + none.size))
        return cls(inner, terms, layout, neutral, free, inner.settings, inner.block, inner.count, inner.trusted_blocks)

    def split(self, p: Array) -> tuple[Array, Array | None]:
        """Split a vector into that of the inner channel and what the terms add at the nodes.

        The second array is shared by later calls: do not write to it.
        """
        width = len(self.inner.layout.columns)
        coefficients = p[width:]
        key = coefficients.tobytes()
        if key not in self.kept:
            perturbation = np.zeros_like(self.terms[0].perturbation)
            features = (feature for term in self.terms for feature in term.features)
            for coefficient, feature in zip(coefficients, features, strict=True):
                perturbation += coefficient * feature
            self.kept.clear()
            self.kept[key] = perturbation
        return p[:width], self.kept[key]

    def residual(self, p: Array) -> Array:
        """Return the whitened residuals at a vector."""
        core, perturbation = self.split(p)
        return self.inner.residual(core, perturbation)


ResidualChannel = WheelChannel | BodyChannel | WithTerms
"""A channel as it is fitted: the number of its residuals is n, of which `count` are used, in the time `block` (n,)."""
