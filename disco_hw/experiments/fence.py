"""Trials of the fence: random rooms with tasks, wild manual drives, and planners alone in tight rooms.

Each drive is one line of `drives.jsonl`, so that a campaign that was broken off goes on where it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.config.robot_file import prior_around
from disco_hw.experiments.fence_drives import (
    FencedDrive,
    along_drive,
    corridor_setup,
    fenced_setup,
    manual_drive,
    random_room,
    room_drive,
    task_drive,
    tight_setup,
    untold_plant,
    wall_drive,
)
from disco_hw.fence import Fence
from disco_hw.fence.clearance import fence_outlines
from disco_hw.files import FileKind, read_bytes
from disco_hw.model import Model
from disco_hw.reports import write_pictures
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import Setup

Array = NDArray[np.float64]
Progress = Callable[[str], None]
RunDrive = Callable[[np.random.Generator], FencedDrive]
DRIVES = "drives.jsonl"
# Streams of random numbers apart from those of the other kinds, which count from 0.
ALONE_STREAM, CORRIDOR_STREAM = 99, 98
ALONE = "guard off: "
"""Begins the names of kinds in which the planner alone keeps inside."""
# Chosen: what adaptation may learn in before the drive counts.
LEARNING_S = 12.0
# Chosen: at 50 Hz ten a second, enough to draw the drive.
_POSES_EVERY = 5


@dataclass(frozen=True, slots=True)
class FenceOptions:
    """Options of the trials: how many of each, how far the true parameters are off, and how long a drive is (s)."""

    rooms: int = 200
    manual: int = 200
    alone: int = 40
    off: float = 0.15
    seconds: float = 12.0
    seed: int = 1


class DriveLine(msgspec.Struct, frozen=True, kw_only=True):
    """One drive as a line of `drives.jsonl`; every fifth of its poses, rounded to millimetres."""

    kind: str
    number: int
    off: float
    seconds: float
    seed: int
    fence: Fence
    least_m: float
    stops: int
    left_m: tuple[float, ...]
    way_m: float
    poses: list[tuple[float, float, float]]


CONTENDERS: dict[str, tuple[str, str, bool]] = {
    "point model": ("point", "off", True),
    "sigma points, model file": ("ut", "off", False),
    "sigma points, prior": ("ut", "off", True),
    "sigma points, after adaptation": ("ut", "fast", True),
}
"""Planners without the guard: uncertainty, adaptation, and whether the belief is the prior around the nominal robot."""
CORRIDOR, ADAPTING = "corridor, ", "sigma points, adapting"


def alone_drive(
    rng: np.random.Generator,
    off: float,
    seconds: float,
    contender: tuple[str, str, bool],
    setup_of: Callable[[np.random.Generator], Setup] = tight_setup,
    learning_s: float = LEARNING_S,
) -> FencedDrive:
    """Drive what `setup_of` returns by one of the CONTENDERS alone; the same rooms and robots for all.

    Who adapts has `learning_s` to do so first.
    """
    setup = setup_of(rng)
    plant, noise = untold_plant(rng, off), int(rng.integers(1 << 30))
    uncertainty, adaptation, by_prior = contender
    control = msgspec.structs.replace(setup.config.control, uncertainty=uncertainty, adaptation=adaptation)
    setup = replace(setup, config=msgspec.structs.replace(setup.config, control=control))
    if by_prior:
        robot = msgspec.structs.replace(setup.config.robot, axial_distance_m=0.415, x_icr_m=0.238, wheel_radius_m=0.061)
        config = msgspec.structs.replace(setup.config, robot=robot, prior=prior_around(robot))
        setup = replace(setup, config=config, model=Model.nominal(robot, config.prior))
    planner = create_planner(setup.config, setup.model)
    learning_s = learning_s if adaptation != "off" else 0.0
    return task_drive(setup, plant, planner, seconds + learning_s, noise, guarded=False, learning_s=learning_s)


_DRIVES = FileKind("the drives of a campaign", 64 * 1024 * 1024, "name another folder with -o")


_GUARDED = "with the guard"
_TITLES = {
    _GUARDED: _GUARDED,
    ALONE: "planner alone, circle in a tight room",
    ALONE + CORRIDOR: "planner alone, closed corridor and soft brakes",
}


def _group(kind: str) -> str:
    """Return the key of `_TITLES` under which a kind of drive is shown."""
    return next((group for group in (ALONE + CORRIDOR, ALONE) if kind.startswith(group)), _GUARDED)


class Campaign:
    """Drives of one folder: those that are written there already, and those that are still to be driven."""

    def __init__(self, out: Path, options: FenceOptions, progress: Progress) -> None:
        self._file, self._options, self._progress = out / DRIVES, options, progress
        out.mkdir(parents=True, exist_ok=True)
        lines = read_bytes(self._file, _DRIVES)[0].splitlines() if self._file.exists() else []
        self._done: dict[str, dict[int, DriveLine]] = {}
        for line in lines:
            # The last line of a campaign that was killed may be half a line.
            try:
                one = msgspec.json.decode(line, type=DriveLine)
            except msgspec.DecodeError:
                continue
            if (one.off, one.seconds, one.seed) == (options.off, options.seconds, options.seed):
                self._done.setdefault(one.kind, {})[one.number] = one

    def gather(self, kind: str, count: int, drive: RunDrive, stream: int) -> None:
        """Drive what is missing of `count` drives; those of one `stream` have the same rooms and robots."""
        options, done = self._options, self._done.setdefault(kind, {})
        for number in range(count):
            if number in done:
                continue
            found = drive(np.random.default_rng([options.seed, stream, number]))
            poses = [(round(x, 3), round(y, 3), round(yaw, 3)) for x, y, yaw in found.poses[::_POSES_EVERY].tolist()]
            one = DriveLine(
                kind=kind, number=number, off=options.off, seconds=options.seconds, seed=options.seed,
                fence=found.fence, least_m=found.least_m, stops=found.stops, left_m=found.left_m, way_m=found.way_m,
                poses=poses,
            )  # fmt: skip
            with self._file.open("ab") as sink:
                sink.write(msgspec.json.encode(one) + b"\n")
            done[number] = one
            if len(done) % 10 == 0 or number + 1 == count:
                breaches = sum(each.least_m < 0.0 for each in done.values())
                self._progress(f"{kind}: {len(done)} of {count}, {breaches} breaches")

    @property
    def result(self) -> FenceResult:
        """Result of all drives with these options."""
        return FenceResult(self._options, {kind: list(lines.values()) for kind, lines in self._done.items() if lines})


@dataclass(frozen=True, eq=False, slots=True)
class FenceResult:
    """Results of all drives: with the guard, and by the planner alone under each kind of belief."""

    options: FenceOptions
    drives: dict[str, list[DriveLine]]

    def rows(self) -> list[dict[str, Any]]:
        """For each kind of drive: how many, breaches, least clearance, stops, distance left at a stop, way (m)."""
        found = []
        for name, drives in self.drives.items():
            left = [value for one in drives for value in one.left_m]
            found.append(
                {
                    "drives": name,
                    "count": len(drives),
                    "breaches": sum(one.least_m < 0.0 for one in drives),
                    "least_clearance_m": min(one.least_m for one in drives),
                    "stops": sum(one.stops for one in drives),
                    "left_at_stop_median_m": float(np.median(left)) if left else math.nan,
                    "way_median_m": float(np.median([one.way_m for one in drives])),
                }
            )
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict."""
        rows = [
            {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
            for row in self.rows()
        ]
        return {"options": asdict(self.options), "drives": rows}

    def table(self) -> str:
        """Return the result as text."""
        lines = [f"{'':<42}{'drives':>8}{'breaches':>10}{'least, m':>10}{'stops':>8}{'left, m':>9}{'way, m':>8}"]
        for row in self.rows():
            left = row["left_at_stop_median_m"]
            lines.append(
                f"{row['drives']:<42}{row['count']:>8}{row['breaches']:>10}{row['least_clearance_m']:>10.3f}"
                f"{row['stops']:>8}{'-' if math.isnan(left) else format(left, '.3f'):>9}{row['way_median_m']:>8.1f}"
            )
        return "\n".join(lines)

    def write_pictures(self, path: Path) -> None:
        """Write a room with the robot's way, and how near each kind came; PNG, PDF and SVG."""
        from matplotlib.figure import Figure  # noqa: PLC0415

        figure = Figure(figsize=(11.0, 8.0), layout="constrained")
        axes = figure.subplots(2, 2).ravel()
        name, drives = max(self.drives.items(), key=lambda item: len(item[1]))
        shown = drives[0]
        for line in fence_outlines(shown.fence):
            axes[0].plot(*line.T, color="firebrick")
        axes[0].plot(*np.array(shown.poses)[:, :2].T, color="navy", linewidth=0.8)
        axes[0].set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"one of {len(drives)}: {name}")
        for axis, group in zip(axes[1:], _TITLES, strict=True):
            for name, drives in self.drives.items():
                if _group(name) == group:
                    least = np.sort([one.least_m for one in drives])
                    label = name.removeprefix(group)
                    axis.step(least, np.linspace(0.0, 1.0, len(least)), label=label, where="post")
            axis.axvline(0.0, color="firebrick", linewidth=0.8)
            axis.set(xlabel="least distance to the fence (m)", ylabel="share of drives", title=_TITLES[group])
            if axis.has_data() and len(axis.lines) > 1:
                axis.legend(fontsize=7)
        write_pictures(figure, path)


