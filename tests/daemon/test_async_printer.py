"""Sentences reach whoever reads, and nobody waits for who does not; over real pipes and a real terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import termios
import threading

import pytest

from disco_hw.daemon.process import AsyncPrinter


def line_of(topic, text):
    return f"{topic}: {text}"


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        with contextlib.suppress(OSError):
            os.close(end)


def printed_unread(descriptor):
    """Print ten sentences that nobody reads, which must end all the same; returns the printer."""
    printer = AsyncPrinter(descriptor, line_of, most=4)
    printing = threading.Thread(target=lambda: [printer("event", str(k)) for k in range(10)], daemon=True)
    printing.start()
    printing.join(10.0)
    assert not printing.is_alive(), "it is held up"
    return printer


def test_everything_is_written_in_order_by_the_end(pipe):
    printer = AsyncPrinter(pipe[1], line_of)
    for k in range(200):
        printer("event", f"{k} \udcff")
    printer.close()
    printer.close()
    assert os.read(pipe[0], 65536) == b"".join(b"event: %d \xff\n" % k for k in range(200))


def test_a_terminal_that_is_held_by_ctrl_s_holds_nobody_up():
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    printer = printed_unread(slave)
    printer.close(0.1)
    termios.tcflow(slave, termios.TCOON)
    printer.close(10.0)
    output = b""
    # A terminal hands on what was written to it piece by piece.
    while b"messages are missing here" not in output and select.select([master], [], [], 10.0)[0]:
        output += os.read(master, 65536)
    lines = output.decode().splitlines()
    assert lines[0] == "event: 0"
    assert "messages are missing here" in lines[-1]
    os.close(master)
    os.close(slave)


def test_a_pipe_that_nobody_reads_holds_nobody_up(pipe):
    os.write(pipe[1], b"x" * fcntl.fcntl(pipe[1], fcntl.F_GETPIPE_SZ))
    assert printed_unread(pipe[1]).dropped >= 5


def test_a_reader_that_has_gone_is_no_error(pipe):
    os.close(pipe[0])
    printer = printed_unread(pipe[1])
    printer.close()
    assert not printer._thread.is_alive()
