"""Bags of ROS 2 (MCAP, sqlite3) and ROS 1: the chosen topics -> the arrays of a drive; see docs/ros2.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import Robot, RobotConfig
from disco_hw.errors import LogError
from disco_hw.log.drive import (
    LONGEST_COMMAND_S,
    LONGEST_SILENCE_NS,
    Array,
    DriveLog,
    Edge,
    Index,
    Motion,
    after_silences,
    drive_of,
    poses,
    rotations,
    with_unknown,
)
from disco_hw.log.importing import LogFormat
from disco_hw.log.importing.counter_wrap import WIDTHS_BITS, continuous_wheels, restarts
from disco_hw.log.importing.csv_drive import length_fault
from disco_hw.log.importing.losses import WARNING, loss_note, unknown_commands_note
from disco_hw.log.importing.rosbag_file import Bag, DamagedBagError, Undecoded, is_bag, message_of, open_bag
from disco_hw.log.importing.rosbag_times import Column, alike, timeline
from disco_hw.log.importing.rosbag_topics import (
    ARRAY,
    COMMANDS,
    DRIVERS,
    JOINTS,
    ODOMETRY,
    POSES,
    ROLES,
    TF,
    TRANSFORMS,
    TWIST,
    WHEELS,
    Choice,
    choose,
)
from drivers.pose import is_heading_measured

_LONGEST_COMMAND_NS = round(LONGEST_COMMAND_S * 1e9)
# Chosen: where no wheels show a pause, nothing at all for this long is one.
_LONGEST_PAUSE_NS = 2_000_000_000
# Chosen: hours of a robot's topics; more would take minutes and fill the memory.
_MOST_MESSAGES = 20_000_000
_YAW_VARIANCE = 35
"""Place of the yaw's variance among the 36 of a pose's covariance."""


def read_rosbag(path: Path, config: RobotConfig) -> DriveLog:
    """Commands, wheels and poses of a bag; the table of its topics is the first note. Raises LogError and InputError.

    Times are those of the messages' headers, see `timeline`. A new segment begins where the wheels were silent for half
    a second, where a clock was set, and where an encoder was. A command counts until the next one, half a second at
    most, as the controllers of ROS have it.
    """
    try:
        return _read(path, config, salvage=False)
    except DamagedBagError as error:
        try:
            return _read(path, config, salvage=True)
        except DamagedBagError:
            raise error from None


def _read(path: Path, config: RobotConfig, *, salvage: bool) -> DriveLog:
    with open_bag(path, salvage=salvage) as bag:
        choice = choose(bag, config.ros2)
        undecoded: dict[str, Undecoded] = {}
        columns = _columns(bag, choice, config, undecoded)
        notes = (*bag.notes, *_notes_on_undecoded(bag, undecoded))
    drive = _assembled(path, choice, columns, config.robot)
    return replace(drive, notes=(*notes, *drive.notes))


def _notes_on_undecoded(bag: Bag, undecoded: dict[str, Undecoded]) -> list[str]:
    """Sentences on the messages that cannot be decoded, by topic; raises LogError for a topic of which most cannot."""
    return [
        loss_note(
            str(bag.path), topic, one.count, max(one.count, bag.topics[topic].count),
            f"messages cannot be decoded and were left out, the first says: {one.first}", "name another topic",
        )
        for topic, one in sorted(undecoded.items())
    ]  # fmt: skip


def _columns(bag: Bag, choice: Choice, config: RobotConfig, undecoded: dict[str, Undecoded]) -> dict[str, Column]:
    """One pass through the chosen topics; messages that cannot be decoded are counted."""
    columns: dict[str, Column] = {}
    takes: dict[str, list[tuple[str, ReadRow]]] = {}
    for role in ROLES:
        used = choice.used(role)
        if used is not None and used.topic != TF:
            width, read_row = row_reader(role, used.type, choice, config)
            columns[role] = Column(width)
            takes.setdefault(used.topic, []).append((role, read_row))
    by_tf = choice.used(POSES) is not None and POSES not in columns
    # An edge that moves may have been latched, too, before it did.
    edges = {edge: (Column(7), Column(7)) for edge in choice.edges} if by_tf else {}
    transforms = {one.name for one in bag.topics.values() if one.type in TRANSFORMS} if by_tf else set()
    for number, message in enumerate(bag.messages({*takes, *transforms}, undecoded=undecoded)):
        if number >= _MOST_MESSAGES:
            raise LogError(
                f"{bag.path}: over {_MOST_MESSAGES} messages on the topics that are read; record only these topics"
            )
        for role, read_row in takes.get(message.topic, ()):
            try:
                columns[role].add(message.log_ns, stamp_of(message.value), finite(read_row(message.value)))
            except (IndexError, ValueError, TypeError, AttributeError, OverflowError) as error:
                fault = f"not as its type has it ({message_of(error)})"
                undecoded.setdefault(message.topic, Undecoded()).add(fault)
        if message.topic in transforms:
            for one in message.value.transforms:
                edge = (one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/"))
                if edge in edges:
                    edges[edge][message.topic.endswith("static")].add(
                        message.log_ns, stamp_of(one), finite(_place(one.transform.translation, one.transform.rotation))
                    )
    is_static = {edge: not moving.log_ns for edge, (moving, _) in edges.items()}
    return columns | {_edge_name(edge, is_static[edge]): both[is_static[edge]] for edge, both in edges.items()}


def _edge_name(edge: Edge, static: bool) -> str:
    return f"{'/tf_static' if static else '/tf'} {edge[0]} - {edge[1]}"


def _assembled(path: Path, choice: Choice, columns: dict[str, Column], robot: Robot) -> DriveLog:
    notes = [choice.as_text()]
    for name, column in columns.items():
        used = choice.used(name)
        if not column.log_ns and used is not None:
            raise LogError(f"{path}: {used.topic}: none of its messages holds {name}; name another with --topic")
        if column.left_out:
            label = f"{name}, {used.topic}" if used is not None else name
            total = column.left_out + len(column.log_ns)
            what = "messages hold no finite value and were left out"
            notes.append(loss_note(str(path), label, column.left_out, total, what, "name another topic with --topic"))
    static = {name for name in columns if name.startswith("/tf_static")}
    times = timeline({name: one.stamps() for name, one in columns.items() if one.log_ns and name not in static})
    notes += times.notes
    arrays = {name: _ordered(path, name, times.t_ns[name], columns[name].table(), notes) for name in times.t_ns}
    pose_ns, pose = _pose_table(path, choice, columns, arrays, static, notes)
    nothing: tuple[Index, Array] = (np.empty(0, dtype=np.int64), np.empty((0, 4)))
    command_ns, command = _expired(*arrays.get(COMMANDS, (nothing[0], np.empty((0, 2)))))
    wheel_ns, wheel = arrays.get(WHEELS, nothing)
    wheel_ns, wheel, measured = _measured_rows(path, wheel_ns, wheel, notes)
    uncertain = np.zeros(wheel_ns.size, dtype=bool)
    if measured[0]:
        wheel, uncertain = _unwrapped(path, wheel_ns, wheel, robot, (command_ns, command), notes)
    breaks_ns = np.unique(
        np.concatenate(
            [
                times.breaks_ns,
                _pauses(wheel_ns, (command_ns, pose_ns)),
                wheel_ns[restarts(np.asarray((wheel_ns - wheel_ns[:1]) * 1e-9), wheel[:, :2]) | uncertain],
            ]
        )
    )
    if breaks_ns.size:
        notes.append(
            f"{breaks_ns.size} times the wheels paused, or a clock or encoder was set; new segments begin there"
        )
    drive = drive_of(str(path), (command_ns, command), (wheel_ns, wheel), (pose_ns, pose), breaks_ns, measured)
    times_s = np.unique(np.concatenate([drive.commands.t_s, drive.wheels.t_s, drive.poses.t_s]))
    why = f"as each counts for {LONGEST_COMMAND_S:g} s at most"
    notes += unknown_commands_note(str(path), times_s, drive.commands, drive.wheels, why)
    fault = length_fault(drive.poses, drive.wheels, drive.commands, robot.wheel_radius_m)
    if fault is not None:
        notes.append(f"poses and wheels do not fit together: {fault.rpartition(';')[0]}; see which topics were read")
    return replace(drive, notes=(*notes, *_notes_on_types(choice)))


def _notes_on_types(choice: Choice) -> list[str]:
    """Return notes on what the types of the chosen topics mean for the results."""
    notes = []
    command, wheel = choice.used(COMMANDS), choice.used(WHEELS)
    if command is None:
        notes.append("no topic holds commands: effects between command and wheel cannot be seen")
    elif command.type in TWIST:
        notes.append(
            f"{command.topic} is a motion of the body: made wheel speeds with robot.toml's wheel_radius_m and "
            "axial_distance_m, which must be those that the robot's own controller uses"
        )
    if wheel is not None and wheel.type == ODOMETRY:
        notes.append(
            f"no topic holds the wheels: {wheel.topic} has been through the robot's own kinematics, was turned back "
            "with robot.toml's, and hides what that leaves out; record /joint_states"
        )
    if wheel is None:
        notes.append("no topic holds the wheels; record /joint_states")
    if choice.used(POSES) is None:
        notes.append(
            "no topic holds poses that were not made from the wheels; record those of a SLAM or motion capture"
        )
    return notes


def _ordered(path: Path, name: str, t_ns: Index, table: Array, notes: list[str]) -> tuple[Index, Array]:
    """Sort messages by time, and keep the first of several with one time; one that is sent again is no loss."""
    unique, first, place = np.unique(t_ns, return_index=True, return_inverse=True)
    conflicts = int(np.count_nonzero(~alike(table, table[first][place])))
    if conflicts:
        what = "messages have the time of another and were left out"
        notes.append(loss_note(str(path), name, conflicts, t_ns.size, what, "record it again, or name another topic"))
    return unique, table[first]


def _pose_table(
    path: Path,
    choice: Choice,
    columns: dict[str, Column],
    arrays: dict[str, tuple[Index, Array]],
    static: set[str],
    notes: list[str],
) -> tuple[Index, Array]:
    """Return times (N,), ns, and x, y, yaw (N, 3) of the poses; yaw is NaN where nobody measured it."""
    used = choice.used(POSES)
    if used is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 3))
    if used.topic != TF:
        t_ns, values = arrays[POSES]
        bare = int(np.count_nonzero(np.isnan(values[:, 6])))
        if bare:
            notes.append(
                f"{WARNING}{used.topic}: the covariance of {bare} of {t_ns.size} poses says that nobody measured the "
                f"heading ({100.0 * bare / t_ns.size:.0f} %); their positions are kept, their headings are not"
            )
        rotation = rotations(values[:, 3:])
        return t_ns, np.column_stack([values[:, :2], np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])])
    motions = []
    for edge in choice.edges:
        name = next(_edge_name(edge, one) for one in (True, False) if _edge_name(edge, one) in columns)
        if not columns[name].log_ns:
            raise LogError(f"{path}: no usable transform {edge[0]} - {edge[1]}; name another topic with --topic poses=")
        t_ns, values = arrays.get(name, (np.zeros(1, dtype=np.int64), columns[name].table()))
        motions.append(Motion(t_ns, values, name in static))
    t_ns, table = poses(motions)
    if not t_ns.size:
        raise LogError(f"{path}: the transforms of {used.why} never overlap in time; name another topic for poses")
    return t_ns, table


def _measured_rows(path: Path, t_ns: Index, wheel: Array, notes: list[str]) -> tuple[Index, Array, tuple[bool, bool]]:
    """Rows in which everything is there that the wheels measure at all, and whether that is angles, and speeds."""
    angles, speeds = (np.isfinite(wheel[:, part]).all(axis=1) for part in (slice(0, 2), slice(2, 4)))
    has_angle, has_speed = (
        bool(2 * np.count_nonzero(angles) > t_ns.size),
        bool(2 * np.count_nonzero(speeds) > t_ns.size),
    )
    kept = (angles | (not has_angle)) & (speeds | (not has_speed))
    if t_ns.size and not (has_angle or has_speed):
        raise LogError(
            f"{path}: wheels: most messages have neither position nor velocity of all wheels; "
            "set ros2.left_joints and ros2.right_joints"
        )
    if not kept.all():
        dropped, what = int(np.count_nonzero(~kept)), "messages lack a position or velocity and were left out"
        notes.append(
            loss_note(str(path), WHEELS, dropped, kept.size, what, "set ros2.left_joints and ros2.right_joints")
        )
    wheel = wheel[kept]
    if has_angle and has_speed and (wheel[:, 2:] == 0.0).all() and np.ptp(wheel[:, 0]) > 1.0:
        notes.append("wheels: the velocities are all zero while the wheels turn; they were taken from the positions")
        has_speed = False
    return t_ns[kept], wheel, (has_angle, has_speed)


def _unwrapped(
    path: Path, t_ns: Index, wheel: Array, robot: Robot, commands: tuple[Index, Array], notes: list[str]
) -> tuple[Array, NDArray[np.bool_]]:
    """Wheels whose angles are continuous; and where the number of wraps is not known, (N,).

    Angles wrap at a turn or where the counter behind them overflows; each wheel is judged by itself.
    """
    # Before the first command nothing is known.
    commanded = np.vstack([[np.nan, np.nan], commands[1]])[np.searchsorted(commands[0], t_ns, side="right")]
    known = np.where(np.isfinite(wheel[:, 2:]), wheel[:, 2:], commanded)
    tick_rad = 2.0 * math.pi / robot.ticks_per_rev
    spans = (2.0 * math.pi, *(2.0**bits * tick_rad for bits in WIDTHS_BITS))
    begins = np.concatenate([[True], np.diff(t_ns) > LONGEST_SILENCE_NS])
    names = (f"{path}: left wheel", f"{path}: right wheel")
    angles, uncertain = continuous_wheels(
        names, (t_ns - t_ns[0]) * 1e-9, wheel[:, :2], spans, begins, known, notes, "rad"
    )
    return np.column_stack([angles, wheel[:, 2:]]), uncertain


def _expired(t_ns: Index, speeds: Array) -> tuple[Index, Array]:
    """Commands with a row of NaN where one has run out before the next came."""
    speeds = np.where(np.isfinite(speeds), speeds, np.nan)
    ends = t_ns + _LONGEST_COMMAND_NS
    is_expired = np.append(np.diff(t_ns) > _LONGEST_COMMAND_NS, True) if t_ns.size else np.empty(0, dtype=bool)
    is_expired &= np.isfinite(speeds).all(axis=1)
    return with_unknown(t_ns, speeds, ends[is_expired])


def _pauses(wheel_ns: Index, others: Sequence[Index]) -> Index:
    """Return the times (ns) after gaps: half a second without wheel data; without any, two seconds without anything."""
    if wheel_ns.size:
        return after_silences(wheel_ns)
    all_ns = np.sort(np.concatenate(others))
    return np.asarray(all_ns[1:][np.diff(all_ns) > _LONGEST_PAUSE_NS])


Row = tuple[float, ...]
ReadRow = Callable[[Any], Row | None]


def finite(row: Row | None) -> Row | None:
    """Return a row without infinities, else None. NaN stands for what is not known, and stays."""
    return None if row is None or any(map(math.isinf, row)) else row


def stamp_of(message: Any) -> int:
    """Return the header's stamp, ns; 0 without a header."""
    header = getattr(message, "header", None)
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec) if header is not None else 0


