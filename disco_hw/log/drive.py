"""A drive as arrays: commands, wheels, poses and gyro over time, whatever file it came from.

Poses may come as chains of transforms: what /tf and /tf_static say between frames -> planar poses in the map.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Chosen: above both limits below, so that nothing is held or joined from one log to the next.
_BETWEEN_LOGS_S = 10.0
LONGEST_SILENCE_NS = 500_000_000
"""A longer pause of the wheels begins a new segment."""
LONGEST_COMMAND_S = 0.5
"""How long a command of a log that does not say is in force at most."""
_CSV_NAMES = {
    "left_rad_s": "cmd_left_rad_s",
    "right_rad_s": "cmd_right_rad_s",
    "left_speed_rad_s": "enc_left_rad_s",
    "right_speed_rad_s": "enc_right_rad_s",
    "left_angle_rad": "enc_left_rad",
    "right_angle_rad": "enc_right_rad",
    "x_m": "pose_x_m",
    "y_m": "pose_y_m",
    "yaw_rad": "pose_yaw_rad",
    "yaw_rate_rad_s": "imu_wz_rad_s",
}
_PARTS = ("commands", "wheels", "poses", "gyro")


def _no_values() -> Array:
    return np.empty(0)


def _no_segments() -> Index:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Commands:
    """Wheel-speed commands, each in force from its time on until the next, all (N,); NaN: no command known or given."""

    t_s: Array = field(default_factory=_no_values)
    left_rad_s: Array = field(default_factory=_no_values)
    right_rad_s: Array = field(default_factory=_no_values)
    segment: Index = field(default_factory=_no_segments)


@dataclass(frozen=True, slots=True)
class Wheels:
    """Wheel angles (cumulative, not wrapped) and speeds, all (N,), positive forward.

    What was not measured is derived from the other: angles by the trapezoidal rule within a segment, speeds by backward
    differences.
    """

    t_s: Array = field(default_factory=_no_values)
    left_angle_rad: Array = field(default_factory=_no_values)
    right_angle_rad: Array = field(default_factory=_no_values)
    left_speed_rad_s: Array = field(default_factory=_no_values)
    right_speed_rad_s: Array = field(default_factory=_no_values)
    segment: Index = field(default_factory=_no_segments)
    angle_measured: bool = False
    speed_measured: bool = False


@dataclass(frozen=True, slots=True)
class Poses:
    """Measured poses in the world frame, all (N,); yaw in (-pi, pi]."""

    t_s: Array = field(default_factory=_no_values)
    x_m: Array = field(default_factory=_no_values)
    y_m: Array = field(default_factory=_no_values)
    yaw_rad: Array = field(default_factory=_no_values)
    segment: Index = field(default_factory=_no_segments)


@dataclass(frozen=True, slots=True)
class Gyro:
    """Yaw rate, counter-clockwise positive, all (N,)."""

    t_s: Array = field(default_factory=_no_values)
    yaw_rate_rad_s: Array = field(default_factory=_no_values)
    segment: Index = field(default_factory=_no_segments)


Part = Commands | Wheels | Poses | Gyro
PartT = TypeVar("PartT", Commands, Wheels, Poses, Gyro)


def after_silences(wheel_ns: NDArray[Any]) -> NDArray[Any]:
    """Return the times (ns) of wheel samples after a silence: what was driven meanwhile is not known."""
    return wheel_ns[1:][np.diff(wheel_ns) > LONGEST_SILENCE_NS]


@dataclass(frozen=True, slots=True)
class DriveLog:
    """One or several drives; what was not measured has arrays of length 0.

    Times start near 0 and increase within each array. Nothing may be predicted across a change of `segment`, which has
    the same numbers in all arrays. `notes` say what was ignored or filled in, for a person. `begins_s`: when each of
    several drives begins. `began_ns`: time 0 by the clock of the source, 0 where it is not known.
    """

    sources: tuple[str, ...]
    commands: Commands
    wheels: Wheels
    poses: Poses
    gyro: Gyro = field(default_factory=Gyro)
    notes: tuple[str, ...] = ()
    begins_s: tuple[float, ...] = (0.0,)
    began_ns: int = 0

    @property
    def end_s(self) -> float:
        """The last time in any array; 0 for an empty log."""
        return max((float(part.t_s[-1]) for part in self._parts if part.t_s.size), default=0.0)

    @property
    def segments(self) -> int:
        """Return the number of segments: one more than the highest index in any array."""
        return 1 + max((int(part.segment.max()) for part in self._parts if part.t_s.size), default=-1)

    @property
    def _parts(self) -> tuple[Part, ...]:
        return self.commands, self.wheels, self.poses, self.gyro

    def to_pandas(self) -> Any:
        """Return the drive as one `pandas.DataFrame`, a row a sample in order of time, with our CSV's columns.

        `t_s`, `segment`, `cmd_left_rad_s`, ..., `imu_wz_rad_s`; what a row does not hold is NaN. Raises ImportError
        without pandas, which nothing else needs.
        """
        import pandas  # noqa: PLC0415

        tables = []
        for columns in map(_columns, self._parts):
            named = {csv_name: columns[name] for name, csv_name in _CSV_NAMES.items() if name in columns}
            tables.append({"t_s": columns["t_s"], "segment": columns["segment"], **named})
        frames = [pandas.DataFrame(table) for table in tables if table["t_s"].size]
        if not frames:
            return pandas.DataFrame({name: np.empty(0) for table in tables for name in table})
        joined = pandas.concat(frames, ignore_index=True)
        return joined.sort_values("t_s", kind="stable", ignore_index=True)


def _columns(part: Part) -> dict[str, NDArray[Any]]:
    """Return the arrays of a part by name."""
    return {name: getattr(part, name) for name in part.__slots__ if not name.endswith("measured")}


def chosen(part: PartT, which: NDArray[np.bool_]) -> PartT:
    """Return the samples of a part that are marked (N,)."""
    columns: dict[str, Any] = {name: column[which] for name, column in _columns(part).items()}
    return replace(part, **columns)


def rows(part: Part) -> Iterator[tuple[Any, ...]]:
    """Yield the samples of a part as tuples of plain numbers, in the order of its fields: time first, segment last."""
    return zip(*(column.tolist() for column in _columns(part).values()), strict=True)


Samples = tuple[NDArray[Any], Array]
"""Times (N,), ns, and values (N, k)."""


def drive_of(
    source: str,
    commands: Samples,
    wheels: Samples,
    poses: Samples,
    breaks_ns: NDArray[Any] | None = None,
    measured: tuple[bool, bool] = (True, True),
    notes: Sequence[str] = (),
) -> DriveLog:
    """Return a drive of left and right commands (N, 2), wheel angles before speeds (N, 4), and x, y, yaw (N, 3).

    Time 0 is the first sample's; there has to be one. New segments begin at `breaks_ns`, by default where the wheels
    were silent. Whichever of wheel angles and speeds is not `measured` is derived from the other.
    """
    began_ns = min(t_ns[0] for t_ns, _ in (commands, wheels, poses) if t_ns.size)
    breaks = after_silences(wheels[0]) if breaks_ns is None else breaks_ns

    def when(t_ns: NDArray[Any]) -> tuple[Array, Index]:
        seconds = (t_ns - began_ns).astype(np.float64) * 1e-9
        return seconds, np.searchsorted(breaks, t_ns, side="right").astype(np.int64)

    (command_s, command_segment), (wheel_s, segment), (pose_s, pose_segment) = map(
        when, (commands[0], wheels[0], poses[0])
    )
    left, right, left_speed, right_speed = wheels[1].T
    has_angle, has_speed = (each and bool(wheel_s.size) for each in measured)
    if not has_angle:
        left, right = (integrate_angle(wheel_s, speed, segment) for speed in (left_speed, right_speed))
    if not has_speed:
        left_speed, right_speed = (differentiate_angle(wheel_s, angle, segment) for angle in (left, right))
    return DriveLog(
        sources=(source,),
        commands=Commands(command_s, commands[1][:, 0], commands[1][:, 1], command_segment),
        wheels=Wheels(wheel_s, left, right, left_speed, right_speed, segment, has_angle, has_speed),
        poses=Poses(pose_s, poses[1][:, 0], poses[1][:, 1], poses[1][:, 2], pose_segment),
        notes=tuple(notes),
        began_ns=int(began_ns),
    )


def with_unknown(t: NDArray[Any], speeds: Array, unknown: NDArray[Any]) -> tuple[NDArray[Any], Array]:
    """Return commands (N,), (N, 2) with a row of NaN at each time from which on none is known, in order of time."""
    times = np.concatenate([t, unknown])
    rows = np.concatenate([speeds, np.full((unknown.size, 2), np.nan)])
    order = np.argsort(times, kind="stable")
    return times[order], rows[order]


def concatenate(drives: Sequence[DriveLog]) -> DriveLog:
    """Drives one after the other, later ones shifted in time, their segments numbered on; at least one is needed."""
    shifts_s = np.cumsum([0.0, *(drive.end_s + _BETWEEN_LOGS_S for drive in drives[:-1])])
    firsts = np.cumsum([0, *(drive.segments for drive in drives[:-1])])

    def joined(name: str) -> dict[str, NDArray[Any]]:
        parts = [_columns(getattr(drive, name)) for drive in drives]
        columns = {field: np.concatenate([part[field] for part in parts]) for field in parts[0]}
        sizes = [part["t_s"].size for part in parts]
        shifted = {"t_s": columns["t_s"] + np.repeat(shifts_s, sizes)}
        return columns | shifted | {"segment": columns["segment"] + np.repeat(firsts, sizes)}

    # A drive without wheels says nothing about how wheels were measured, unless there is no other.
    rolling = [drive.wheels for drive in drives if drive.wheels.t_s.size] or [drive.wheels for drive in drives]
    return DriveLog(
        sources=tuple(source for drive in drives for source in drive.sources),
        commands=Commands(**joined("commands")),
        wheels=Wheels(
            **joined("wheels"),
            angle_measured=all(wheels.angle_measured for wheels in rolling),
            speed_measured=all(wheels.speed_measured for wheels in rolling),
        ),
        poses=Poses(**joined("poses")),
        gyro=Gyro(**joined("gyro")),
        notes=tuple(note for drive in drives for note in drive.notes),
        begins_s=tuple(
            shift_s + begin
            for drive, shift_s in zip(drives, shifts_s.tolist(), strict=True)
            for begin in drive.begins_s
        ),
    )


def separate(drive: DriveLog) -> list[tuple[str, DriveLog]]:
    """Return the logs that were put one after the other, each with its source's name and its own times."""
    if len(drive.begins_s) != len(drive.sources):
        return [(", ".join(drive.sources), drive)]
    ends_s = (*drive.begins_s[1:], np.inf)
    return [
        (source, _between(drive, source, begin_s, end_s))
        for source, begin_s, end_s in zip(drive.sources, drive.begins_s, ends_s, strict=True)
    ]


