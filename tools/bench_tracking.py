"""Who follows a line best on robots whose parameters are wrong: classical followers and DISCO, on foreign robots.

Wheel radius, axle and x_icr of every robot are off by up to 15 %, and nobody is told; the motors' lag and dead band are
known to all. From rest on the line; figures are of 5 to 30 s, at 50 plans a second. The gains of the classical ones
were found on robots 0 to 4 (`python -m tools.tune_baselines`); these are robots 1000 on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from disco_hw.control import DiscoSettings
from disco_hw.control.baselines.laws import Kanayama, LinearQuadratic, PurePursuit
from tools.foreign_plant import robots
from tools.tracking import Contender, classical, disco, drive, tracks

FIRST = 1000
SPEED_M_S, RATE_HZ = 0.2, 50.0


def contenders() -> dict[str, Contender]:
    """The rows of the table."""
    settings = DiscoSettings.for_speed(SPEED_M_S, RATE_HZ)
    return {
        "pure_pursuit": classical(PurePursuit()),
        "pure_pursuit_integral": classical(PurePursuit(look_ahead_m=0.081, integral=3.04, preview_s=0.142)),
        "kanayama": classical(Kanayama()),
        "lqr": classical(LinearQuadratic()),
        "disco_point": disco(replace(settings, uncertainty="point")),
        "disco_ut": disco(settings),
        "disco_adapting": disco(settings, learns=True),
        "disco_offset_free": disco(replace(settings, offset_free=True), learns=True),
        "disco_truth": disco(settings, knows=True),
        "kanayama_truth": classical(Kanayama(), knows=True),
    }


def run(count: int = 20, names: tuple[str, ...] | None = None) -> dict[str, float]:
    """For each controller and way: median and worst RMS and median signed distance (mm), travel (rot/s^2), speed."""
    figures: dict[str, float] = {}
    for name, contender in contenders().items():
        if names is not None and name not in names:
            continue
        for way, track in tracks(SPEED_M_S).items():
            drives = [
                drive(contender, robot, track, rate_hz=RATE_HZ, seed=seed).after()
                for seed, robot in enumerate(robots(FIRST, count))
            ]
            key = f"tracking.{name}.{way}"
            figures[f"{key}.rms_median_mm"] = float(np.median([one.rms_mm for one in drives]))
            figures[f"{key}.rms_worst_mm"] = max(one.rms_mm for one in drives)
            figures[f"{key}.signed_median_mm"] = float(np.median([one.signed_mm for one in drives]))
            figures[f"{key}.travel_rot_s2"] = float(np.median([one.travel_rot_s2 for one in drives]))
            figures[f"{key}.speed_m_s"] = float(np.median([one.speed_m_s for one in drives]))
    return figures


if __name__ == "__main__":
    for key, value in run(6).items():
        print(f"{key:60} {value:10.3g}")
