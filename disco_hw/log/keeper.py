"""Starts log writers when the recorder asks for one: `python -m disco_hw.log.keeper CHANNEL START`, two descriptors.

Made before the loop runs, with all that a writer needs imported: a writer is then a fork of this small process, so that
the control loop, which may ask for one at any moment, starts no process itself. It ends with the recorder's process.
Signals to end are not for it: a service manager sends them to all processes at once.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys

import msgspec

from disco_hw.log import writer
from disco_hw.log.link import Ended, Launch, Start, Started

_MESSAGE_BYTES = 65_536


def keep(channel: socket.socket, start: Start) -> None:
    """Start a writer for each request until the other end of the channel is closed."""
    living: dict[int, int] = {}
    while True:
        readable, _, _ = select.select([channel.fileno(), *living], [], [])
        for descriptor in [descriptor for descriptor in living if descriptor in readable]:
            pid = living.pop(descriptor)
            os.close(descriptor)
            _, how = os.waitpid(pid, 0)
            _say(channel, Ended(pid, os.waitstatus_to_exitcode(how)))
        if channel.fileno() not in readable:
            continue
        try:
            message, descriptors, _, _ = socket.recv_fds(channel, _MESSAGE_BYTES, 1)
        except OSError:
            return
        if not message:
            return
        connection = socket.socket(fileno=descriptors[0])
        launch = msgspec.msgpack.decode(message, type=Launch)
        try:
            pid = os.fork()
        except OSError as error:
            connection.close()
            _say(channel, Started(0, f"no process can be made ({error.strerror})"))
            continue
        if pid == 0:
            # A writer that kept these would hide the end of the keeper and of other writers.
            for descriptor in living:
                os.close(descriptor)
            channel.close()
            _write(start, launch, connection)
        connection.close()
        living[os.pidfd_open(pid)] = pid
        _say(channel, Started(pid))


def _write(start: Start, launch: Launch, connection: socket.socket) -> None:
    """Be a writer, and end as one."""
    code = 1
    try:
        code = writer.run(
            msgspec.structs.replace(
                start,
                part=launch.part,
                start_ns=launch.start_ns,
                continues=launch.continues,
                continues_sequence=launch.continues_sequence,
            ),
            connection,
        )
    except Exception:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code)


def _say(channel: socket.socket, word: Started | Ended) -> None:
    """Tell the recorder; one that is gone or does not read costs nothing."""
    with contextlib.suppress(OSError):
        channel.send(msgspec.msgpack.encode(word), socket.MSG_DONTWAIT)


def main() -> int:
    """Read what every log begins with, and keep the writers."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # The recorder's process may block signals that it takes another way; that would have been inherited.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    if len(sys.argv) != 3 or not all(argument.isdecimal() for argument in sys.argv[1:]):
        print("usage: python -m disco_hw.log.keeper CHANNEL START (it is started by the recorder)", file=sys.stderr)
        return 2
    with os.fdopen(int(sys.argv[2]), "rb") as file:
        file.seek(0)
        start = msgspec.msgpack.decode(file.read(), type=Start)
    keep(socket.socket(fileno=int(sys.argv[1])), start)
    return 0


if __name__ == "__main__":
    sys.exit(main())