def _between(drive: DriveLog, source: str, begin_s: float, end_s: float) -> DriveLog:
    if len(drive.begins_s) == 1:
        return drive
    parts: dict[str, Any] = {}
    for name in _PARTS:
        part = getattr(drive, name)
        inside = chosen(part, (part.t_s >= begin_s) & (part.t_s < end_s))
        parts[name] = replace(inside, t_s=inside.t_s - begin_s)
    return replace(drive, sources=(source,), begins_s=(0.0,), **parts)


def integrate_angle(t_s: Array, speed_rad_s: Array, segment: Index) -> Array:
    """Angle from speed by the trapezoidal rule, (N,), from 0; it stands still across a change of segment."""
    steps = 0.5 * (speed_rad_s[1:] + speed_rad_s[:-1]) * np.diff(t_s)
    steps[np.diff(segment) != 0] = 0.0
    return np.concatenate(([0.0], np.cumsum(steps))) if t_s.size else np.empty(0)


def differentiate_angle(t_s: Array, angle_rad: Array, segment: Index) -> Array:
    """Speed from angle by backward differences, (N,); the first of each segment is 0."""
    if not t_s.size:
        return np.empty(0)
    speed = np.diff(angle_rad) / np.diff(t_s)
    speed[np.diff(segment) != 0] = 0.0
    return np.concatenate(([0.0], speed))


