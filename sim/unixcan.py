"""A python-can bus over the hub's Unix socket: each packet is one `struct can_frame`, as on a SocketCAN raw socket."""

from __future__ import annotations

import errno
import select
import socket
import time
from typing import Any

import can

from sim.can_protocol import ECHO_OWN_FRAMES, FRAME_BYTES, CanFrame, pack_frame, unpack_frame

# Chosen: as below, for about the frames that a CAN interface queues.
_SEND_BUFFER_BYTES = 16_384


class UnixCanBus(can.BusABC):
    """Bus of the hub that listens at `channel`; registered with python-can as interface "unixcan".

    Lossless and in order. Classic frames only: data, remote and error frames with 11 or 29 bit identifiers.
    One thread may receive while another sends.

    Raises `can.CanInitializationError` if no hub listens at `channel`. After the hub has closed, `recv` and `send`
    raise `can.CanOperationError`; so does a full transmit buffer, with ENOBUFS as a SocketCAN socket does.
    """

    def __init__(
        self,
        channel: Any,
        can_filters: Any = None,
        receive_own_messages: bool = False,
        **kwargs: object,
    ) -> None:
        path = str(channel)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            # A deep buffer would keep commands until they are stale; a CAN interface queues about this many frames.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            self._socket.connect(path)
            self._socket.setblocking(False)
            if receive_own_messages:
                self._socket.send(ECHO_OWN_FRAMES)
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(f"no CAN hub at {path}: {error.strerror or error}", error.errno) from error
        self._channel = path
        self.channel_info = f"unixcan {path}"
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """Descriptor that is readable when a frame is waiting; -1 once shut down."""
        return self._socket.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put one frame into the queue; wait at most `timeout` seconds for room (None: for ever, 0: not at all).

        Raises `can.CanOperationError` (ENOBUFS when there was no room in time), ValueError for a CAN FD message.
        """
        if msg.is_fd:
            raise ValueError("unixcan carries classic CAN frames only")
        packet = pack_frame(
            CanFrame(
                msg.arbitration_id,
                bytes(msg.data),
                extended=msg.is_extended_id,
                remote=msg.is_remote_frame,
                error=msg.is_error_frame,
                remote_length=msg.dlc if msg.is_remote_frame else 0,
            )
        )
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(packet)
                return
            except BlockingIOError:
                left_s = None if deadline_s is None else deadline_s - time.monotonic()
                if left_s is not None and left_s <= 0.0:
                    raise can.CanOperationError("transmit buffer full", errno.ENOBUFS) from None
                self._wait(left_s, writable=True)
            except OSError as error:
                raise can.CanOperationError(f"send on {self._channel}: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                packet = self._socket.recv(FRAME_BYTES)
            except BlockingIOError:
                left_s = None if deadline_s is None else deadline_s - time.monotonic()
                if left_s is not None and left_s <= 0.0:
                    return None, False
                self._wait(left_s, writable=False)
                continue
            except OSError as error:
                raise can.CanOperationError(f"receive on {self._channel}: {error.strerror}", error.errno) from error
            if not packet:
                raise can.CanOperationError(f"receive on {self._channel}: the hub has closed", errno.EPIPE)
            frame = unpack_frame(packet)
            if frame is None:
                raise can.CanOperationError(f"receive on {self._channel}: {packet!r} is no CAN frame", errno.EBADMSG)
            return (
                can.Message(
                    # python-can stamps with the wall clock; whoever needs the monotonic clock reads it on reception.
                    timestamp=time.time_ns() * 1e-9,
                    arbitration_id=frame.can_id,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                    is_error_frame=frame.error,
                    dlc=frame.remote_length if frame.remote else len(frame.data),
                    data=frame.data,
                    channel=self._channel,
                ),
                False,
            )

    def _wait(self, timeout_s: float | None, *, writable: bool) -> None:
        descriptor = self._socket.fileno()
        if descriptor < 0:
            raise can.CanOperationError(f"{self._channel}: this bus has been shut down", errno.EBADF)
        try:
            if writable:
                select.select((), (descriptor,), (), timeout_s)
            else:
                select.select((descriptor,), (), (), timeout_s)
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"{self._channel}: {error}", errno.EBADF) from error

    def shutdown(self) -> None:
        """Close the connection and wake a thread that waits in `recv`; safe to call twice."""
        super().shutdown()
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError as error:
            if error.errno not in (errno.ENOTCONN, errno.EBADF):
                raise
        finally:
            self._socket.close()
