"""Interface of a task: the section of robot.toml, its line on the ground, its progress, its cost.

Every module of this package with a `TASK` is a kind, and its name is the kind's (docs/add-a-task.md says what such a
file holds). Only the module of the kind that is asked for is loaded, so that reading robot.toml stays quick.

A cost is written in plain functions of numbers, which the planner compiles.
The terms of a task are a named tuple of float32 numbers and arrays with the functions of its cost. `stage` and
`terminal` are the c and phi of the paper's Algorithm 1:

    stage(self, memory, step, x_old, y_old, x, y, cos_yaw, sin_yaw, forward, found) -> cost, memory
    terminal(self, memory, x, y, cos_yaw, sin_yaw, found) -> cost

`step` is the index of the step; positions are relative to the task's origin (m), before and after it; `forward` is the
longitudinal speed over it (m/s); `memory` is a number that a rollout carries along. No compiler makes vectors of
looking numbers up in a table at a place of every sample's own. So terms with a `table`, rows of four float32, flat,
have two functions more, and the look-up happens between `follow` and `stage`:

    follow(self, memory, x, y, forward, found) -> memory, kept      where a sample is after the step
    row_of(self, memory) -> int32                                   the row of the table for a memory, within it

Terms of a task with a line may say it, for the planner to follow it by a steering law (control/kernel/guide.py):

    place_of(self, place, x, y) -> place                            beside a position, from the one before
    line_at(self, place, ahead_m) -> x, y, head_x, head_y, along, speed
    way_ahead_m(self, time_s) -> m                                  not compiled

the point so far on, the heading in which a robot stays on the line there, the cosine by which that is off the line,
and the speed wanted; a place begins as a rollout's memory does. And how far a robot on the line goes in so long: the
law has one whose plan stands.

Terms of a task that says where to be at each step's end, `x` and `y` (T,), may say how a robot faces that stays there,
for its plans to be refined (control/refinement.py):

    headings(self, x_icr_m) -> rad (T + 1,), or None at rest        not compiled

`found` holds what `follow` kept and the four numbers of that row; zeros without a table. Constants are made by
`single`: any other number would pull the arithmetic up to double precision. Compiled, the functions below use estimates
refined by a Newton step; as written here they are their oracle.
"""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from disco_hw.errors import FieldFault
from drivers.samples import FARTHEST_M

Array = NDArray[np.float64]
Point = tuple[float, float]
# Chosen: slower could hardly be told from a robot that stands.
SLOWEST_M_S = 0.01
CENTER_M = (-1000.0, 1000.0)
"""The slowest speed, and the least and largest coordinate of a centre, that a person may change a task to."""
Positive = Annotated[float, Meta(gt=0.0)]


class Chassis(Protocol):
    """Properties of the robot that a task needs; [robot] of robot.toml has them."""

    @property
    def wheel_radius_m(self) -> float:
        """Nominal radius of the wheels."""

    @property
    def axial_distance_m(self) -> float:
        """Nominal distance between left and right wheels."""

    @property
    def x_icr_m(self) -> float:
        """Distance (m) from the tracked point forward to the point about which the robot turns."""

    @property
    def max_wheel_speed_rad_s(self) -> float:
        """The fastest that a wheel may turn."""


class Editable(NamedTuple):
    """A field that a person may change while the robot is disarmed: least and largest value, and what it is called."""

    low: float
    high: float
    label: str


def beyond_poses(figure: str, size: str, center_m: Point, reach_m: float) -> FieldFault | None:
    """Return the fault of a figure about a centre, of which `size` is the field, that goes where no pose is known."""
    for field, coordinate_m in zip(("center_x_m", "center_y_m"), center_m, strict=True):
        farthest_m = abs(coordinate_m) + reach_m
        if farthest_m > FARTHEST_M:
            return FieldFault(
                field,
                f"with this {size} the {figure} reaches {farthest_m:g} m from the origin; poses reach {FARTHEST_M:g} m "
                "at most",
                f"write a {figure} in the frame of the poses",
            )
    return None


def straight_fastest_m_s(robot: Chassis) -> float:
    """Speed straight ahead at which the wheels of the nominal robot are at their limit."""
    return robot.max_wheel_speed_rad_s * robot.wheel_radius_m


def too_fast(
    speed_m_s: float, fastest_m_s: float, robot: Chassis, wheels: str, where: str = "", instead: str = ""
) -> FieldFault | None:
    """Return the fault of a speed that these `wheels` of the nominal robot cannot do; None if they can.

    `where`: what follows the speed, such as " on a radius of 1 m"; `instead`: a gentler bend, such as ", or ...", which
    is offered for a speed that the wheels can do straight ahead.
    """
    if speed_m_s <= fastest_m_s:
        return None
    return FieldFault(
        "speed_m_s",
        f"{speed_m_s:g} m/s{where} needs more than {robot.max_wheel_speed_rad_s:g} rad/s of {wheels}",
        f"write at most {math.floor(fastest_m_s * 1000.0) / 1000.0:g} m/s"
        f"{instead if speed_m_s < straight_fastest_m_s(robot) else ''}",
    )


