"""Unnamed terms: physical features of the motion that a channel may depend on, whatever the cause.

Features are made of what was measured or commanded, once, so that they do not change while parameters are fitted, and
their effect goes through the free run: nothing is differentiated but the wheels' speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.channels import BodyChannel, WheelChannel
from disco_hw.gap.layout import Layout
from disco_hw.gap.timeline import CELL_S

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AXES = ("v_x", "v_y", "omega")
_SPAN_NODES = 8
_DISC_RADII_M = (0.5, 0.75, 1.0, 1.3)
_DISC_SPACING_M = 0.4
_LARGEST_FLOOR_M2 = 60.0
_LONGEST_S = 400.0


@dataclass(frozen=True)
class Term:
    """A feature at the nodes, (M, 2) in rad/s of command or (M, 3) in m/s, m/s, rad/s of motion, and how it is written.

    `form` has a place for the coefficient.
    """

    form: str
    push: Array


def wheel_terms(channel: WheelChannel, late_s: float) -> Iterator[Term]:
    """What may be added to both wheels' commands; `late_s` is the dead time that was found."""
    line = channel.timeline
    raw = np.nan_to_num(line.command_rad_s)
    late = max(round(late_s / CELL_S), 0)
    u = np.concatenate([np.repeat(raw[:1], late, axis=0), raw[: raw.shape[0] - late]])
    other = u[:, ::-1]
    sign, size = np.tanh(u / 0.05), np.abs(u)
    growth = np.gradient(u, CELL_S, axis=0)
    angle = line.angle_rad
    t = (line.t_s - line.t_s[0])[:, None]
    features = {
        "u |u|": u * size,
        "u^3": u**3,
        "sign(u)": sign,
        "|u|": size,
        "u^2": u**2,
        "|u_other| sign(u)": np.abs(other) * sign,
        "u_other": other,
        "u_other |u|": other * size,
        "|u_other| u": np.abs(other) * u,
        "u_other^2 sign(u)": other**2 * sign,
        "|u - u_other| sign(u)": np.abs(u - other) * sign,
        "u / (1 + |u|)": u / (1.0 + size),
        "du/dt": growth,
        "|du/dt| sign(u)": np.abs(growth) * sign,
        "u |du/dt|": u * np.abs(growth),
        "t u": t * u / 100.0,
        "t sign(u)": t * sign / 100.0,
        "u sin(wheel angle)": u * np.sin(angle),
        "u cos(wheel angle)": u * np.cos(angle),
    }
    for form, feature in features.items():
        yield Term(f"command {{:+.4g}} {form}", feature)


def body_terms(channel: BodyChannel, p: Array) -> Iterator[Term]:
    """What may be added to the body's velocity; `p` is the vector of the channel."""
    line = channel.timeline
    speed = line.speed_rad_s
    v = 0.5 * p[0] * speed.sum(axis=1)
    w = p[0] / p[1] * (speed[:, 1] - speed[:, 0])
    smooth = _smoothed(v)
    a, dw = np.gradient(smooth, CELL_S), np.gradient(_smoothed(w), CELL_S)
    left, right = speed[:, 0] * p[0] / 2.0, speed[:, 1] * p[0] / 2.0
    angle = line.angle_rad
    t = (line.t_s - line.t_s[0]) / 100.0
    moving = np.minimum(np.abs(speed).max(axis=1) * p[0] / 0.05, 1.0)
    features = {
        "moving": moving,
        "v": v,
        "|v|": np.abs(v),
        "v |v|": v * np.abs(v),
        "v^2": v * v,
        "v^3": v**3,
        "omega": w,
        "|omega|": np.abs(w),
        "omega |omega|": w * np.abs(w),
        "omega^2": w * w,
        "omega^3": w**3,
        "sign(omega)": np.tanh(w / 0.05),
        "sign(v)": np.tanh(v / 0.02),
        "omega / (1 + |omega| / 0.4)": w / (1.0 + np.abs(w) / 0.4),
        "v omega": v * w,
        "v |omega|": v * np.abs(w),
        "|v| omega": np.abs(v) * w,
        "v^2 omega": v * v * w,
        "v omega^2": v * w * w,
        "a": a,
        "|v| a": np.abs(v) * a,
        "v |a|": v * np.abs(a),
        "omega a": w * a,
        "domega/dt": dw,
        "v domega/dt": v * dw,
        "t v": t * v,
        "t omega": t * w,
    }
    for axis, name in enumerate(AXES):
        for form, feature in features.items():
            yield Term(f"{name} {{:+.4g}} {form}", _on(axis, feature))
    for wave, turn in (("sin", np.sin), ("cos", np.cos)):
        rim = (left * turn(angle[:, 0]), right * turn(angle[:, 1]))
        push = np.column_stack([rim[0] + rim[1], np.zeros_like(v), 2.0 * (rim[1] - rim[0]) / p[1]])
        yield Term(f"rim speed {{:+.4g}} {wave}(wheel angle) of itself", push)


