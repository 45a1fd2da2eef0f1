"""The adapter's process: reads the daemon's packets, learns, and sends reports, until the daemon hangs up."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
from typing import TYPE_CHECKING

import msgspec

from disco_hw.processes import limit_thread_pools

if TYPE_CHECKING:
    from disco_hw.adaptation.adapter import Adapter
    from disco_hw.adaptation.link import Range

_NICE = 10


def main(descriptor: int) -> int:
    """Serve the daemon at the other end of this socket; returns the exit code."""
    limit_thread_pools()
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    # Imported late: the numeric libraries read their limits when they are loaded.
    from disco_hw.adaptation.adapter import Adapter  # noqa: PLC0415
    from disco_hw.adaptation.link import (  # noqa: PLC0415
        MAX_PACKET_BYTES,
        Range,
        ToAdapter,
    )

    decode, encode = msgspec.msgpack.Decoder(ToAdapter).decode, msgspec.msgpack.Encoder().encode
    adapter = Adapter()
    begun = False
    with socket.socket(fileno=descriptor) as daemon:
        while packet := daemon.recv(MAX_PACKET_BYTES):
            message = decode(packet)
            if isinstance(message, Range) and not begun:
                begun = True
                threading.Thread(target=_train, args=(adapter, message), daemon=True).start()
            report = adapter.take(message)
            if report is not None:
                with contextlib.suppress(BlockingIOError):
                    daemon.send(encode(report), socket.MSG_DONTWAIT)
    return 0


def _train(adapter: Adapter, about: Range) -> None:
    """Train the network while the recursive estimate serves alone, then hand it over."""
    import numpy as np  # noqa: PLC0415

    # Loads torch: seconds, in which samples already come in.
    from disco_hw.adaptation.network import Training, train_network, training_range  # noqa: PLC0415
    from disco_hw.inference.noise import USUAL  # noqa: PLC0415
    from disco_hw.model import Model  # noqa: PLC0415

    mean, low, high = (np.array(values) for values in (about.mean, about.low, about.high))
    training = Training(*training_range(mean, low, high), about.wheel_rad_s)
    adapter.equip(train_network(training, USUAL, Model(about.mean[1], about.mean[2], about.mean[0])))


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        sys.exit(main(int(sys.argv[1])))
