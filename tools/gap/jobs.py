"""The jobs of the study of the search for missing effects: a log with something hidden, and what was found in it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

# Each process works alone on one log: a second thread for its small matrices would only be in another one's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from disco_hw.drive.scripts import separating
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap import find_gap
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from tools.gap import strange_robot
from tools.gap.logs import LARGEST_RAD_S, NAMED, realistic, simulated_drive

MODEL = Model(0.0625, 0.405, 0.25)
# What scripts ask of the robot.
TOP_RAD_S = 6.4
OUTSIDE = ("x_wheel_ripple", "x_motor_droop", "x_shared_supply", "x_speed_squared_drag", "x_carpet_patch")
# Another form of a named family, and the names that count as the family's.
FORMS = {
    "x_second_order_motor": {"motor_lag", "command_delay"},
    "x_saturating_turn_slip": {"turn_slip"},
    "x_smooth_deadband": {"deadband"},
}
# What the simulated motors have, whatever is hidden: naming it is never wrong.
MOTORS = frozenset({"motor_lag"})
# What the timed model holds already: the gap of the refitted one is theirs.
TIMES = frozenset({"motor_lag", "command_delay", "pose_latency"})
# Exactly the same equations: naming either is right.
ALIKE = {"pose_offset": "lateral_icr"}
# What the kinds are, in words for the tables.
KINDS = {
    "single": "one hidden effect of realistic size",
    "none": "nothing hidden",
    "dirty": "nothing hidden, dirty log",
    "pairs": "two hidden effects",
    "weak": "a quarter of the realistic size",
    "outside": "an effect outside the list",
    "forms": "a named family in another form",
    "strange": "a form that no dictionary holds, on a robot of its own: called by no wrong name",
    "circle": "one effect, on a steady circle only: named, alone or in a class, or said to be invisible",
    "asked": "the same robot, circle and then `--script separate`",
}
Hidden = dict[str, float | tuple[float, ...]]


@dataclass(frozen=True)
class Job:
    """One log to make and search."""

    kind: str
    hidden: Hidden
    seed: int

    @property
    def key(self) -> str:
        """What it is, as a file name."""
        return "-".join([self.kind, *self.hidden, str(self.seed)])


@dataclass(frozen=True)
class Result:
    """What was found in one log; errors at 2 s in mm, parameter errors and whether their intervals hold the truth.

    `too_small`: of what was hidden, that which the report says the log could not have shown at the hidden size.
    """

    kind: str
    hidden: list[str]
    seed: int
    named: list[str]
    unnamed: list[str]
    residue: int
    blind: list[str]
    refitted_mm: float
    amended_mm: float
    floor_mm: float
    errors: list[float]
    covered: list[bool]
    cpu_s: float
    alike: list[str] = field(default_factory=list)
    too_small: list[str] = field(default_factory=list)
    timed_mm: float | None = None
    written_mm: float | None = None

    @property
    def told(self) -> bool:
        """Whether it is right, or nothing was named and what was hidden is said to be too small for this log."""
        named = set(self.named) - (MOTORS - set(self.hidden))
        return self.right or not (named or self.unnamed or set(self.hidden) - set(self.too_small))

    @property
    def right(self) -> bool:
        """Whether exactly what was hidden was named; the rule depends on the kind."""
        hidden = {ALIKE.get(name, name) for name in self.hidden}
        named = set(self.named) - (MOTORS - hidden)
        if self.kind == "outside":
            return not named and bool(self.unnamed)
        if self.kind == "strange":
            return named <= {*strange_robot.MOTORS, *strange_robot.KIN.get(self.hidden[0], ())}
        if self.kind == "forms":
            return bool(set(self.named) & FORMS[self.hidden[0]]) and bool(self.residue or self.unnamed)
        if self.kind == "circle":
            told = len(named) == 1 and hidden <= named | set(self.alike)
            return told or (not named and self.hidden[0] in self.blind)
        return named == hidden and not self.unnamed

    @property
    def closed(self) -> float | None:
        """Share of the removable gap that went; None where less than 1 mm could be removed.

        It is the gap of the timed model, as the motors have a lag besides, but where nothing else was hidden than what
        that model holds.
        """
        return self._closed_at(self.amended_mm)

    @property
    def closed_as_written(self) -> float | None:
        """The same of the amended model as it stands in its file, which lacks the terms that no model can carry."""
        return self._closed_at(self.amended_mm if self.written_mm is None else self.written_mm)

    def _closed_at(self, after_mm: float) -> float | None:
        timed = self.timed_mm is not None and not set(self.hidden) <= TIMES
        before_mm = self.timed_mm if timed else self.refitted_mm
        removable = before_mm - self.floor_mm
        return (before_mm - after_mm) / removable if removable > 1.0 else None


def jobs(kind: str, seeds: Iterable[int]) -> Iterator[Job]:
    """Logs of one kind, seed by seed, so that a study that is broken off has seen every effect equally often."""
    for seed in seeds:
        if kind in ("none", "dirty"):
            yield Job(kind, {}, seed)
        elif kind == "pairs":
            first, second = np.random.default_rng([77, seed]).choice(NAMED, 2, replace=False)
            yield Job(kind, realistic(str(first), seed) | realistic(str(second), seed + 1000), seed)
        elif kind == "strange":
            for form in strange_robot.FORMS:
                yield Job(kind, {form: tuple(strange_robot.sampled_parameters(form, seed).values())}, seed)
        else:
            for name in {"outside": OUTSIDE, "forms": tuple(FORMS)}.get(kind, NAMED):
                yield Job(kind, realistic(name, seed, 0.25 if kind == "weak" else 1.0), seed)


def work(job: Job, settings: GapSettings = DEFAULT_SETTINGS) -> Result:
    """Make one log and search it."""
    log, model = _log(job), Model(*strange_robot.NOMINAL) if job.kind == "strange" else MODEL
    began = time.process_time()
    report = find_gap(log, model, top_rad_s=LARGEST_RAD_S, settings=settings)
    cpu_s = time.process_time() - began
    mm = {stage: 1e3 * errors[2.0].position_m for stage, errors in report.gap.items()}
    errors, covered = [], []
    for effect in report.effects:
        if effect.name in job.hidden:
            error, inside = judged(effect.name, job.hidden[effect.name], effect.parameters)
            errors.append(error)
            covered += inside
    return Result(
        job.kind, list(job.hidden), job.seed, [effect.name for effect in report.effects],
        [term.form for term in report.unnamed], len(report.residue),
        [spot.name for spot in report.blind_spots if spot.blind],
        mm["refitted"], mm["amended"], mm["floor"], errors, covered, cpu_s,
        [name for effect in report.effects for name in effect.indistinguishable_from],
        [
            spot.name for spot in report.blind_spots
            if spot.name in job.hidden and too_small(spot, job.hidden[spot.name])
        ],
        mm["timed"], mm.get("written"),
    )  # fmt: skip


def _log(job: Job) -> DriveLog:
    if job.kind == "strange":
        return strange_robot.record(next(iter(job.hidden)), job.seed).log
    circle = job.kind in ("circle", "asked")
    script = separating("separate", TOP_RAD_S) if job.kind == "asked" else None
    return simulated_drive(
        job.hidden, job.seed, "circle" if circle else "rich", job.kind == "dirty", "real", script=script
    )


def too_small(spot: BlindSpot, hidden: float | tuple[float, ...]) -> bool:
    """Whether a blind spot says that a hidden effect of this size could not be seen; a limit, that it is too large."""
    size = abs(hidden[0] if isinstance(hidden, tuple) else hidden)
    if spot.smallest_visible is None:
        return True
    return size > spot.smallest_visible if REGISTRY[spot.name].is_limit else size < spot.smallest_visible


def judged(
    name: str, hidden: float | tuple[float, ...], found: dict[str, ParameterEstimate]
) -> tuple[float, list[bool]]:
    """Relative error of an effect's parameters, taken together, and whether each interval holds the truth."""
    numbers = hidden if isinstance(hidden, tuple) else (hidden,)
    match name:
        case "slope":
            drift, direction = numbers
            truth = {"drift_x_m_s": drift * math.cos(direction), "drift_y_m_s": drift * math.sin(direction)}
        case "surface_change":
            # The two shares are one size; the time has no size to be relative to.
            truth = {"track": numbers[0], "radius": numbers[2]}
        case "wheel_gain":
            truth = {"left": numbers[0], "right": numbers[0]}
        case "encoder_scale":
            truth = {"right": numbers[0]}
        case "pose_offset":
            truth = {"left_m": numbers[0]}
        case _:
            truth = {next(iter(found)): numbers[0]}
    size = math.hypot(*truth.values())
    error = math.hypot(*(found[key].value - value for key, value in truth.items())) / size
    return error, [found[key].low <= value <= found[key].high for key, value in truth.items()]
