"""The daemon's local control socket: one JSON object a line in, one out, over a Unix socket for its owner alone.

Polled from the control loop: no call blocks, every buffer is bounded, and the work of one poll is bounded too, so a
client that floods, sends garbage or never reads its replies costs the loop some microseconds and then its connection.
What `status` is answered with is made here too.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from disco_hw.daemon import HINT, peer_uid
from disco_hw.daemon.loop import LoopStats
from disco_hw.errors import InputError
from disco_hw.log import records
from disco_hw.log.recorder import RecorderStats
from disco_hw.processes import DescriptorReserve
from disco_hw.runtime.core import DaemonCore
from disco_hw.runtime.robot_setup import limits, requested_task
from drivers.private_files import why_not_private
from drivers.types import Driver

# A poll is a part of the control loop's tick: what all clients together can make it do in one is bounded. Chosen.
_MAX_CLIENTS = 8
_ACCEPTS_PER_POLL = 4
_BYTES_PER_POLL = 1024
_REQUESTS_PER_POLL = 4
# What a client may leave lying about here: a request not ended, requests not answered, replies not read. Chosen.
_MAX_LINE_BYTES = 4096
_MAX_WAITING = 16
_MAX_UNREAD_BYTES = 65536
_ESTOP = "estop"


@dataclass(frozen=True, slots=True)
class ControlMessage:
    """One request of one client: `{"do": action, ...arguments}`."""

    client: int
    action: str
    arguments: dict[str, Any]


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    last_active: int
    incoming: bytearray = field(default_factory=bytearray)
    waiting: deque[ControlMessage] = field(default_factory=deque)
    outgoing: bytearray = field(default_factory=bytearray)
    finished: bool = False


class ControlServer:
    """Server of the control socket: `poll()` for requests in each tick, e-stop first; `reply()` to each.

    Raises InputError if another daemon serves this socket, or the path cannot be used. What a dead daemon left behind
    is replaced: a record lock shows whether one lives, which the kernel drops with the process, however it ends.
    """

    def __init__(self, path: Path, actions: Collection[str], allowed_uids: Collection[int] | None = None) -> None:
        self.path = path
        self._accepted = 0
        self._actions = frozenset(actions)
        self._allowed_uids = frozenset({os.geteuid(), 0} if allowed_uids is None else allowed_uids)
        self._clients: dict[int, _Client] = {}
        self._activity = 0
        self._failure = ""
        _create_private_directory(path.parent)
        self._lock_fd = _lock(path)
        try:
            self._listener = _listen(path)
        except BaseException:
            os.close(self._lock_fd)
            raise
        self._bound = _identity(path)
        # For as many clients, and the one that comes before another is dropped for it.
        self._reserve = DescriptorReserve(_MAX_CLIENTS + 1)

    def poll(self) -> list[ControlMessage]:
        """Accept, read and send what is possible at once; return the requests to act on, e-stops first.

        At most 4 requests of each client in one poll, but all e-stops that have arrived; the rest waits.
        """
        self._accept()
        for number, client in list(self._clients.items()):
            self._read(number, client)
        urgent: list[ControlMessage] = []
        others: list[ControlMessage] = []
        for client in self._clients.values():
            urgent += [message for message in client.waiting if message.action == _ESTOP]
            client.waiting = deque(message for message in client.waiting if message.action != _ESTOP)
            for _ in range(min(_REQUESTS_PER_POLL, len(client.waiting))):
                others.append(client.waiting.popleft())
        in_hand = {message.client for message in (*urgent, *others)}
        for number, client in list(self._clients.items()):
            self._send(number, client)
            if client.finished and number not in in_hand and not client.waiting and not client.outgoing:
                self._drop(number)
        return urgent + others

    def reply(self, message: ControlMessage, body: Mapping[str, Any]) -> None:
        """Answer `message` with `body` as JSON, plus its action as `do`; nothing happens if the client has gone."""
        client = self._clients.get(message.client)
        if client is not None:
            client.outgoing += msgspec.json.encode({"do": message.action, **body}) + b"\n"
            self._send(message.client, client)

    def restore(self) -> str | None:
        """Make directory, lock and socket again where they were removed; return what happened, if that is new.

        Systemd removes a user's runtime directory at the last logout, and others clean /tmp: a daemon that lives on
        could not be reached any more, and a second one could start.
        """
        # The lock counts as held on its file alone. Where that is there it is not opened: closing it would unlock it.
        has_lock = _identity(_lock_path(self.path)) == _identity(self._lock_fd)
        if has_lock and _identity(self.path) == self._bound:
            return None
        try:
            _create_private_directory(self.path.parent)
            if not has_lock:
                lock_fd = _lock(self.path)
                os.close(self._lock_fd)
                self._lock_fd = lock_fd
            listener = _listen(self.path)
        except (InputError, OSError) as error:
            is_known, self._failure = str(error) == self._failure, str(error)
            return None if is_known else f"{self.path}: was removed, and cannot be made again: {error}"
        self._listener.close()
        self._listener, self._bound, self._failure = listener, _identity(self.path), ""
        return f"{self.path}: was removed, and is made again; see `loginctl enable-linger`"

    def close(self) -> None:
        """Disconnect all clients and remove the socket, if it is still this one's; safe to call twice."""
        for number in list(self._clients):
            self._drop(number)
        if self._listener.fileno() != -1:
            if _identity(self.path) == self._bound:
                self.path.unlink(missing_ok=True)
            self._listener.close()
            self._reserve.close()
            # The lock's file stays: removing it would let a third process lock a new file while a second holds this.
            os.close(self._lock_fd)

    def _accept(self) -> None:
        for _ in range(_ACCEPTS_PER_POLL):
            connection = self._accept_one()
            if connection is None:
                return
            if peer_uid(connection) not in self._allowed_uids:
                connection.close()
                continue
            connection.setblocking(False)
            if len(self._clients) >= _MAX_CLIENTS:
                # Idle connections must not keep an e-stop out.
                self._drop(min(self._clients, key=lambda number: self._clients[number].last_active))
            self._accepted += 1
            self._activity += 1
            self._clients[self._accepted] = _Client(connection, self._activity)

    def _accept_one(self) -> socket.socket | None:
        """Accept a connection if one waits; with a reserved descriptor where there is no other, for an e-stop."""
        with contextlib.suppress(OSError):
            try:
                return self._listener.accept()[0]
            except BlockingIOError:
                return None
            except OSError:
                with self._reserve.released():
                    return self._listener.accept()[0]
        return None

    def _read(self, number: int, client: _Client) -> None:
        if client.finished:
            return
        try:
            data = client.connection.recv(_BYTES_PER_POLL)
        except BlockingIOError:
            return
        except OSError:
            self._drop(number)
            return
        client.finished = not data
        *lines, rest = (bytes(client.incoming) + data).split(b"\n")
        client.incoming = bytearray(rest)
        for line in lines:
            if line.strip():
                self._handle_line(number, client, line)
            if client.finished:
                return
        if len(rest) > _MAX_LINE_BYTES:
            self._refuse(client, f"a request may have at most {_MAX_LINE_BYTES} bytes")

    def _handle_line(self, number: int, client: _Client, line: bytes) -> None:
        try:
            request = msgspec.json.decode(line, type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            self._refuse(client, 'not a JSON object; send one object a line, such as {"do": "status"}')
            return
        action = request.pop("do", None)
        if not isinstance(action, str) or action not in self._actions:
            self._refuse(client, f'"do" must be one of {", ".join(sorted(self._actions))}')
            return
        if len(client.waiting) >= _MAX_WAITING and action != _ESTOP:
            self._refuse(client, f"more than {_MAX_WAITING} requests at once; wait for the replies")
            return
        self._activity += 1
        client.last_active = self._activity
        client.waiting.append(ControlMessage(number, action, request))

    def _refuse(self, client: _Client, reason: str) -> None:
        """Say what is wrong and hang up after what is waiting: who sends garbage or floods would go on doing so."""
        client.outgoing += msgspec.json.encode({"ok": False, "error": reason}) + b"\n"
        client.finished = True

    def _send(self, number: int, client: _Client) -> None:
        if not client.outgoing:
            return
        try:
            sent = client.connection.send(client.outgoing)
            del client.outgoing[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(number)
            return
        if len(client.outgoing) > _MAX_UNREAD_BYTES:
            self._drop(number)

    def _drop(self, number: int) -> None:
        client = self._clients.pop(number, None)
        if client is not None:
            client.connection.close()


def _create_private_directory(directory: Path) -> None:
    """Create the directory for its owner alone; refuse one in which others could swap the socket."""
    try:
        with contextlib.suppress(FileExistsError):
            directory.mkdir(mode=0o700, parents=True)
        why = why_not_private(directory, {os.geteuid(), 0})
    except OSError as error:
        raise InputError(f"{directory}: cannot hold the control socket ({error.strerror}); {HINT}") from None
    if why is not None:
        raise InputError(f"{directory}: {why}; {HINT}")


def _identity(file: Path | int) -> tuple[int, int] | None:
    """Return device and inode of a path or a descriptor; None where nothing is there."""
    try:
        found = os.stat(file)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _lock_path(path: Path) -> Path:
    """Return the lock file of the socket at `path`."""
    return path.with_name(path.name + ".lock")


def refuse_served(path: Path) -> None:
    """Raise InputError if a daemon serves the socket at `path` now."""
    if _lock_path(path).exists():
        os.close(_lock(path))


def _lock(path: Path) -> int:
    """Return the descriptor of the socket's lock file, locked; it holds this process's id, where there is room."""
    lock_path = _lock_path(path)
    try:
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise InputError(f"{lock_path}: cannot be opened ({error.strerror}); {HINT}") from None
    try:
        # A record lock, as a child made by fork() does not hold it on when the daemon dies.
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        owner = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
        os.close(descriptor)
        raise InputError(f"{path}: a daemon already serves this socket (process {owner}); stop it first") from None
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return descriptor


def _listen(path: Path) -> socket.socket:
    """Return a listening socket at `path` with mode 600, in place of one that a dead daemon left."""
    if path.is_socket():
        path.unlink()
    elif os.path.lexists(path):
        raise InputError(f"{path}: not a socket; remove it, or {HINT}")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        # On Linux the mode of the unbound socket becomes that of the file, so it is never open to others.
        os.fchmod(listener.fileno(), 0o600)
        listener.bind(str(path))
        listener.listen(_MAX_CLIENTS)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(f"{path}: cannot be made ({error.strerror or error}); {HINT}") from None
    return listener


def loop_figures(loop: LoopStats) -> dict[str, Any]:
    """Lateness and duration in microseconds, overruns and skipped periods; costs about a millisecond."""
    return {
        "lateness_us": _microseconds(loop.lateness.summary_s()),
        "duration_us": _microseconds(loop.duration.summary_s()),
        "overruns": loop.overruns,
        "skipped": loop.skipped_periods,
    }


def status(core: DaemonCore, loop: dict[str, Any], recorder: RecorderStats) -> dict[str, Any]:
    """Return everything that an operator or a page needs to know now; what does not exist is None.

    `robot_state_ns`: when the newest frame with the robot's state arrived, on this host's monotonic clock. `loop` is
    from `loop_figures`.
    """
    tick = core.last
    if tick is None:
        return {"ok": False, "error": "the loop has not started yet"}
    estimate, robot, wheels = tick.pipeline.estimate, core.robot_status, core.newest_wheels
    task = core.task
    distance = float(core.course.off_m(np.array([[estimate.x_m, estimate.y_m]]))[0])
    plan = tick.pipeline.plan
    return {
        "ok": True,
        "state": tick.output.state.name,
        "detail": tick.output.detail,
        "running": tick.output.running,
        "estop": tick.output.estop,
        "link": core.transport.state.value,
        "link_error": core.transport.last_error,
        "driver_state": core.driver.state.name,
        "controller": _controller(core.driver),
        "robot_state": "UNKNOWN" if robot is None else robot.state,
        "robot_state_ns": None if robot is None else robot.t_ns,
        "fault": "UNKNOWN" if robot is None else robot.fault,
        "stop_cause": "UNKNOWN" if robot is None else robot.stop_cause,
        "pose": [estimate.x_m, estimate.y_m, estimate.yaw_rad],
        "pose_ok": estimate.pose_ok,
        "heading_known": estimate.heading_known,
        "wheels": None if wheels is None else [wheels.left_speed_rad_s, wheels.right_speed_rad_s],
        "command": [tick.pipeline.command.left_rad_s, tick.pipeline.command.right_rad_s],
        "source": tick.pipeline.source.value,
        "task": {
            "laps": core.progress.laps,
            "progress": core.progress.describe(),
            "length_m": core.course.length_m,
            "distance_m": distance,
            "speed_m_s": estimate.speed_m_s,
            "asked": requested_task(task),
            "limits": limits(core.task_config.robot, task),
            "labels": {name: field.label for name, field in task.editable(core.task_config.robot).items()},
            "note": task.editing_note(core.task_config.robot),
        },
        "plan": None if plan is None else {"ess": plan.diagnostics.ess, "temperature": plan.diagnostics.temperature},
        "loop": loop,
        "transport": asdict(core.transport.stats),
        "driver": asdict(core.driver.stats),
        "fusion": asdict(core.pipeline.fusion.stats),
        "poses": _poses(core),
        "plausibility": asdict(core.plausibility),
        "recorder": asdict(recorder),
        "adaptation": core.adaptation.status(),
        "area": core.area.status(tick.pipeline.t_ns),
    }


def _poses(core: DaemonCore) -> list[dict[str, Any]]:
    """Return the status of each pose source: its frame and place on the robot, and how it does."""
    tick, sources = core.last, core.pipeline.fusion.sources
    found = sources.status(0 if tick is None else tick.pipeline.t_ns)
    return [
        {**one, "heading": heading.value, "origin": list(named.origin), "offset": list(named.offset)}
        for one, heading, named in zip(found, core.pipeline.headings.current, core.config.pose.every(), strict=True)
    ]


def _controller(driver: Driver) -> dict[str, Any] | None:
    identity, kept = driver.identity, driver.limits
    if identity is None or kept is None:
        return None
    known_limits = {name: asdict(limit) for name, limit in kept.known().items()}
    return {**asdict(identity), "words": identity.describe(), "limits": known_limits}


def _microseconds(summary: dict[str, float]) -> dict[str, float]:
    return {name.removesuffix("_s"): value * 1e6 for name, value in summary.items()}


def counters(
    core: DaemonCore, loop: LoopStats, recorder: RecorderStats, now_ns: int, stolen_ms: int = 0
) -> records.Counters:
    """Return every counter of the stack as one record; `stolen_ms`: of `processes.stolen_ms`, since the start."""
    return records.Counters(
        t_ns=now_ns,
        transport=asdict(core.transport.stats),
        driver=asdict(core.driver.stats),
        fusion=asdict(core.pipeline.fusion.stats),
        plausibility=asdict(core.plausibility),
        recorder={name: value for name, value in asdict(recorder).items() if type(value) is int},
        loop={"ticks": loop.ticks, "overruns": loop.overruns, "skipped": loop.skipped_periods, "stolen_ms": stolen_ms},
        adaptation=core.adaptation.counts(),
        entered=dict(core.entered),
        poses=core.pipeline.fusion.sources.counts(),
    )