MAP_FRAMES = ("map", "world", "mocap", "optitrack", "vicon")
BASE_FRAMES = ("base_link", "base_footprint")
ODOM_FRAMES = ("odom", "odom_combined")

Edge = tuple[str, str]
"""Names of parent and child."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Transforms of one edge in order of time: (N,), ns, and position and quaternion x, y, z, w, (N, 7).

    A static one holds for all times and has one row.
    """

    t_ns: Index
    values: Array
    static: bool


def chain(edges: Iterable[Edge], map_frame: str, base_frame: str) -> tuple[Edge, ...] | None:
    """Return the edges from map to base, in this order, or None.

    Of several parents of a frame, which tf does not allow, the first counts that leads there.
    """
    parents: dict[str, list[str]] = {}
    for parent, child in edges:
        parents.setdefault(child, []).append(parent)
    child_of: dict[str, str] = {}
    frames = [base_frame]
    for frame in frames:
        new = [one for one in parents.get(frame, ()) if one not in child_of and one != base_frame]
        child_of |= dict.fromkeys(new, frame)
        frames += new
    if map_frame not in child_of:
        return None
    found: list[Edge] = []
    frame = map_frame
    while frame != base_frame:
        found.append((frame, child_of[frame]))
        frame = child_of[frame]
    return tuple(found)


