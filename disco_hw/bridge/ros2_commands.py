"""Commands that the bridge receives: /cmd_vel as a hand on the pad of `drive --ros2`, and requests as those of `ctl`.

A speed drives for 0.2 s from when it was sent, and only after arming was asked for while speeds were coming. A silence
disarms; then arming has to be asked for again.
"""

from __future__ import annotations

import contextlib
import math
import shlex
import socket
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2_inlets import AHEAD_NS, OLDEST_NS
from disco_hw.config import Drive, Robot
from disco_hw.daemon import ask, connect
from disco_hw.daemon.emergency import stop_robot
from disco_hw.drive import INPUT_LIMIT_NS
from disco_hw.errors import InputError, WorkError
from disco_hw.estimation.odometry import OdometryParameters

TYPES = (msg.Twist, msg.TwistStamped)
# Chosen: so many messages open the deadman before one may hold it, as only a new press drives.
_OPENINGS = 2
# As of `disco_hw.daemon.kept_connection`: a local socket that takes longer has no daemon that listens.
_CONNECT_S = 0.2
# Chosen: above any reply, which are not looked at.
_REPLY_BYTES = 1 << 16
_ALWAYS = ("estop", "stop", "disarm", "status")


class SpeedInlet:
    """Judges speeds and makes the daemon's `drive` requests of them; pure."""

    def __init__(self, robot: Robot, drive: Drive, parameters: OdometryParameters) -> None:
        self.refused: Counter[str] = Counter()
        self.passed = 0
        self.permitted = False
        self._top_rad_s = drive.speed_share * robot.max_wheel_speed_rad_s
        self._turn_share = drive.turn_share
        self._parameters = parameters
        self._openings = _OPENINGS
        self._sent_ns = -INPUT_LIMIT_NS

    def permit(self, now_ns: int) -> str | None:
        """Let the speeds drive from now on, until they fall silent; returns why not, in words."""
        if now_ns - self._sent_ns > INPUT_LIMIT_NS:
            return "no speeds received on cmd_vel; publish zeros at 10 Hz or more, then send the request again"
        self.permitted, self._openings = True, _OPENINGS
        return None

    def forbid(self) -> None:
        """Let them drive no longer."""
        self.permitted = False

    def request(
        self, message: msg.Twist | msg.TwistStamped, sent_ns: int, mono_ns: int, wall_ns: int
    ) -> dict[str, Any] | None:
        """Return the request to the daemon for a speed received now; None for what is none.

        `sent_ns` is wall-clock time.
        """
        twist = message if isinstance(message, msg.Twist) else message.twist
        stamp_ns = 0 if isinstance(message, msg.Twist) else msg.time_of(message.header.stamp)
        age_ns = wall_ns - (stamp_ns or sent_ns)
        if not -AHEAD_NS <= age_ns <= INPUT_LIMIT_NS:
            self.refused["older than 0.2 s, or by another clock; synchronise the clocks"] += 1
            return None
        speed, turn = twist.linear.x, twist.angular.z
        if not math.isfinite(speed + turn):
            self.refused["not finite"] += 1
            self.permitted = False
            return None
        sent_mono_ns = mono_ns - max(0, age_ns)
        if sent_mono_ns - self._sent_ns > INPUT_LIMIT_NS:
            self.permitted = False
        self._sent_ns = sent_mono_ns
        self.passed += 1
        is_held = self.permitted and not self._openings
        self._openings = max(0, self._openings - 1)
        forward, left = self._shares(speed, turn)
        return {"do": "drive", "forward": forward, "left": left, "held": is_held, "stamp": str(sent_mono_ns)}

    def _shares(self, speed_m_s: float, turn_rad_s: float) -> tuple[float, float]:
        """Shares of the largest wheel speed and turn; what is too fast is slowed down on the same curve."""
        radius = self._parameters.wheel_radius_m
        forward = speed_m_s / radius / self._top_rad_s
        turn = 0.5 * turn_rad_s * self._parameters.axial_distance_m / radius / self._top_rad_s
        left = turn / self._turn_share
        scale = max(1.0, abs(forward), abs(left), abs(forward) + abs(turn))
        return forward / scale, left / scale