def row_reader(role: str, kind: str, choice: Choice, config: RobotConfig) -> tuple[int, ReadRow]:
    """Return how many numbers a message of this type gives in this role, and the function that reads them."""
    if role == POSES:
        return 7, _pose_row
    if role == WHEELS:
        return 4, partial(_joint_wheels, choice) if kind == JOINTS else partial(_odometry_wheels, config.robot)
    if kind == JOINTS:
        return 2, partial(_joint_command, choice)
    if kind == ARRAY:
        return 2, partial(_array_command, choice, config.ros2.command_joints)
    if kind in TWIST:
        return 2, lambda message: _wheel_pair(config.robot, getattr(message, "twist", message))
    return 2, _drivers if DRIVERS.fullmatch(kind) else _wheel_speeds


def _wheel_pair(robot: Robot, twist: Any) -> Row:
    """Left and right wheel speeds of a motion, rad/s."""
    forward, half = float(twist.linear.x), 0.5 * robot.axial_distance_m * float(twist.angular.z)
    return (forward - half) / robot.wheel_radius_m, (forward + half) / robot.wheel_radius_m


def _mean_of(values: Any, names: Sequence[str], joints: Sequence[str]) -> float:
    """Mean over several joints; NaN where the array does not hold one of them, or nobody knows which they are."""
    found = [float(values[names.index(name)]) for name in joints if names.index(name) < len(values)]
    return sum(found) / len(found) if found and len(found) == len(joints) else math.nan


