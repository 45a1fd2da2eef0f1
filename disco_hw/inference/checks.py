"""Where a log and the simulations could disagree: score tests for what a geometry leaves unexplained.

For each way in which a robot can differ from the model, the whitened errors of displacement and yaw are compared with
the pattern that the difference would leave, after everything that the geometry can absorb is taken out of it. The
result is a t value; simulations of the same drive say how large it may be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from disco_hw.effects.effect import Symptom
from disco_hw.effects.registry import REGISTRY
from disco_hw.inference.estimates import Estimates, Whitening
from disco_hw.inference.excitation import Excitation

Array = NDArray[np.float64]

_LEAST_LEFT = 1e-4


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """One way to differ: a name and what it would look like."""

    name: str
    symptom: Symptom

    @property
    def meaning(self) -> str:
        """What it would look like, in words."""
        return self.symptom.value

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that leave such a pattern."""
        return tuple(effect.name for effect in REGISTRY.values() if self.symptom in effect.symptoms)


CHECKS = (
    ScoreTest("late positions", Symptom.LATE_POSITIONS),
    ScoreTest("sideways with speed", Symptom.SIDEWAYS_WITH_SPEED),
    ScoreTest("sideways in fast turns", Symptom.SIDEWAYS_IN_FAST_TURNS),
    ScoreTest("forward with turning", Symptom.FORWARD_WITH_TURNING),
    ScoreTest("downhill", Symptom.DOWNHILL),
    ScoreTest("downhill across", Symptom.DOWNHILL),
    ScoreTest("shorter at speed", Symptom.SHORTER_AT_SPEED),
    ScoreTest("distance changes", Symptom.DISTANCE_CHANGES),
    ScoreTest("turns on straights", Symptom.TURNS_ON_STRAIGHTS),
    ScoreTest("less turn at speed", Symptom.LESS_TURN_AT_SPEED),
    ScoreTest("late yaw", Symptom.LATE_YAW),
    ScoreTest("left unlike right", Symptom.LEFT_UNLIKE_RIGHT),
    ScoreTest("turning changes", Symptom.TURNING_CHANGES),
)
_POSITION_CHECKS = 8


@dataclass(frozen=True, slots=True)
class Scores:
    """Call it with one log's poses (P, 3) for the t values of all `CHECKS`, (13,); 0 where the drive cannot show it."""

    drive: Excitation
    estimates: Estimates

    def __call__(self, poses: Array) -> Array:
        """Score tests at the geometry that fits these poses best."""
        drive = self.drive
        radius, x_icr, kappa = self.estimates.raw(poses[None])[0]
        inside = ~drive.starts
        dt_s = np.where(inside, np.diff(drive.t_s, prepend=drive.t_s[0]), 1.0)
        steps = np.where(inside[:, None], np.diff(poses, axis=0, prepend=poses[:1]), 0.0)
        middle = poses[:, 2] - 0.5 * steps[:, 2]
        cosine, sine = np.cos(middle), np.sin(middle)
        forward, turn = radius * drive.roll_rad[:, 0], kappa * drive.roll_rad[:, 1]
        chord = 2.0 * np.sin(0.5 * turn)
        later = np.where(drive.t_s > np.median(drive.t_s[drive.moving_s > 0.0]), 1.0, -1.0)

        def body(along: Array, across: Array) -> Array:
            return np.concatenate([along * cosine - across * sine, along * sine + across * cosine])

        nothing = np.zeros(forward.size)
        geometry = [body(forward, nothing), body(nothing, -chord)]
        error = np.concatenate([steps[:, 0], steps[:, 1]]) - geometry[0] - x_icr * geometry[1]
        moved_x, moved_y = np.split(geometry[0] + x_icr * geometry[1], 2)
        tested = [
            np.concatenate([_change(moved_x, drive), _change(moved_y, drive)]),
            body(nothing, forward),
            body(nothing, forward * turn / dt_s),
            body(turn, nothing),
            np.concatenate([drive.moving_s, nothing]),
            np.concatenate([nothing, drive.moving_s]),
            body(forward * np.abs(forward) / dt_s, nothing),
            body(forward * later, nothing),
        ]
        position = _scores(_both(error, geometry, tested, self.estimates.position))
        yaw_tested = [
            forward,
            turn * np.abs(turn) / dt_s,
            _change(turn, drive),
            np.abs(turn),
            turn * later,
        ]
        columns = np.column_stack([steps[:, 2] - turn, turn, *yaw_tested])
        yaw = _scores((_whitened(columns, self.estimates.yaw), 1))
        return np.concatenate([position, yaw])


def _change(values: Array, drive: Excitation) -> Array:
    """Change from the increment before to the one after, per second, (P,); 0 next to the ends of runs."""
    change = np.zeros(values.size)
    starts = drive.starts
    inner = ~(starts[1:-1] | starts[2:] | np.roll(starts, 1)[1:-1])
    span_s = np.maximum(drive.t_s[2:] - drive.t_s[:-2], 1e-6)
    change[1:-1] = np.where(inner, (values[2:] - values[:-2]) / span_s, 0.0)
    return change


def _both(error: Array, geometry: list[Array], tested: list[Array], factor: Whitening) -> tuple[Array, int]:
    """Whitened columns for x and y one below the other, (2 P, 1 + nominal + tested), and the number of nominal ones."""
    columns = np.column_stack([error, *geometry, *tested])
    half = columns.shape[0] // 2
    return np.vstack([_whitened(columns[:half], factor), _whitened(columns[half:], factor)]), len(geometry)


def _whitened(columns: Array, factor: Whitening) -> Array:
    band = np.vstack([factor.diagonal, np.append(factor.carry[1:], 0.0)])
    return np.asarray(solve_banded((1, 0), band, columns, check_finite=False))


def _scores(whitened: tuple[Array, int]) -> Array:
    """t values of the tested columns, (tested,); the first column is the error, then come the nominal ones."""
    columns, nominal = whitened
    base, _ = np.linalg.qr(columns[:, 1 : 1 + nominal])
    tested = columns[:, 1 + nominal :]
    left = tested - base @ (base.T @ tested)
    error = columns[:, 0] - base @ (base.T @ columns[:, 0])
    length, before = np.linalg.norm(left, axis=0), np.linalg.norm(tested, axis=0)
    spread = max(float(error.std()), 1e-12)
    seen = length > _LEAST_LEFT * np.maximum(before, 1e-300)
    return np.asarray(np.where(seen, left.T @ error / np.where(seen, length, 1.0) / spread, 0.0))
