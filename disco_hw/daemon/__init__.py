"""The real-time shell of disco-hw: clocks, the loop and its processes; here how the daemon is spoken to.

`disco-hw ctl`: one request to the running daemon, and its answer in words. Where the control socket is and whom to
believe there is one rule for the daemon and for who asks it.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shlex
import socket
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from disco_hw.config import RobotConfig, load_daemon_address
from disco_hw.errors import InputError, WorkError
from disco_hw.files import file_name_of
from disco_hw.runtime import advice, by_command, status_headline
from drivers.private_files import placed_by, user_name, why_not_private
from drivers.types import SOURCE_TEXTS, SaidBy
from firmware_protocol import status_codes

HINT = "set daemon.control_socket to a path in a directory of your own"
# User id of the superuser (POSIX).
_ROOT = 0
_TEMPORARY = Path("/tmp")


def default_socket_path(name: str) -> Path:
    """Return where the socket of the robot called `name` is, in a directory that only this user can enter.

    $XDG_RUNTIME_DIR/disco-hw/NAME.sock, or where that variable names no directory of this user the first of
    /tmp/disco-hw-UID, /tmp/disco-hw-UID-2, -3, ... that is this user's, or else the first that is not there yet. What
    other users made there is passed over, and cannot change the choice once this user's directory exists. Root is
    given the socket in another user's XDG_RUNTIME_DIR if there is one.
    """
    uid = os.geteuid()
    file_name = f"{file_name_of(name)}.sock"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        directory = Path(runtime) / "disco-hw"
        if _belongs_to(Path(runtime), uid) and (_belongs_to(directory, uid) or not _exists(directory)):
            return directory / file_name
        if uid == _ROOT and (directory / file_name).is_socket():
            return directory / file_name
    private_directory = next(
        (directory for directory in _runtime_directories(uid) if _belongs_to(directory, uid)), None
    )
    return (private_directory or next(directory for directory in _names(uid) if not _exists(directory))) / file_name


def passed_over(path: Path) -> tuple[str, ...]:
    """Return a line for each directory, with owners, that `default_socket_path` did not accept before `path`."""
    uid = os.geteuid()
    if path.parent.parent != _TEMPORARY or not _numbered(uid).fullmatch(path.parent.name):
        return ()
    candidates = _runtime_directories(uid)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        candidates = [Path(runtime), Path(runtime) / "disco-hw", *candidates]
    lines = []
    for directory in candidates:
        with contextlib.suppress(OSError):
            if (why := why_not_private(directory, {uid})) is not None:
                lines.append(f"{directory}: {why}; not used")
    return tuple(lines)


def believed_users(path: Path) -> frozenset[int]:
    """Return the users whose daemon may listen at `path`: this one, root, and for root whose directory it is.

    Root believes another user only in a directory that no third one can have put there. Raises WorkError, naming the
    owner, if the directory is a stranger's or others can write to it, and OSError if it cannot be looked at.
    """
    directory, uid = path.parent, os.geteuid()
    believed = frozenset({uid, _ROOT})
    why = why_not_private(directory, believed)
    if why is not None and uid == _ROOT:
        owner = directory.lstat().st_uid
        if why_not_private(directory, {owner}) is None and placed_by(directory, {owner, _ROOT}):
            return believed | {owner}
    if why is not None:
        raise WorkError(f"{directory}: {why}; nothing is sent there, {HINT}")
    return believed


def connect(path: Path, timeout_s: float) -> socket.socket:
    """Return a connection to the daemon at `path`, whose user is one of `believed_users`.

    Raises WorkError if it is another user's process, and OSError if nobody listens.
    """
    believed = believed_users(path)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
        listener = peer_uid(connection)
        if listener not in believed:
            raise WorkError(f"{path}: a process of {user_name(listener)} listens there; nothing is sent, {HINT}")
    except BaseException:
        connection.close()
        raise
    return connection


def peer_uid(connection: socket.socket) -> int:
    """Return the user whose process has the other end of a Unix socket."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return int(struct.unpack("3i", credentials)[1])