def least_size_m(per_x_icr: float, robot: Chassis) -> float:
    """Return so many times the robot's x_icr, in whole millimetres: the smallest that a figure may be for it."""
    return math.ceil(1000.0 * per_x_icr * abs(robot.x_icr_m)) / 1000.0


def too_small(field: str, size_m: float, least_m: float, robot: Chassis) -> FieldFault | None:
    """Return the fault of a figure's size, in `field`, that the robot's tracked point cannot follow; None if it can."""
    if size_m >= least_m:
        return None
    return FieldFault(
        field,
        f"{size_m:g} m is too small: the robot turns about a point {abs(robot.x_icr_m):.3g} m from the tracked one",
        f"write at least {least_m:g}",
    )


class Course(Protocol):
    """The line that a task follows: pure geometry for panels and pictures."""

    @property
    def noun(self) -> str:
        """Name of the course for panels and pictures."""

    @property
    def middle_m(self) -> Point:
        """The middle of the ground that it takes."""

    @property
    def reach_m(self) -> float:
        """Farthest distance (m) of the course from its middle along x or y."""

    @property
    def length_m(self) -> float:
        """Length of the line, once round if it is closed."""

    @property
    def start(self) -> tuple[float, float, float]:
        """Start of the course and the heading there: x, y (m), yaw (rad)."""

    def outline_m(self) -> Array:
        """Return the line as points (N, 2)."""

    def off_m(self, places_m: Array) -> Array:
        """Distance (N,) of positions (N, 2), positive to the right of the way: outside of a circle."""


class Progress(Protocol):
    """Protocol of a task's progress, which follows the robot while the task runs."""

    @property
    def laps(self) -> float:
        """Laps of the present run, or of the last one while paused; of a line with an end the part behind, 0 to 1."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to drive."""

    def describe(self) -> tuple[str, str]:
        """Return the name of what is counted, and how much of it there is, as text."""

    def add(self, now_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take in the pose of one tick; the first one after a pause begins again."""

    def pause(self) -> None:
        """Note that the task does not run in this tick."""


class Prepared(NamedTuple):
    """Inputs of one plan from its task.

    `terms`: the compiled cost with its numbers in float32 (see above). `origin_m`: world position that
    rollouts are relative to, so that single precision is fine anywhere; `begin`: the memory that they start with.
    `memory`: to hand back at the next plan.
    """

    terms: tuple[Any, ...]  # Any: every kind has a named tuple of its own, which the compiler looks into.
    origin_m: tuple[float, float]
    begin: float = 0.0
    memory: float = 0.0


class PlannedTask(Protocol):
    """A task as the planner takes it; immutable. The type of its terms decides which compiled cost is used."""

    def prepare(
        self, time_s: float, x_m: float, y_m: float, yaw_rad: float, memory: float | None, step_s: float, horizon: int,
        x_icr_m: float,
    ) -> Prepared:  # fmt: skip
        """Return the task's inputs for a plan that starts here.

        `time_s` since the planner's start, the pose in the world, the memory that the last plan handed back (None at
        the first), the steps that will be planned, and how far ahead of the tracked point the robot turns.
        """


class RobotTask(Protocol):
    """A kind of task: a frozen msgspec struct whose fields are those of [task] in robot.toml."""

    __struct_fields__: ClassVar[tuple[str, ...]]
    implied_by: ClassVar[str | None]
    """Field of [task] that says this kind where `kind` is not given; "" for the kind without one, else None."""
    read_fields: ClassVar[tuple[str, ...]]
    """Fields that are read from the file that `path` names, and are none of robot.toml's; () without a file."""

    @property
    def speed_m_s(self) -> float:
        """The fastest that the task asks for."""

    @property
    def reference_speed_m_s(self) -> float:
        """The one speed that is asked for throughout; NaN if there is none."""

    @property
    def file(self) -> str | None:
        """The file that [task] names, relative to robot.toml."""

    def with_file(self, file: Path, robot: Chassis, x_icr_m: float | None) -> Self:
        """Return the task with its file's contents; what a robot with this x_icr cannot drive is refused.

        `x_icr_m` None is for what was driven before, which is not judged.

        Raises InputError naming file, line and remedy.
        """

    def fault(self) -> FieldFault | None:
        """Return what is wrong with the fields of [task] taken together, or None."""

    def fastest_m_s(self, robot: Chassis) -> float:
        """Speed at which a wheel of the nominal robot is at its limit on this task."""

    def beyond_robot(self, robot: Chassis) -> FieldFault | None:
        """Return what of the task the nominal robot cannot do, with the x_icr of its model; None if it can do it."""

    def editable(self, robot: Chassis) -> Mapping[str, Editable]:
        """Return the fields that a person may change; the largest speed is that on the present line."""

    def editing_note(self, robot: Chassis) -> str:
        """Return the text that the page shows below the editable fields, which also says why there are none."""

    def describe(self) -> str:
        """Return the task as text."""

    def course(self) -> Course:
        """Return the task's line on the ground, the same one for every speed."""

    def progress(self) -> Progress:
        """Return the progress of the task as it begins."""

    def planned(self, mode: str) -> PlannedTask:
        """Return the task with the cost of the control mode, "default", "sampled" or "paper"."""