def places(channel: BodyChannel, p: Array) -> Iterator[Term]:
    """Discs of the floor in which turning is different."""
    line = channel.timeline
    x = np.interp(line.t_s, channel.samples.t_s, channel.measured[:, 0])
    y = np.interp(line.t_s, channel.samples.t_s, channel.measured[:, 1])
    w = p[0] / p[1] * (line.speed_rad_s[:, 1] - line.speed_rad_s[:, 0])
    low_x, high_x, low_y, high_y = (*np.quantile(x, (0.02, 0.98)), *np.quantile(y, (0.02, 0.98)))
    if (high_x - low_x) * (high_y - low_y) > _LARGEST_FLOOR_M2 or line.t_s.size * CELL_S > _LONGEST_S:
        return
    turned = float(np.abs(w).sum())
    for centre_x in np.arange(low_x, high_x + 1e-9, _DISC_SPACING_M):
        for centre_y in np.arange(low_y, high_y + 1e-9, _DISC_SPACING_M):
            for radius in _DISC_RADII_M:
                inside = np.hypot(x - centre_x, y - centre_y) < radius
                if 0.1 < float(np.abs(w[inside]).sum()) / max(turned, 1e-9) < 0.8:
                    where = f"within {radius:g} m of ({centre_x:.2f}, {centre_y:.2f}) m"
                    yield Term(f"omega {{:+.4g}} omega {where}", _on(2, np.where(inside, w, 0.0)))


def _on(axis: int, feature: Array) -> Array:
    push = np.zeros((feature.size, 3))
    push[:, axis] = feature
    return push


def _smoothed(values: Array) -> Array:
    window = np.hanning(2 * _SPAN_NODES + 1)
    return np.convolve(values, window / window.sum(), "same")


@dataclass(frozen=True)
class WithTerms:
    """A channel with unnamed terms, whose coefficients are further entries of the parameter vector, always free."""

    inner: WheelChannel | BodyChannel
    terms: tuple[Term, ...]
    layout: Layout

    @classmethod
    def of(cls, inner: WheelChannel | BodyChannel, terms: tuple[Term, ...]) -> WithTerms:
        """Extend a channel."""
        plain, count = inner.layout, len(terms)
        names = tuple(f"term{k}" for k in range(count))
        sizes = [max(float(np.sqrt((term.push**2).mean())), 1e-12) for term in terms]
        layout = replace(
            plain,
            columns=plain.columns + names,
            neutral=np.append(plain.neutral, np.zeros(count)),
            step=np.append(plain.step, [1e-3 / size for size in sizes]),
            low=np.append(plain.low, np.full(count, -math.inf)),
            high=np.append(plain.high, np.full(count, math.inf)),
            place={**plain.place, **{name: len(plain.columns) + k for k, name in enumerate(names)}},
        )
        return cls(inner, terms, layout)

    @property
    def neutral(self) -> Array:
        """The vector without any effect or term."""
        return np.append(self.inner.neutral, np.zeros(len(self.terms)))

    @property
    def free(self) -> tuple[int, ...]:
        """Entries that are always fitted: the base and the coefficients."""
        first = len(self.inner.layout.columns)
        return (*self.inner.free, *range(first, first + len(self.terms)))

    @property
    def block(self) -> Index:
        """Block of time of each residual."""
        return self.inner.block

    @property
    def count(self) -> int:
        """Number of residuals that are used."""
        return self.inner.count

    def split(self, p: Array) -> tuple[Array, Array | None]:
        """The inner channel's vector, and what the terms add at the nodes."""
        width = len(self.inner.layout.columns)
        push = np.zeros_like(self.terms[0].push)
        for coefficient, term in zip(p[width:], self.terms, strict=True):
            push += coefficient * term.push
        return p[:width], push

    def residual(self, p: Array) -> Array:
        """Whitened residuals."""
        core, push = self.split(p)
        return self.inner.residual(core, push)