def _names(uid: int) -> Iterator[Path]:
    """Yield the directories in /tmp that may hold this user's socket, in order of preference, without an end."""
    yield _TEMPORARY / f"disco-hw-{uid}"
    for number in count(2):
        yield _TEMPORARY / f"disco-hw-{uid}-{number}"


def _numbered(uid: int) -> re.Pattern[str]:
    return re.compile(rf"disco-hw-{uid}(?:-([2-9]|[1-9][0-9]{{1,6}}))?")


def _runtime_directories(uid: int) -> list[Path]:
    """Return the existing entries of /tmp that bear one of this user's names, in order of their numbers."""
    numbered = _numbered(uid)
    found = [(int(match[1] or 1), entry) for entry in os.listdir(_TEMPORARY) if (match := numbered.fullmatch(entry))]
    return [_TEMPORARY / entry for _, entry in sorted(found)]


def _belongs_to(directory: Path, uid: int) -> bool:
    try:
        return why_not_private(directory, {uid}) is None
    except OSError:
        return False


def _exists(directory: Path) -> bool:
    return os.path.lexists(directory)


# Chosen: far above any reply; a peer that sends without an end must not fill the memory.
_MAX_REPLY_BYTES = 1 << 20


def send_request(path: Path, request: Mapping[str, Any], timeout_s: float = 2.0) -> dict[str, Any]:
    """Send one request, as `{"do": "arm"}`, to the daemon at `path` and return its reply.

    Raises WorkError in one line if no daemon listens there, it is none of a believed user's (`connect`), it does
    not answer within `timeout_s`, or it hangs up.
    """
    deadline_s = time.monotonic() + timeout_s
    with errors_in_one_line(path, timeout_s), connect(path, timeout_s) as connection:
        return exchange(connection, path, request, deadline_s)


def exchange(connection: socket.socket, path: Path, request: Mapping[str, Any], deadline_s: float) -> dict[str, Any]:
    """Send one request on an open connection to the daemon at `path` and return the reply.

    Raises OSError (TimeoutError after `deadline_s`), HungUpError, or WorkError for a reply that is none.
    """
    connection.settimeout(max(1e-3, deadline_s - time.monotonic()))
    connection.sendall(json.dumps(dict(request)).encode() + b"\n")
    line = bytearray()
    while not line.endswith(b"\n"):
        connection.settimeout(max(1e-3, deadline_s - time.monotonic()))
        data = connection.recv(65536)
        if not data or len(line) > _MAX_REPLY_BYTES:
            raise HungUpError(f"{path}: the daemon closed the connection without an answer; see its output")
        line += data
    try:
        reply = json.loads(line)
    except ValueError:
        reply = None
    if not isinstance(reply, dict):
        raise WorkError(f"{path}: what listens there is not a disco-hw daemon")
    return reply


class HungUpError(WorkError):
    """The daemon closed the connection before it answered."""


@contextlib.contextmanager
def errors_in_one_line(path: Path, timeout_s: float) -> Iterator[None]:
    """Turn the errors of a connection to the daemon at `path` into a WorkError with the remedy."""
    try:
        yield
    except TimeoutError:
        raise WorkError(f"{path}: no answer from the daemon within {timeout_s:g} s; see its output") from None
    except (FileNotFoundError, ConnectionRefusedError):
        raise WorkError(f"{path}: no daemon listens there; start it with `disco-hw run`") from None
    except OSError as error:
        raise WorkError(
            f"{path}: no connection to the daemon ({error.strerror or error}); run this as the daemon's user"
        ) from None


