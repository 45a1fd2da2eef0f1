"""The adapter's process: reads the daemon's packets, learns, and sends reports, until the daemon hangs up."""

from __future__ import annotations

import contextlib
import os
import socket
import sys

import msgspec

from disco_hw.daemon.realtime import limit_thread_pools

_NICE = 10


def main(descriptor: int) -> int:
    """Serve the daemon at the other end of this socket; returns the exit code."""
    limit_thread_pools()
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    # Imported late: the numeric libraries read their limits when they are loaded.
    from disco_hw.adapt.adapter import Adapter  # noqa: PLC0415
    from disco_hw.adapt.link import MAX_PACKET_BYTES  # noqa: PLC0415
    from disco_hw.adapt.messages import ToAdapter  # noqa: PLC0415

    decode, encode = msgspec.msgpack.Decoder(ToAdapter).decode, msgspec.msgpack.Encoder().encode
    adapter = Adapter()
    with socket.socket(fileno=descriptor) as daemon:
        while packet := daemon.recv(MAX_PACKET_BYTES):
            report = adapter.take(decode(packet))
            if report is not None:
                with contextlib.suppress(BlockingIOError):
                    daemon.send(encode(report), socket.MSG_DONTWAIT)
    return 0


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        sys.exit(main(int(sys.argv[1])))