def gather_corridors(campaign: Campaign, options: FenceOptions) -> None:
    """Drive the planners alone towards the closed ends of corridors; who adapts has the way there to do so."""
    for name, contender in CONTENDERS.items():
        drive = partial(
            alone_drive, off=options.off, seconds=options.seconds, contender=contender, setup_of=corridor_setup,
            learning_s=0.0,
        )  # fmt: skip
        kind = ALONE + CORRIDOR + (name if contender[1] == "off" else ADAPTING)
        campaign.gather(kind, options.alone, drive, CORRIDOR_STREAM)


def run_fence(options: FenceOptions, out: Path, progress: Progress) -> FenceResult:
    """Drive what `out` does not have yet of all this; takes an hour or two."""
    campaign, off, seconds = Campaign(out, options, progress), options.off, options.seconds

    def wild(rng: np.random.Generator) -> FencedDrive:
        setup = fenced_setup(random_room(rng, int(rng.integers(0, 4))))
        return manual_drive(setup, untold_plant(rng, off), rng, seconds)

    def wall(rng: np.random.Generator) -> FencedDrive:
        return wall_drive(fenced_setup(random_room(rng, 0)), untold_plant(rng, off), rng)

    campaign.gather("by hand, wild", options.manual, wild, 0)
    campaign.gather("by hand, at a wall at 0.3 m/s", max(1, options.manual // 4), wall, 1)
    campaign.gather(
        "circle 0.15 m inside, 0.3 m/s", max(1, options.rooms // 10), lambda rng: along_drive(rng, off, seconds), 2
    )
    for name, contender in CONTENDERS.items():
        drive = partial(alone_drive, off=off, seconds=seconds, contender=contender)
        campaign.gather(ALONE + name, options.alone, drive, ALONE_STREAM)
    gather_corridors(campaign, options)
    campaign.gather("task in a random room", options.rooms, lambda rng: room_drive(rng, off, seconds), 3)
    return campaign.result
