"""Runs estimator, planner and governor again on a log's samples and compares what comes out, bit for bit."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from disco_hw.adaptation.guard import geometry_of
from disco_hw.config import RobotConfig
from disco_hw.control.plan import DISTURBANCE_UNTIL_VERSION, PLANNER_VERSION, SAME_SINCE_VERSION
from disco_hw.errors import InputError
from disco_hw.fence.clearance import Boundaries
from disco_hw.log.mcap_log import Metadata
from disco_hw.log.reader import Entry, Log, open_parts
from disco_hw.log.records import (
    STATES,
    BeliefChange,
    Command,
    Controller,
    Estimate,
    FenceChange,
    GuardVerdict,
    Innovation,
    Obstacle,
    Plan,
    Record,
    Task,
)
from disco_hw.runtime import records_of_tick
from disco_hw.runtime.assembly import apply_geometry, create_pipeline, create_planner
from disco_hw.runtime.obstacles import Obstacles
from disco_hw.runtime.pipeline import FollowTask, Manual, Motion, NoPlanner, Off, Pipeline, Silent, Source, Standstill
from disco_hw.runtime.plausibility import FOLLOWS
from disco_hw.runtime.robot_setup import Setup, setup_of_log, task_of
from disco_hw.runtime.safe_area import fence_of_record, report_of_record
from drivers.types import PoseSample, Readings, WheelSample

_TOPICS = (
    "/wheels",
    "/pose",
    "/estimate",
    "/estimate/innovation",
    "/plan",
    "/command",
    "/task",
    "/belief",
    "/fence/guard",
    "/fence",
    "/obstacle",
    "/controller",
)
_COMPARED = (Estimate, Innovation, Plan, Command)
# Whether a command went out is the driver's part, which is not replayed.
_NOT_REPLAYED = {(Command, "in_force"), (Command, "valid_for_s")}
_FLOAT = struct.Struct("<d")
_SOURCES = frozenset(source.value for source in Source)
_PLANNED = frozenset(source.value for source in FOLLOWS)
_REPLAYED = "only logs of `disco-hw run` and `drive` can be replayed"


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where the two runs part; values as text, so that every bit shows."""

    tick: int
    t_ns: int
    field: str
    recorded: str
    replayed: str


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Result of a replay: how many ticks and values were compared, and where they first differ (None if nowhere).

    `parts`: names of the files that were replayed. `next_part_missing`: the last of them goes on in one that is not
    beside it.
    """

    ticks: int
    values: int
    missing_ticks: int
    recorded_by: str
    difference: Difference | None
    tolerance: float
    parts: tuple[str, ...] = ()
    next_part_missing: bool = False

    @property
    def ok(self) -> bool:
        """Whether everything was equal, or as near as was asked."""
        return self.difference is None

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a JSON-serialisable dict."""
        return {"ok": self.ok, **asdict(self)}

    def as_text(self) -> str:
        """Return the report as text."""
        lines = [f"{self.ticks} ticks, {self.values} values compared; recorded by disco-hw {self.recorded_by}"]
        if len(self.parts) > 1:
            lines.append(f"{len(self.parts)} parts: {', '.join(self.parts)}")
        if self.next_part_missing:
            lines.append(f"{self.parts[-1]} goes on in another part, which is not beside it and was not replayed")
        if self.missing_ticks:
            lines.append(f"{self.missing_ticks} ticks are missing from the log: from there on nothing can be equal")
        if self.difference is None:
            lines.append(f"equal to within {self.tolerance:g}" if self.tolerance else "equal bit for bit")
        else:
            d = self.difference
            lines.append(f"first difference at tick {d.tick} ({d.t_ns} ns), {d.field}:")
            lines.append(f"  recorded {d.recorded}")
            lines.append(f"  replayed {d.replayed}")
        return "\n".join(lines)


