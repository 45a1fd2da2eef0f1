"""Values that `gap` tells as found and should not: at a bound, with an interval wider than the value, or exceeded.

`DISCO_HW_DATA=FOLDER python -m tools.gap_told [--mujoco SEEDS] [NAME...]`: measured logs whose path holds a NAME, all
without one, and drives of the robot in MuJoCo with each of its effects hidden. Asked for is none.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator, Sequence

# A second thread for the small matrices of a search only spins beside the first one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from disco_hw.effects.registry import REGISTRY
from disco_hw.errors import LogError
from disco_hw.gap import GapReport, find_gap
from disco_hw.gap.report import EffectFinding
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from tools.gap_halves import measured_logs, read
from tools.mujoco_robot import EFFECTS, TRACK_M, WHEEL_RADIUS_M, record

AT_BOUND = 0.01
"""A value this close to an end of its range, as a share of the end, is at it."""
MEAN_S = 0.4
BEYOND = 1.05
BEYOND_S = 1.0
"""A limit is exceeded where means of the wheels' speeds over 0.4 s are above it by 5 % for a second in all."""


def wrongs(effect: EffectFinding, log: DriveLog, model: Model) -> Iterator[str]:
    """What speaks against telling an effect as found."""
    described = REGISTRY[effect.name]
    wide = []
    for parameter in described.parameters:
        found = effect.parameters[parameter.name]
        ends = {parameter.low, parameter.high} - {parameter.neutral}
        if any(math.isfinite(end) and abs(found.value - end) <= AT_BOUND * abs(end) for end in ends):
            yield f"{parameter.name} {found.value:.3g} at its bound"
        size = found.value if math.isinf(parameter.neutral) else abs(found.value - parameter.neutral)
        wide.append(found.high - found.low > size)
    if all(wide):
        said = (f"{name} {one.value:.3g} [{one.low:.3g}, {one.high:.3g}]" for name, one in effect.parameters.items())
        yield f"wider than the value: {', '.join(said)}"
    if described.is_limit and described.limited is not None:
        limit = next(iter(effect.parameters.values()))
        seconds = beyond_s(log, model, effect.name, limit.value)
        if seconds > BEYOND_S:
            yield f"{limit.value:.3g} exceeded for {seconds:.1f} s"


def beyond_s(log: DriveLog, model: Model, name: str, limit: float) -> float:
    """For how long the wheels of a log are beyond a limit."""
    wheels, limited = log.wheels, REGISTRY[name].limited
    assert limited is not None
    seconds = 0.0
    for segment in np.unique(wheels.segment):
        inside = wheels.segment == segment
        t_s = np.arange(wheels.t_s[inside][0], wheels.t_s[inside][-1], MEAN_S)
        if t_s.size > 1:
            angles = (wheels.left_angle_rad, wheels.right_angle_rad)
            turned = np.column_stack([np.interp(t_s, wheels.t_s[inside], angle[inside]) for angle in angles])
            reached = limited(np.diff(turned, axis=0) / MEAN_S, (model.wheel_radius_m, model.axial_distance_m))
            seconds += MEAN_S * float((reached > BEYOND * limit).sum())
    return seconds


def drives(names: Sequence[str], seeds: int) -> Iterator[tuple[str, DriveLog, Model]]:
    """Measured logs, and drives in MuJoCo."""
    for path in measured_logs(names):
        yield (path.stem, *read(path))
    for seed in range(1, seeds + 1):
        for hidden in ("nothing", *EFFECTS):
            sizes = {hidden: EFFECTS[hidden][0]} if hidden in EFFECTS else {}
            yield f"mujoco {hidden} {seed}", record(sizes, seed).as_drive(), Model(WHEEL_RADIUS_M, TRACK_M, 0.0)


def said(report: GapReport) -> str:
    """What was told as found, and what as doubtful, in a line."""
    names = ", ".join(effect.name for effect in report.effects) or "nothing"
    return names + "".join(f"; doubtful: {doubt.name}" for doubt in report.doubtful)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap_told", description=(__doc__ or "").split(":")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="logs whose path holds it (all)")
    parser.add_argument("--mujoco", type=int, default=0, metavar="SEEDS", help="and drives in MuJoCo (0)")
    options = parser.parse_args(arguments)
    told, wrong = 0, []
    for name, log, nominal in drives(options.names, options.mujoco):
        try:
            report = find_gap(log, nominal)
        except LogError as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(f"{name}: {said(report)}", flush=True)
        told += len(report.effects)
        for effect in report.effects:
            wrong += [f"{name}: {effect.name}: {why}" for why in wrongs(effect, log, report.model)]
    print("\n".join(["", f"told as found {told}, of which wrongly: {len(wrong)}", *wrong]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
