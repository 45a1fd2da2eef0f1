"""Poses of ROS 2, from the process `disco-hw bridge ros2`, as nothing of ROS belongs into the control process.

It sends datagrams as those of `udp` to a Unix socket, whose sender the kernel names: only this user and root count, and
of several bridges the first. What a person should know comes the same way.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

from drivers.pose import PoseSourceError
from drivers.pose.senders import SILENCE_S, SenderGate
from drivers.pose.udp import LONGEST_DATAGRAM, MOST_A_TICK, POSE_HINT, message_of, pose_of
from drivers.types import PoseSample

SOURCE = "ros2"
_CREDENTIALS = struct.Struct("3i")
# User id of the superuser (POSIX): its processes can send as anybody.
_ROOT = 0


def bridge_address(port: int) -> bytes:
    """Return the address at which this user's daemon receives the bridge: an abstract name, gone with the daemon."""
    return f"\0disco-hw/{os.geteuid()}/pose/{port}".encode()


def create_pose_source(
    *,
    port: int = 5005,
    topic: str = "",
    frame: str = "",
    position_std_m: float = 0.0,
    yaw_std_rad: float = 0.0,
    sender_silence_s: float = SILENCE_S,
    **_of_other_sources: Any,
) -> BridgePoses:
    """Create the bridge's source by the port of [pose]; the other fields are the bridge's.

    Raises PoseSourceError where another daemon hears the bridge already.
    """
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    try:
        opened.bind(bridge_address(port))
    except OSError as error:
        opened.close()
        raise PoseSourceError(
            f"the bridge's port {port}: {error.strerror}; choose another pose.port for one of the robots"
        ) from None
    return BridgePoses(opened, SenderGate(sender_silence_s))


class BridgePoses:
    """Satisfies `drivers.types.PoseSource` and `drivers.types.MessageSource`."""

    def __init__(self, opened: socket.socket, senders: SenderGate) -> None:
        self._socket = opened
        self._users = {os.geteuid(), _ROOT}
        self._senders = senders
        self._messages: list[str] = []

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the poses received since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(OSError):
            for _ in range(MOST_A_TICK):
                datagram, ancillary, _, _ = self._socket.recvmsg(LONGEST_DATAGRAM, socket.CMSG_SPACE(_CREDENTIALS.size))
                process, user = _sender(ancillary)
                if user not in self._users:
                    text = f"process {process} of user {user} sends poses to the bridge's port"
                    self._senders.refused.add(now_ns, text, "only the daemon's user and root may")
                elif (pose := self._handle(datagram, f"bridge process {process}", now_ns)) is not None:
                    poses.append(pose)
        return sorted(poses, key=lambda pose: pose.t_ns)

    @property
    def refused(self) -> int:
        """Number of datagrams refused for their sender, or because they hold no pose."""
        return self._senders.refused.count

    def new_messages(self) -> Sequence[str]:
        """Return messages for the operator since the last call."""
        messages, self._messages = self._messages, []
        return [*messages, *self._senders.new_messages()]

    def close(self) -> None:
        """Close the bridge's socket; safe to call twice."""
        self._socket.close()

    def _handle(self, datagram: bytes, sender: str, now_ns: int) -> PoseSample | None:
        if not self._senders.may_send(sender, now_ns):
            return None
        pose = pose_of(datagram, now_ns, time.monotonic_ns())
        if isinstance(pose, PoseSample):
            self._senders.note_pose(sender, now_ns)
            return pose
        if (text := message_of(datagram)) is not None:
            self._messages.append(text)
        else:
            self._senders.refused.add(now_ns, f"the {sender} sends no pose but {pose}", POSE_HINT)
        return None


def _sender(ancillary: Sequence[tuple[int, int, bytes]]) -> tuple[int | None, int | None]:
    """Return the process and the user that sent a datagram, as the kernel says."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) == _CREDENTIALS.size:
            process, user, _ = _CREDENTIALS.unpack(data)
            return int(process), int(user)
    return None, None
