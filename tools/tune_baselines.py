"""Finds the gains of the classical followers on training robots: `python -m tools.tune_baselines`.

The simplex of Nelder and Mead over the logarithms of the gains; what is made small is the mean RMS distance over robots
and ways. Robots 0 to 4: the benchmark judges on others. What it prints is what `control/baselines.py` holds.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from disco_hw.control.baselines import Kanayama, Law, LinearQuadratic, PurePursuit
from tools.foreign_plant import robots
from tools.tracking import classical, drive, tracks

STARTS: dict[str, tuple[Law, tuple[str, ...]]] = {
    "pure_pursuit": (PurePursuit(look_ahead_m=0.2, preview_s=0.1), ("look_ahead_m", "preview_s")),
    "pure_pursuit_integral": (
        PurePursuit(look_ahead_m=0.2, integral=2.0, preview_s=0.1), ("look_ahead_m", "integral", "preview_s"),
    ),
    "kanayama": (Kanayama(left=25.0, yaw=9.0, integral=2.0, preview_s=0.1), ("left", "yaw", "integral", "preview_s")),
    "lqr": (
        LinearQuadratic(sum_weight=100.0, left_weight=300.0, yaw_weight=20.0, preview_s=0.1),
        ("sum_weight", "left_weight", "yaw_weight", "preview_s"),
    ),
}  # fmt: skip
TRAINING = robots(0, 5)
LARGEST_MM = 200.0


def loss_mm(law: Law) -> float:
    """Mean RMS distance over robots and ways; a drive that is lost counts as LARGEST_MM."""
    found = [
        min(drive(classical(law), robot, track, duration_s=25.0, seed=seed).after().rms_mm, LARGEST_MM)
        for seed, robot in enumerate(TRAINING)
        for track in tracks().values()
    ]
    return float(np.mean(found))


def tuned(law: Law, names: tuple[str, ...], evaluations: int) -> tuple[Law, float]:
    """The law with the best gains found, and its loss."""

    def with_logs(logs: np.ndarray) -> Law:
        return replace(law, **dict(zip(names, np.exp(logs).tolist(), strict=True)))  # type: ignore[type-var]

    start = np.log([getattr(law, name) for name in names])
    simplex = np.vstack([start, start + 0.6 * np.eye(len(names))])
    options = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02}
    result = minimize(lambda logs: loss_mm(with_logs(logs)), start, method="Nelder-Mead", options=options)
    return with_logs(result.x), float(result.fun)


def main() -> None:
    for name in sys.argv[1:] or STARTS:
        law, loss = tuned(*STARTS[name], evaluations=45)
        print(f"{name}: {law}, {loss:.2f} mm", flush=True)


if __name__ == "__main__":
    main()