def _joint_wheels(choice: Choice, message: Any) -> Row | None:
    names, sides = list(message.name), (choice.left_joints, choice.right_joints)
    # Other joints of the robot may come in messages of their own.
    if not {*sides[0], *sides[1]} <= set(names):
        return None
    return tuple(_mean_of(values, names, side) for values in (message.position, message.velocity) for side in sides)


def _joint_command(choice: Choice, message: Any) -> Row | None:
    names, sides = list(message.name), (choice.left_joints, choice.right_joints)
    if not all(sides) or not {*sides[0], *sides[1]} <= set(names):
        return None
    # Without a speed nothing is commanded from here on.
    return tuple(_mean_of(message.velocity, names, side) for side in sides)


def _array_command(choice: Choice, joints: Sequence[str], message: Any) -> Row | None:
    if not joints:
        return (float(message.data[0]), float(message.data[1])) if len(message.data) == 2 else None
    return tuple(_mean_of(message.data, list(joints), side) for side in (choice.left_joints, choice.right_joints))


def _drivers(message: Any) -> Row | None:
    """Drive of Clearpath's bases: left and right in rad/s where the mode is that of a velocity (0)."""
    return None if getattr(message, "mode", 0) != 0 else (float(message.drivers[0]), float(message.drivers[1]))