ADAPT_ACTIONS = ("revert", "adapt")
"""Back to the belief of the model file, and learning again."""
ACTIONS = ("arm", "start", "stop", "disarm", "estop", "reset", "status", "quit", *ADAPT_ACTIONS)
TASK = "task"
UNRECORDED = "unrecorded"
"""What `arm` must say where nothing is being recorded although it should be."""
UNRECORDED_HINT = "correct that, or arm with --unrecorded"
OBSTACLE, FENCE = "obstacle", "fence"
PAGE_ACTIONS = (TASK, OBSTACLE, FENCE, "drive")
"""What takes arguments: another circle, an obstacle, the fence, and a hand on the page's pad."""
REQUESTS = (*ACTIONS, TASK, OBSTACLE, FENCE)
"""What a person may ask for here; a hand on a pad is no matter of single requests."""
SERVED = (*ACTIONS, *PAGE_ACTIONS)


def socket_path(config: RobotConfig) -> Path:
    """Return the path of the control socket of this robot's daemon."""
    return _path_of(config.robot.name, config.daemon.control_socket)


def _path_of(name: str, configured: str | None) -> Path:
    return Path(configured) if configured is not None else default_socket_path(name)


def ask(robot: Path, action: str, changes: Sequence[str] = (), unrecorded: bool = False) -> dict[str, Any]:
    """Send one request to the daemon of `robot`, and return its reply.

    `changes`: the request's further words, such as "radius_m=0.8"; `task`, `obstacle` and `fence` need them, and no
    other request takes any. `unrecorded`, for `arm` alone: arm even though nothing is recorded that should be.

    Raises InputError for an unknown action and for changes that are none, and WorkError without a daemon; for an e-stop
    with what stops the robot all the same.
    """
    if action not in REQUESTS:
        raise InputError(f"{action}: no such request; write one of {', '.join(REQUESTS)}")
    if (action in _EXAMPLES) != bool(changes):
        taking = ", ".join(_EXAMPLES)
        fault = (
            "name what to change" if action in _EXAMPLES else f"{action} takes no further arguments; only {taking} do"
        )
        shown = action if action in _EXAMPLES else TASK
        raise InputError(f"{fault}: ctl {robot} {shown} {_EXAMPLES[shown]}")
    if unrecorded and action != "arm":
        raise InputError(f"--unrecorded: belongs to arm, not to {action}; leave it out")
    request: dict[str, Any] = {"do": action} | _arguments(action, changes) | ({UNRECORDED: True} if unrecorded else {})
    try:
        path = _path_of(*load_daemon_address(robot))
        for line in passed_over(path):
            print(f"disco-hw: {line}", file=sys.stderr)
        return send_request(path, request)
    except (InputError, WorkError) as error:
        if action != "estop":
            raise
        hint = f"use `disco-hw estop {shlex.quote(str(robot))}` or the robot's own e-stop button, now"
        raise type(error)(f"NOT SENT: {hint} ({error})") from None


_EXAMPLES = {
    TASK: "radius_m=0.8 speed_m_s=0.3",
    OBSTACLE: "add name=pillar x_m=0.7 y_m=0 radius_m=0.15",
    FENCE: "override",
}
"""The requests that take more, each with an example of it."""


def _arguments(action: str, changes: Sequence[str]) -> dict[str, Any]:
    """Return what the words after a request say; empty where there are none. Raises InputError."""
    if not changes:
        return {}
    if action == OBSTACLE and changes[0] in {"add", "remove"}:
        name = [text.partition("=")[2] for text in changes[1:] if text.startswith("name=")]
        rest = [text for text in changes[1:] if not text.startswith("name=")]
        return {"change": changes[0], **({"name": name[-1]} if name else {}), **dict(map(_change, rest))}
    if action == FENCE and list(changes) in (["override"], ["hold"]):
        return {"override": changes[0] == "override"}
    if action != TASK:
        usage = {OBSTACLE: "add or remove, and then NAME=VALUE", FENCE: "override or hold"}[action]
        example = f"{action} {_EXAMPLES[action]}"
        raise InputError(f"{action} {' '.join(changes)}: not understood; write {usage}, such as {example}")
    return dict(map(_change, changes))