Found = tuple[float, float, float, float, float]


def norm(x: float, y: float) -> float:
    """Length of a vector."""
    return math.hypot(x, y)


def norm_and_inverse(x: float, y: float) -> tuple[float, float]:
    """Length of a vector and its reciprocal; of zero, 1e-15 and 1e15."""
    length = max(math.hypot(x, y), 1e-15)
    return length, 1.0 / length


def norm_of_three(x: float, y: float, z: float) -> float:
    """Length of a vector of three."""
    return math.hypot(x, y, z)


def single(value: float) -> float:
    """Return a number in single precision, for the terms of a cost and its constants."""
    return cast(float, np.float32(value))


def constant(value: float, like: float) -> float:
    """Return a number in the precision of another one."""
    return value


Helper = TypeVar("Helper", bound=Callable[..., object])
HELPERS: list[Callable[..., object]] = []
"""Functions that costs call, for the planner to compile."""


def helper(function: Helper) -> Helper:
    """Let the functions of a cost call this one."""
    HELPERS.append(function)
    return function


class UnknownKind(ValueError):  # noqa: N818
    """There is no such kind of task; the message names those that there are."""


class ReadField(ValueError):  # noqa: N818
    """A field that is read from the task's file stands in [task]; the message says so."""


def _modules() -> list[str]:
    return [found.name for found in pkgutil.iter_modules(__path__) if not found.ispkg]


def _task_in(module: str) -> type[RobotTask] | None:
    found: type[RobotTask] | None = getattr(import_module(f"{__name__}.{module}"), "TASK", None)
    return found


def kinds() -> tuple[str, ...]:
    """Return all kinds of tasks, in alphabetical order."""
    return tuple(sorted(name for name in _modules() if _task_in(name) is not None))


def task_class(kind: str) -> type[RobotTask]:
    """Return the struct that holds [task] of this kind; raises UnknownKind."""
    found = _task_in(kind) if kind in _modules() else None
    if found is None:
        raise UnknownKind(f"{kind!r} is not a kind of task; write one of {', '.join(kinds())}")
    return found


def kind_of(task: RobotTask) -> str:
    """Return the kind of a task, as robot.toml names it."""
    return type(task).__module__.rpartition(".")[2]


def default_task() -> RobotTask:
    """Return the task of a robot.toml without [task]."""
    return task_from({})


def kind_in(section: Mapping[str, Any]) -> str:
    """Return the kind of task that [task] of robot.toml says; raises UnknownKind for what is no text.

    Without `kind` it is the kind that claims one of the section's fields, else the kind that claims none in particular.
    """
    kind = section.get("kind")
    if kind is None:
        kind = _implied_kind(section)
    if not isinstance(kind, str):
        raise UnknownKind(f"{kind!r} is not a kind of task; write one of {', '.join(kinds())}")
    return kind


def task_from(section: Mapping[str, Any]) -> RobotTask:
    """Return the task that [task] of robot.toml says, validated; the files that it names are not read.

    Raises UnknownKind, ReadField, and msgspec.ValidationError for fields that the kind does not have or values that
    they cannot take.
    """
    task_type = task_class(kind_in(section))
    fields = {name: value for name, value in section.items() if name != "kind"}
    for name in task_type.read_fields:
        if name in fields:
            raise ReadField(f"{name}: no such field; write way-points in a CSV and name it in path")
    return msgspec.convert(fields, task_type)


def _implied_kind(fields: Mapping[str, Any]) -> str:
    claims = {kind: task_class(kind).implied_by for kind in kinds()}
    claimed = [kind for kind, field in claims.items() if field is not None and field in fields]
    return claimed[0] if claimed else next(kind for kind, field in claims.items() if field == "")