def replay(path: Path, tolerance: float = 0.0) -> ReplayReport:
    """Replay a log, with all its parts, with the robot.toml and the model that it carries.

    `tolerance`: what numbers may differ by, in their own units or as a share of the larger, whichever allows more; 0
    for bit for bit, which only the machine that recorded promises: another processor rounds sums differently. The plans
    are made as those of the log's planner version.
    Raises LogError for a log that cannot be read and InputError for one that holds no ticks or no robot.toml, that
    continues another, or that has plans of a planner version that is not known here.
    """
    with open_parts(path) as parts:
        log = parts[0]
        if log.metadata.continues_sequence:
            raise InputError(
                f"{path}: continues {log.metadata.continues}, and a replay needs a run from its first tick on; give "
                "the first part"
            )
        first = next((entry.record for entry in log.records(("/command",))), None)
        if isinstance(first, Command) and first.source not in _SOURCES:
            raise InputError(
                f"{path}: its commands are from {first.source!r}, not from a planner or a hand; {_REPLAYED}"
            )
        has_plans = any(True for part in parts for _ in part.records(("/plan",)))
        setup = _planned_as_recorded(setup_of_log(log, _REPLAYED), path, log.metadata, has_plans)
        # What was driven by hand needs no planner, whose compilation would take longer than the replay.
        planned = any(
            isinstance(entry.record, Command) and entry.record.source in _PLANNED
            for part in parts
            for entry in part.records(("/command",))
        )
        planner = create_planner(setup.config, setup.model) if planned else NoPlanner()
        pipeline = create_pipeline(setup.config, setup.model, planner)
        area = _ReplayedArea(pipeline, setup.config)
        ticks = values = 0
        difference: Difference | None = None
        used: list[Log] = []
        for tick, entries in groupby(_entries(parts, used), key=lambda entry: entry.tick):
            recorded = list(entries)
            for task in (entry.record for entry in recorded if isinstance(entry.record, Task)):
                changed = task_of(task, setup.config.task)
                line_m = changed.course().outline_m()
                pipeline.set_task(changed.planned(setup.config.control.mode), line_m)
            for change in (entry.record for entry in recorded if isinstance(entry.record, BeliefChange)):
                apply_geometry(pipeline, setup.model, geometry_of(change))
            area.apply(recorded)
            outcome = _replay_tick(pipeline, recorded, area.begin(recorded[0].now_ns))
            ticks += 1
            compared, difference = _compare(tick, recorded[0].now_ns, recorded, outcome, tolerance)
            values += compared
            if difference is not None:
                break
        if not ticks:
            damage = f" that can be read: {log.damage[0]}" if log.damage else ""
            raise InputError(f"{path}: holds no ticks{damage}; give the log of a `disco-hw run`")
        ending = used[-1].ending
        return ReplayReport(
            ticks,
            values,
            sum(part.summary().missing_ticks for part in used),
            log.metadata.version,
            difference,
            tolerance,
            tuple(part.path.name for part in used),
            difference is None and ending is not None and ending.continued,
        )


def _entries(parts: Sequence[Log], used: list[Log]) -> Iterator[Entry]:
    """Yield the records of the parts of a log as those of one run, as far as no part is missing; fill in `used`.

    A part begins with the states in force, which the part before holds already, and with ticks that were not confirmed.
    """
    last_tick = 0
    states: dict[type, int] = {}
    for part in parts:
        if used and (part.metadata.continues_sequence or 0) > last_tick:
            return
        used.append(part)
        done, known = last_tick, dict(states)
        for entry in part.records(_TOPICS):
            kind, t_ns = type(entry.record), entry.record.t_ns
            if entry.tick <= done or (kind in known and t_ns <= known[kind]):
                continue
            last_tick = entry.tick
            if kind in STATES:
                states[kind] = t_ns
            yield entry


def _planned_as_recorded(setup: Setup, path: Path, recorded: Metadata, has_plans: bool) -> Setup:
    """Return the setup with the mode that plans as the log's planner version did; raises InputError if none does."""
    planner = recorded.planner or 1
    if planner > PLANNER_VERSION:
        raise InputError(
            f"{path}: its plans are of planner version {planner}, and this disco-hw replays versions up to "
            f"{PLANNER_VERSION}; replay it with disco-hw {recorded.version or 'of the version that recorded it'}"
        )
    control = setup.config.control
    if control.disturbance and planner <= DISTURBANCE_UNTIL_VERSION:
        raise InputError(
            f"{path}: it was driven with control.disturbance, which is followed no more; replay it with "
            f"disco-hw {recorded.version or 'of the version that recorded it'}"
        )
    if planner >= SAME_SINCE_VERSION or control.mode != "default" or not has_plans:
        return setup
    if planner > 1:
        raise InputError(
            f"{path}: its plans are of planner version {planner}, which refined them otherwise; replay it with "
            f"disco-hw {recorded.version or 'of the version that recorded it'}"
        )
    sampled = msgspec.structs.replace(control, mode="sampled")
    return replace(setup, config=msgspec.structs.replace(setup.config, control=sampled))


