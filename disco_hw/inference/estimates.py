"""The statistics that inference compares: closed-form estimates that carry the information, and the paper's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.excitation import Excitation
from disco_hw.inference.noise import Noise, slip_intensity
from disco_hw.jit import parallel_kernel

Array = NDArray[np.float64]

STATISTICS = ("r", "kappa", "a", "x_icr")
# Against a division by 0; and no robot's axle is longer.
_SMALLEST = 1e-3
_LARGEST_AXIAL_M = 3.0
# Standard deviations of a vague prior on (r, x_icr, kappa), which keeps estimates finite where nothing moves.
_VAGUE = (0.5, 0.5, 3.0)


class Whitening(NamedTuple):
    """Bidiagonal factor, (P,) each: diagonal, and how much of the whitened value before is taken off."""

    diagonal: Array
    carry: Array


def whitening(drive: Excitation, sensor: float, slip: float, grown_s: Array) -> Whitening:
    """Factor that whitens increments of sensor noise and of slip per square root of `grown_s` (P,) between poses."""
    variance = 2.0 * sensor**2 + slip**2 * grown_s
    diagonal, carry = np.ones(variance.size), np.zeros(variance.size)
    starts = drive.starts
    begins = True
    for k in range(variance.size):
        if starts[k]:
            begins = True
            continue
        carry[k] = 0.0 if begins else -(sensor**2) / diagonal[k - 1]
        diagonal[k] = math.sqrt(variance[k] - carry[k] ** 2)
        begins = False
    return Whitening(diagonal, carry)


@parallel_kernel
def estimate_kernel(
    poses: Any, roll: Any, run_pose: Any, position: Any, yaw_whitening: Any, vague: Any, out: Any
) -> None:
    """Estimates (n, 3) of wheel radius, x_icr, kappa from poses (n, P, 3)."""
    for i in range(poses.shape[0]):
        d, e = 0.0, vague[2] ** -2
        for run in range(run_pose.shape[0] - 1):
            u = v = 0.0
            for k in range(run_pose[run] + 1, run_pose[run + 1]):
                diagonal, carry = yaw_whitening.diagonal[k], yaw_whitening.carry[k]
                u = (roll[k, 1] - carry * u) / diagonal
                v = (poses[i, k, 2] - poses[i, k - 1, 2] - carry * v) / diagonal
                d += u * v
                e += u * u
        kappa = d / e
        a, b, c = vague[0] ** -2, 0.0, vague[1] ** -2
        p = q = 0.0
        for run in range(run_pose.shape[0] - 1):
            rx = ry = sx = sy = tx = ty = 0.0
            for k in range(run_pose[run] + 1, run_pose[run + 1]):
                middle = 0.5 * (poses[i, k, 2] + poses[i, k - 1, 2])
                cosine, sine = math.cos(middle), math.sin(middle)
                chord = 2.0 * math.sin(0.5 * kappa * roll[k, 1])
                diagonal, carry = position.diagonal[k], position.carry[k]
                rx = (roll[k, 0] * cosine - carry * rx) / diagonal
                ry = (roll[k, 0] * sine - carry * ry) / diagonal
                sx = (chord * sine - carry * sx) / diagonal
                sy = (-chord * cosine - carry * sy) / diagonal
                tx = (poses[i, k, 0] - poses[i, k - 1, 0] - carry * tx) / diagonal
                ty = (poses[i, k, 1] - poses[i, k - 1, 1] - carry * ty) / diagonal
                a += rx * rx + ry * ry
                b += rx * sx + ry * sy
                c += sx * sx + sy * sy
                p += rx * tx + ry * ty
                q += sx * tx + sy * ty
        determinant = a * c - b * b
        out[i, 0] = (c * p - b * q) / determinant
        out[i, 1] = (a * q - b * p) / determinant
        out[i, 2] = kappa


@dataclass(frozen=True, slots=True)
class Estimates:
    """The statistics of one drive; call it with poses (n, P, 3) for (n, 4) in the order of `STATISTICS`."""

    roll_rad: Array
    run_pose: NDArray[np.int64]
    position: Whitening
    yaw: Whitening

    def __call__(self, poses: Array) -> Array:
        """Statistics (n, 4), finite for every finite pose."""
        radius, x_icr, kappa = self.raw(poses).T
        axial = np.clip(radius / np.where(np.abs(kappa) < _SMALLEST, _SMALLEST, kappa), 0.0, _LARGEST_AXIAL_M)
        return np.column_stack([radius, kappa, axial, x_icr])

    def raw(self, poses: Array) -> Array:
        """Wheel radius, x_icr, kappa (n, 3) by generalised least squares."""
        out = np.empty((poses.shape[0], 3))
        estimate_kernel(poses, self.roll_rad, self.run_pose, self.position, self.yaw, np.array(_VAGUE), out)
        return out

    def theta(self, poses: Array) -> Array:
        """Point estimates (n, 3) of x_icr, wheel radius, axial distance."""
        radius, x_icr, kappa = self.raw(poses).T
        return np.column_stack([x_icr, radius, radius / np.where(np.abs(kappa) < _SMALLEST, _SMALLEST, kappa)])


def estimates(drive: Excitation, noise: Noise) -> Estimates:
    """Return the statistics of a drive, weighted for its noise."""
    slip_m = math.sqrt(0.5 * (noise.slip_forward_m_sqrt_s**2 + noise.about_the_point().slip_left_m_sqrt_s ** 2))
    _, grown_s = slip_intensity(drive, noise.speed_share)
    return Estimates(
        drive.roll_rad,
        drive.run_pose,
        whitening(drive, noise.position_m, slip_m, grown_s),
        whitening(drive, noise.yaw_rad, noise.slip_yaw_rad_sqrt_s, grown_s),
    )


PAPER_STATISTICS = ("mean x", "mean y", "mean dx", "mean dy")


@dataclass(frozen=True, slots=True)
class PaperStatistics:
    """Call it with poses (n, P, 3) for the statistics (n, 4), in metres; steps across runs do not count."""

    starts: NDArray[np.bool_]

    def __call__(self, poses: Array) -> Array:
        """Means over all poses of the log."""
        steps = np.diff(poses[:, :, :2], axis=1)[:, ~self.starts[1:]]
        return np.column_stack([poses[:, :, :2].mean(axis=1), steps.mean(axis=1)])


CROSS_CORRELATION = (
    *(f"<d{state}, {wheel}>" for state in ("x", "y", "yaw") for wheel in ("left", "right")),
    *(f"{moment} d{state}" for moment in ("mean", "variance of") for state in ("x", "y", "yaw")),
)


@dataclass(frozen=True, slots=True)
class CrossCorrelation:
    """BayesSim's statistics (Ramos, Possas, Fox, RSS 2019, section IV): steps of the state against actions.

    Call it with poses (n, P, 3) for the statistics (n, 12) in the order of `CROSS_CORRELATION`: inner products of the
    steps in x, y (m) and yaw (rad) with what either wheel rolled meanwhile (rad), over their number; means and
    variances of the steps. Steps across runs do not count.
    """

    starts: NDArray[np.bool_]
    roll_rad: Array

    def __call__(self, poses: Array) -> Array:
        """Means over all steps of the log."""
        inside = ~self.starts[1:]
        steps = np.diff(poses, axis=1)[:, inside]
        middle, difference = self.roll_rad[1:][inside].T
        wheels = np.column_stack([middle - 0.5 * difference, middle + 0.5 * difference])
        products = np.einsum("nps,pw->nsw", steps, wheels) / wheels.shape[0]
        return np.column_stack([products.reshape(poses.shape[0], -1), steps.mean(axis=1), steps.var(axis=1)])
