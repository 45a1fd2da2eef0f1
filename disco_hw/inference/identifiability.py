"""What a log leaves open, in words: directions of the posterior that stay wide, and what the drive lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.excitation import Excitation
from disco_hw.inference.simulate import NAMES

Array = NDArray[np.float64]

WORDS = ("x_icr", "the wheel radius", "the axial distance")
WIDE = 0.2
_SHARE = 0.45
_STRAIGHT = 0.08
_LITTLE_ROLL_RAD = 12.0
_LITTLE_TURN_RAD = 6.0
_STEADY_SPREAD = 0.12
_STEADY_SHARE = 0.8

PAPER = (
    "the paper's statistics (mean x, mean y, mean dx, mean dy) hold the centre of the path and the way from its first "
    "to its last pose divided by the number of samples: on a circle the centre tells x_icr and the axial distance, but "
    "the wheel radius enters only through the angle at which the drive happens to end, so it stays about as wide as "
    "the prior; run without --paper"
)


@dataclass(frozen=True, slots=True)
class Driven:
    """How far the wheels rolled (rad, mean of both) straight ahead, in reverse; their difference in left and right
    turns (rad); and whether nearly all of the motion was at one speed and one turn.
    """

    straight_rad: float
    reverse_rad: float
    left_rad: float
    right_rad: float
    steady: bool


def driven(drive: Excitation) -> Driven:
    """Take stock of a drive."""
    left, right = drive.wheel_rad_s.T
    mean, difference = 0.5 * (left + right), right - left
    moving = drive.moving > 0.0
    straight = moving & (np.abs(difference) < _STRAIGHT * np.abs(mean))
    return Driven(
        float(np.abs(mean[straight]).sum() * drive.step_s),
        float(-mean[mean < 0.0].sum() * drive.step_s),
        float(difference[difference > 0.0].sum() * drive.step_s),
        float(-difference[difference < 0.0].sum() * drive.step_s),
        _is_steady(mean[moving], difference[moving]),
    )


def _is_steady(mean: Array, difference: Array) -> bool:
    speed, turn = float(np.median(mean)), float(np.median(difference))
    size = abs(speed) + 0.5 * abs(turn)
    if size == 0.0:
        return False
    # Quantised encoders make every sample coarse; half a second smooths that out.
    window = np.ones(25) / 25.0
    if mean.size < 4 * window.size:
        return False
    smooth_mean, smooth_turn = (np.convolve(values, window, mode="valid") for values in (mean, difference))
    near = (np.abs(smooth_mean - speed) + 0.5 * np.abs(smooth_turn - turn)) < _STEADY_SPREAD * size
    return bool(near.mean() > _STEADY_SHARE) and abs(turn) > _STRAIGHT * abs(speed)


def undetermined(draws: Array, low: Array, high: Array, drive: Excitation, paper: bool) -> list[str]:
    """Sentences on what stays open, the widest first; empty if the log determines all.

    `draws` (n, 3) of the posterior, `low`, `high` (3,) of the prior, in the order of `NAMES`.
    """
    found = [*_wide_directions(draws, low, high, drive)]
    if paper:
        found.append(PAPER)
    if driven(drive).steady:
        found.append(
            "a steady circle cannot tell the wheel radius from slip in proportion to speed, the axial distance from "
            "slip in turns or from wheels of different size, nor x_icr from side slip or a heading bias of the sensor; "
            "drive a straight line, then turn both ways at two speeds"
        )
    return found


def _wide_directions(draws: Array, low: Array, high: Array, drive: Excitation) -> list[str]:
    """Main axes of the posterior, in units of the prior's standard deviation, that are still wide."""
    prior_sd = (high - low) / np.sqrt(12.0)
    variances, axes = np.linalg.eigh(np.cov((draws / prior_sd).T))
    sentences = []
    for variance, axis in sorted(zip(variances, axes.T, strict=True), key=lambda pair: -pair[0]):
        wide = float(np.sqrt(max(variance, 0.0)))
        if wide < WIDE:
            continue
        involved = [index for index in range(len(NAMES)) if abs(axis[index]) > _SHARE]
        names = " and ".join(WORDS[index] for index in involved)
        together = " together" if len(involved) > 1 else ""
        sentences.append(
            f"{names}{together} {'are' if together else 'is'} left open: {100.0 * min(wide, 1.0):.0f} % of the prior's "
            f"width remains{_combination(involved, axis)}; {_remedy(involved, driven(drive))}"
        )
    return sentences


def _combination(involved: list[int], axis: Array) -> str:
    if len(involved) != 2:
        return ""
    same = axis[involved[0]] * axis[involved[1]] > 0.0
    return ", they can grow together" if same else ", one can grow while the other shrinks"


def _remedy(involved: list[int], done: Driven) -> str:
    wishes = []
    if 1 in involved and done.straight_rad < _LITTLE_ROLL_RAD:
        wishes.append("drive straight lines of a metre or more")
    if 0 in involved or 2 in involved:
        if min(done.left_rad, done.right_rad) < _LITTLE_TURN_RAD:
            wishes.append("turn left and right on the spot, a full turn or more each")
        else:
            wishes.append("turn more and at several speeds")
    return " and ".join(wishes) if wishes else "drive longer"