def poses(motions: list[Motion]) -> tuple[Index, Array]:
    """Return times (M,), ns, and x, y, yaw (M, 3) of the chain's end in its first frame, the edges from map to base.

    A pose is taken where the first moving edge, the localisation's correction, has changed: between two corrections the
    chain only repeats the wheel odometry. The edges after it are interpolated; a pose that they do not reach is left
    out.
    """
    moving = [at for at, one in enumerate(motions) if not one.static]
    if not moving:
        return np.empty(0, dtype=np.int64), np.empty((0, 3))
    leading = motions[moving[0]]
    usable = np.ones(leading.t_ns.size, dtype=bool)
    if len(moving) > 1:
        usable[1:] = np.any(np.diff(leading.values, axis=0) != 0.0, axis=1)
        for at in moving[1:]:
            usable &= (leading.t_ns >= motions[at].t_ns[0]) & (leading.t_ns <= motions[at].t_ns[-1])
    t_ns = leading.t_ns[usable]
    rotation, position = np.tile(np.eye(3), (t_ns.size, 1, 1)), np.zeros((t_ns.size, 3))
    for at, one in enumerate(motions):
        if one.static:
            values = np.repeat(one.values[-1:], t_ns.size, axis=0)
        else:
            values = one.values[usable] if at == moving[0] else _interpolated(one, t_ns)
        position = position + np.einsum("nij,nj->ni", rotation, values[:, :3])
        rotation = rotation @ rotations(values[:, 3:])
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    return t_ns, np.column_stack([position[:, :2], yaw])


def _interpolated(one: Motion, t_ns: Index) -> Array:
    zero = one.t_ns[0]
    since, at = (one.t_ns - zero).astype(np.float64), (t_ns - zero).astype(np.float64)
    values = one.values.copy()
    # q and -q are one rotation; neighbours are put on one side.
    turned_over = np.einsum("ni,ni->n", values[1:, 3:], values[:-1, 3:]) < 0.0
    values[1:, 3:] *= np.cumprod(np.where(turned_over, -1.0, 1.0))[:, np.newaxis]
    return np.column_stack([np.interp(at, since, column) for column in values.T])


def rotations(quaternions: Array) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) of any length but 0."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
