"""Sentences reach whoever reads, and nobody waits for who does not; over real pipes and a real terminal."""

from __future__ import annotations

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
        try:
            os.close(end)
        except OSError:
            continue


def printed_unread(descriptor):
    """A teller, and whether telling it ten sentences ended although nobody reads."""
    teller = AsyncPrinter(descriptor, line_of, most=4)
    printing = threading.Thread(target=lambda: [teller("event", str(k)) for k in range(10)], daemon=True)
    printing.start()
    printing.join(10.0)
    return teller, not printing.is_alive()


def test_everything_is_written_in_order_by_the_end(pipe):
    teller = AsyncPrinter(pipe[1], line_of)
    for k in range(200):
        teller("event", f"{k} \udcff")
    teller.close()
    teller.close()
    assert os.read(pipe[0], 65536) == b"".join(b"event: %d \xff\n" % k for k in range(200))


def test_a_terminal_that_is_held_by_ctrl_s_holds_nobody_up():
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    teller, reported = printed_unread(slave)
    assert reported
    teller.close(0.1)
    termios.tcflow(slave, termios.TCOON)
    teller.close(10.0)
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
    teller, reported = printed_unread(pipe[1])
    assert reported
    assert teller.dropped >= 5


def test_a_reader_that_has_gone_is_no_error(pipe):
    os.close(pipe[0])
    teller, reported = printed_unread(pipe[1])
    assert reported
    teller.close()
    assert not teller._thread.is_alive()