def _wheel_speeds(message: Any) -> Row:
    return float(message.velocity_left), float(message.velocity_right)


def _odometry_wheels(robot: Robot, message: Any) -> Row:
    return (math.nan, math.nan, *_wheel_pair(robot, message.twist.twist))


def _pose_row(message: Any) -> Row | None:
    """Position and quaternion (7,); the quaternion is NaN where the message says that nobody measured the heading."""
    if not hasattr(message.pose, "covariance"):
        return _place(message.pose.position, message.pose.orientation)
    row = _place(message.pose.pose.position, message.pose.pose.orientation)
    if row is None:
        return None
    yaw_rad = math.atan2(2.0 * (row[6] * row[5] + row[3] * row[4]), 1.0 - 2.0 * (row[4] ** 2 + row[5] ** 2))
    measured = is_heading_measured(yaw_rad, float(message.pose.covariance[_YAW_VARIANCE]))
    return row if measured else (*row[:3], *[math.nan] * 4)


def _place(position: Any, rotation: Any) -> Row | None:
    """Position and quaternion (7,)."""
    row = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    length = math.hypot(*row[3:])
    # A quaternion of zeros is what a publisher leaves that never set it.
    return None if not (math.isfinite(sum(row)) and 0.5 < length < 2.0) else row


FORMAT = LogFormat("rosbag", is_bag, read_rosbag, order=20, has_topics=True)