class _ReplayedArea:
    """Fence, obstacles and override as they were in each tick of a log."""

    def __init__(self, pipeline: Pipeline, config: RobotConfig) -> None:
        self._guard = pipeline.guard
        self._footprint = config.robot.footprint
        self._fastest_rad_s2 = config.robot.max_wheel_acceleration_rad_s2
        self._obstacles = Obstacles()
        self._overridden = False

    def apply(self, recorded: Sequence[Entry]) -> None:
        """Apply what a tick's records say of them."""
        self._overridden = False
        for entry in recorded:
            match entry.record:
                case FenceChange() as changed:
                    fence = fence_of_record(changed)
                    self._guard.set_boundaries(Boundaries(self._footprint, fence), fence.margin_m)
                case Obstacle(removed=True) as gone:
                    self._obstacles.remove(gone.name)
                case Obstacle() as reported:
                    self._obstacles.report(reported.t_ns, report_of_record(reported))
                case Controller() as answers:
                    limits = {**answers.told, **answers.fixed, **answers.declared}
                    stops = limits.get("stop_deceleration_rad_s2", self._fastest_rad_s2)
                    self._guard.set_deceleration(min(stops, self._fastest_rad_s2))
                case GuardVerdict() as found:
                    self._overridden = found.overridden

    def begin(self, now_ns: int) -> bool:
        """Bring the guard up to a tick; returns whether the fence is overridden in it."""
        self._obstacles.step(now_ns)
        self._guard.set_obstacles(self._obstacles.circles(now_ns), self._obstacles.lost)
        return self._overridden


def _replay_tick(pipeline: Pipeline, recorded: Sequence[Entry], fence_overridden: bool) -> list[Record]:
    found = [entry.record for entry in recorded]
    readings = Readings(
        wheels=tuple(record for record in found if isinstance(record, WheelSample)),
        poses=tuple(record for record in found if isinstance(record, PoseSample)),
    )
    command = next((record for record in found if isinstance(record, Command)), None)
    motion = Off() if command is None else _motion(command)
    screened = pipeline.screen(readings)
    tick = pipeline.step(recorded[0].now_ns, screened, motion, fence_overridden=fence_overridden)
    return list(records_of_tick.tick(tick, None, 0.0))


def _motion(command: Command) -> Motion:
    match Source(command.source):
        case Source.OFF:
            return Off()
        case Source.HOLD:
            return Standstill()
        case Source.SILENT:
            return Silent()
        case Source.MANUAL:
            return Manual(command.requested_left_rad_s, command.requested_right_rad_s)
        case Source.PLAN | Source.TAIL | Source.FALLBACK | Source.RAMP:
            return FollowTask()


def _compare(
    tick: int, now_ns: int, recorded: Sequence[Entry], replayed: Sequence[Record], tolerance: float
) -> tuple[int, Difference | None]:
    """Compare the outputs of one tick; returns how many values were equal, and the first that is not."""
    before = [entry.record for entry in recorded if isinstance(entry.record, _COMPARED)]
    names = [type(record).__name__ for record in before], [type(record).__name__ for record in replayed]
    if names[0] != names[1]:
        return 0, Difference(tick, now_ns, "records", " ".join(names[0]), " ".join(names[1]))
    equal = 0
    for old, new in zip(before, replayed, strict=True):
        for field, old_value, new_value in _values(old, new):
            if not (_near(old_value, new_value, tolerance) if tolerance else _bits(old_value) == _bits(new_value)):
                return equal, Difference(tick, now_ns, field, repr(old_value), repr(new_value))
            equal += 1
    return equal, None


def _values(old: Record, new: Record) -> Iterator[tuple[str, Any, Any]]:
    for name in old.__struct_fields__ if isinstance(old, msgspec.Struct) else ():
        if (type(old), name) not in _NOT_REPLAYED:
            yield f"{type(old).__name__}.{name}", getattr(old, name), getattr(new, name)


def _near(old: Any, new: Any, tolerance: float) -> bool:
    """Whether two values, or those of two tuples, are equal but for rounding."""
    if isinstance(old, float) and isinstance(new, float):
        both_nan = math.isnan(old) and math.isnan(new)
        return both_nan or math.isclose(old, new, rel_tol=tolerance, abs_tol=tolerance)
    if isinstance(old, tuple) and isinstance(new, tuple):
        return len(old) == len(new) and all(_near(a, b, tolerance) for a, b in zip(old, new, strict=True))
    return bool(old == new)


def _bits(value: Any) -> Any:
    """Return a key that is equal exactly if the values are: -0.0 differs from 0.0, NaN equals NaN."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else _FLOAT.pack(value)
    if isinstance(value, tuple):
        return tuple(map(_bits, value))
    return value