def _change(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if name == "do" or not math.isfinite(number):
        raise InputError(f"{text}: not a change of the task; write NAME=NUMBER, such as radius_m=0.8")
    return name, number


def describe(reply: dict[str, Any], robot: Path) -> str:
    """Return a reply of the daemon of `robot` for the operator."""
    if not reply.get("ok"):
        return f"refused: {reply.get('error')}"
    if reply.get("do") != "status":
        return str(reply.get("text", "done"))
    task, loop = reply["task"], reply["loop"]
    lines = [
        ": ".join(status_headline(reply)),
        *(f"next: {sentence}" for sentence in advice(reply, by_command(robot))),
        f"robot {reply['robot_state']}, link {reply['link']}, fault {status_codes.fault(reply['fault'])}",
        *describe_controller(reply.get("controller")),
        f"{' '.join(task['progress'])}, distance {task['distance_m'] * 1e3:.0f} mm, speed {task['speed_m_s']:.3f} m/s",
        f"loop lateness p99 {loop['lateness_us']['p99']:.0f} us, max {loop['lateness_us']['max']:.0f} us, "
        f"overruns {loop['overruns']}, skipped {loop['skipped']}",
    ]
    lines += _describe_fence(reply["area"])
    adaptation = reply.get("adaptation")
    if adaptation is not None:
        paused = ", paused" if adaptation["paused"] else ""
        lines.append(
            f"belief of the {'running drive' if adaptation['belief'] == 'adapted' else 'model file'}{paused}: "
            + ", ".join(
                f"{name.removesuffix('_m')} {value:.4f} +- {adaptation['std'][name]:.4f} m"
                for name, value in adaptation["mean"].items()
            )
        )
        lines.append(f"adaptation: {adaptation['text']}")
    recorder = reply["recorder"]
    if recorder["fault"]:
        lines.append(f"RECORDING: {recorder['fault']}")
    if recorder["path"]:
        lines.append(f"recording {describe_recording(recorder)}")
    if recorder["last_error"] and recorder["last_error"] not in recorder["fault"]:
        lines.append(f"recording, last error: {recorder['last_error']}")
    return "\n".join(lines)


def _describe_fence(area: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on fence and obstacles from a status; none where there is no fence."""
    if area["verdict"] == "idle":
        return
    reason = f", {area['reason']}" if area["reason"] else ""
    left = "" if area["clearance_m"] is None else f"; {area['clearance_m']:.2f} m left on the stopping path"
    yield f"fence: {area['verdict']}{reason}{left}"
    for one in area["obstacles"]:
        missing = ", NO LONGER REPORTED: report it again or remove it" if one["lost"] else ""
        place = f"({one['x_m']:.2f}, {one['y_m']:.2f}), radius {one['radius_m']:.2f} m"
        yield f"obstacle {one['name']}: {place}, reported {one['age_s']:.1f} of {one['age_limit_s']:g} s ago{missing}"


def describe_controller(controller: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Return a line on the motor controller and one on its limits, by who states them; empty before it is known."""
    if controller is None:
        return ()
    by_source: dict[SaidBy, list[str]] = {}
    for name, limit in controller["limits"].items():
        by_source.setdefault(limit["said_by"], []).append(f"{name} {limit['value']:g}")
    limits = (f"{', '.join(names)} ({SOURCE_TEXTS[source]})" for source, names in by_source.items())
    return (f"controller: {controller['words']}", f"limits: {'; '.join(limits)}")


def describe_recording(recorder: Mapping[str, Any]) -> str:
    """Describe what became of every tick that a status's recorder was given."""
    given = recorder["ticks"] + recorder["dropped_ticks"]
    counts = {"waiting": "waiting_ticks", "dropped": "dropped_ticks", "lost with a deleted file": "lost_ticks"}
    parts = [f"{recorder['delivered_ticks']} of {given} ticks"]
    parts += [f"{recorder[count]} {what}" for what, count in counts.items() if recorder[count]]
    if recorder["refused"]:
        parts.append(f"{recorder['refused']} records refused")
    if recorder["writer_deaths"]:
        parts.append(f"restarted {recorder['writer_deaths']} times")
    return f"{recorder['path']}: {', '.join(parts)}"
