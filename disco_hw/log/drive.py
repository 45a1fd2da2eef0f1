"""A drive as arrays: commands, wheels, poses and gyro over time, whatever file it came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_BETWEEN_LOGS_S = 10.0
_WHEEL_COLUMNS = {
    "enc_left_rad_s": "left_speed_rad_s",
    "enc_right_rad_s": "right_speed_rad_s",
    "enc_left_rad": "left_angle_rad",
    "enc_right_rad": "right_angle_rad",
}


@dataclass(frozen=True, slots=True)
class Commands:
    """Wheel-speed commands, each in force from its time on until the next, all (N,); NaN: no command known or given."""

    t_s: Array
    left_rad_s: Array
    right_rad_s: Array
    segment: Index


@dataclass(frozen=True, slots=True)
class Wheels:
    """Wheel angles (cumulative, not wrapped) and speeds, all (N,), positive forward.

    What was not measured is derived from the other: angles by the trapezoidal rule within a segment, speeds by backward
    differences.
    """

    t_s: Array
    left_angle_rad: Array
    right_angle_rad: Array
    left_speed_rad_s: Array
    right_speed_rad_s: Array
    segment: Index
    angle_measured: bool
    speed_measured: bool


@dataclass(frozen=True, slots=True)
class Poses:
    """Measured poses in the world frame, all (N,); yaw in (-pi, pi]."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    segment: Index


@dataclass(frozen=True, slots=True)
class Gyro:
    """Yaw rate, counter-clockwise positive, all (N,)."""

    t_s: Array
    yaw_rate_rad_s: Array
    segment: Index


@dataclass(frozen=True, slots=True)
class DriveLog:
    """One or several drives; what was not measured has arrays of length 0.

    Times start near 0 and increase within each array. Nothing may be predicted across a change of `segment`, which has
    the same numbers in all arrays. `notes` say what was ignored or filled in, for a person. `begins_s`: when each of
    several drives begins.
    """

    sources: tuple[str, ...]
    commands: Commands
    wheels: Wheels
    poses: Poses
    gyro: Gyro
    notes: tuple[str, ...] = ()
    begins_s: tuple[float, ...] = (0.0,)

    @property
    def end_s(self) -> float:
        """The last time in any array; 0 for an empty log."""
        times = (self.commands.t_s, self.wheels.t_s, self.poses.t_s, self.gyro.t_s)
        return max((float(t[-1]) for t in times if t.size), default=0.0)

    @property
    def segments(self) -> int:
        """Number of segments: one more than the highest in any array."""
        arrays = (self.commands.segment, self.wheels.segment, self.poses.segment, self.gyro.segment)
        return 1 + max((int(segment.max()) for segment in arrays if segment.size), default=-1)

    def to_pandas(self) -> Any:
        """All of it as one `pandas.DataFrame`, a row a sample in order of time, with the columns of our CSV.

        `t_s`, `segment`, `cmd_left_rad_s`, ..., `imu_wz_rad_s`; what a row does not hold is NaN. Raises ImportError
        without pandas, which nothing else needs.
        """
        import pandas  # noqa: PLC0415

        frames = [pandas.DataFrame(columns) for columns in self._tables() if columns["t_s"].size]
        if not frames:
            return pandas.DataFrame({name: np.empty(0) for columns in self._tables() for name in columns})
        joined = pandas.concat(frames, ignore_index=True)
        return joined.sort_values("t_s", kind="stable", ignore_index=True)

    def _tables(self) -> list[dict[str, NDArray[Any]]]:
        of: list[tuple[Commands | Wheels | Poses | Gyro, dict[str, str]]] = [
            (self.commands, {"cmd_left_rad_s": "left_rad_s", "cmd_right_rad_s": "right_rad_s"}),
            (self.wheels, _WHEEL_COLUMNS),
            (self.poses, {"pose_x_m": "x_m", "pose_y_m": "y_m", "pose_yaw_rad": "yaw_rad"}),
            (self.gyro, {"imu_wz_rad_s": "yaw_rate_rad_s"}),
        ]
        return [
            {"t_s": part.t_s, "segment": part.segment, **{name: getattr(part, field) for name, field in names.items()}}
            for part, names in of
        ]


def concatenate(drives: Sequence[DriveLog]) -> DriveLog:
    """Drives one after the other, later ones shifted in time, their segments numbered on; at least one is needed."""
    shifts, firsts = [], []
    shift_s, first = 0.0, 0
    for drive in drives:
        shifts.append(shift_s)
        firsts.append(first)
        shift_s += drive.end_s + _BETWEEN_LOGS_S
        first += drive.segments

    def joined(name: str, field: str) -> Array:
        arrays = [getattr(getattr(drive, name), field) for drive in drives]
        if field == "t_s":
            arrays = [array + shift for array, shift in zip(arrays, shifts, strict=True)]
        return np.concatenate(arrays)

    def segments(name: str) -> Index:
        pairs = zip(drives, firsts, strict=True)
        return np.concatenate([getattr(drive, name).segment + first for drive, first in pairs])

    def fields(name: str, *names: str) -> dict[str, Array]:
        return {field: joined(name, field) for field in ("t_s", *names)}

    # A drive without wheels says nothing about how wheels were measured, unless there is no other.
    rolling = [drive.wheels for drive in drives if drive.wheels.t_s.size] or [drive.wheels for drive in drives]
    angles = ("left_angle_rad", "right_angle_rad")
    speeds = ("left_speed_rad_s", "right_speed_rad_s")
    return DriveLog(
        sources=tuple(source for drive in drives for source in drive.sources),
        commands=Commands(**fields("commands", "left_rad_s", "right_rad_s"), segment=segments("commands")),
        wheels=Wheels(
            **fields("wheels", *angles, *speeds),
            segment=segments("wheels"),
            angle_measured=all(wheels.angle_measured for wheels in rolling),
            speed_measured=all(wheels.speed_measured for wheels in rolling),
        ),
        poses=Poses(**fields("poses", "x_m", "y_m", "yaw_rad"), segment=segments("poses")),
        gyro=Gyro(**fields("gyro", "yaw_rate_rad_s"), segment=segments("gyro")),
        notes=tuple(note for drive in drives for note in drive.notes),
        begins_s=tuple(shift + begin for drive, shift in zip(drives, shifts, strict=True) for begin in drive.begins_s),
    )


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