class DaemonPad:
    """The connection over which speeds go to the daemon; never waits for an answer, never raises."""

    def __init__(self, path: Path) -> None:
        self.refusal = ""
        self._path = path
        self._connection: socket.socket | None = None
        self._next_try_ns = 0
        self._rest = b""

    def send(self, now_ns: int, request: Mapping[str, Any]) -> None:
        """Send a request, and read what was answered to those before; what cannot be sent at once is dropped."""
        if self._connection is None and not self._connect(now_ns):
            return
        assert self._connection is not None
        try:
            self._connection.send(msgspec.json.encode(request) + b"\n")
            self._read(self._connection)
        except BlockingIOError:
            return
        except OSError as error:
            self.refusal = f"the daemon closed the connection ({error.strerror or error})"
            self.close()

    def close(self) -> None:
        """Close the connection to the daemon; safe to call twice."""
        if self._connection is not None:
            self._connection.close()
            self._connection, self._rest = None, b""

    def _connect(self, now_ns: int) -> bool:
        if now_ns < self._next_try_ns:
            return False
        self._next_try_ns = now_ns + 500_000_000
        try:
            self._connection = connect(self._path, _CONNECT_S)
        except (OSError, WorkError) as error:
            self.refusal = str(error)
            return False
        self._connection.setblocking(False)
        return True

    def _read(self, connection: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                data = connection.recv(_REPLY_BYTES)
                if not data:
                    raise ConnectionResetError("end of the connection")
                *lines, self._rest = (self._rest + data).split(b"\n")
                for line in lines:
                    with contextlib.suppress(msgspec.MsgspecError):
                        self.refusal = str(msgspec.json.decode(line, type=dict[str, Any]).get("error", ""))


class Errands:
    """Runs one thing after the other in a thread of its own; of a flood it takes a few, and counts the rest."""

    def __init__(self, most: int = 10) -> None:
        self.refused = 0
        self._pool = ThreadPoolExecutor(1)
        self._room = threading.BoundedSemaphore(most)

    def add(self, work: Callable[[str], None], request: str) -> None:
        """Do `work(words)` when those before are done, unless too many are waiting."""
        if not self._room.acquire(blocking=False):
            self.refused += 1
            return
        self._pool.submit(work, request).add_done_callback(lambda _: self._room.release())

    def close(self) -> None:
        """Start no more errands; safe to call twice."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def refusal(request: str, may_move: bool, age_ns: int) -> str | None:
    """Return why a request is not accepted from ROS 2, where senders are unknown; None for stops, which always are.

    `age_ns`: since it was sent, by the sender's wall clock.
    """
    if request.split(" ", 1)[0] in _ALWAYS:
        return None
    if not may_move:
        return (
            "not accepted from ROS 2, because any node in the domain could have sent it; set ros2.may_move = true in "
            "robot.toml, or use disco-hw ctl"
        )
    if abs(age_ns) > OLDEST_NS:
        return "sent over 1 s ago, or by another clock; synchronise the clocks, then send the request again"
    return None


def request_daemon(robot: Path, request: str, link: str | None) -> dict[str, Any]:
    """Ask the daemon as `disco-hw ctl ROBOT.toml WORDS` does, and return its answer; never raises.

    Where it does not confirm an e-stop, the robot is stopped on its link, as by `disco-hw estop`.
    """
    try:
        action, *changes = shlex.split(request) or [""]
    except ValueError as error:
        return {"do": request[:80], "ok": False, "error": str(error)}
    unrecorded, has_daemon = "--unrecorded" in changes, True
    try:
        reply = ask(robot, action, [change for change in changes if change != "--unrecorded"], unrecorded)
        if reply.get("ok") or action != "estop":
            return reply
        refused = str(reply.get("error"))
    except (InputError, WorkError) as error:
        # robot.toml that cannot be read names no daemon to ask.
        refused, has_daemon = str(error), isinstance(error, WorkError)
    if action != "estop":
        return {"do": action, "ok": False, "error": refused}
    try:
        outcome = stop_robot(robot, link, daemon_failed=has_daemon)
    except InputError as error:
        return {"do": action, "ok": False, "error": f"NOT SENT: {error}"}
    return {"do": action, "ok": outcome.confirmed, "text" if outcome.confirmed else "error": outcome.as_text()}
