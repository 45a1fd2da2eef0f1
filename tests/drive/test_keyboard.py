"""The keyboard on a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading

import pytest

from disco_hw.drive import RobotView
from disco_hw.drive.terminal import Keyboard, KeyHold
from disco_hw.errors import InputError
from disco_hw.runtime import State
from tests.daemon.simulated_clock import SimulatedClock
from tests.drivers.waiting import wait_until

MS = 1_000_000
VIEW = RobotView(State.READY, driving=False)


class Terminal:
    """A pseudo-terminal, a keyboard on it, and time that the test moves."""

    def __init__(self):
        self.master, self.slave = os.openpty()
        self.before = termios.tcgetattr(self.slave)
        os.write(self.master, b"w" * 50)
        echoed = b""
        while len(echoed) < 50:
            echoed += os.read(self.master, 100)
        assert echoed == b"w" * 50, "a terminal echoes"
        self.clock = SimulatedClock()
        self.keyboard = Keyboard(self.slave, KeyHold(8.0), self.clock)
        self.poll(1000)

    def poll(self, ms=20):
        """Move time on in steps of 20 ms, polling; the last answer."""
        for _ in range(ms // 20):
            self.clock.advance_ns(20 * MS)
            self.last = self.keyboard.poll(self.clock.now_ns(), VIEW)
        return self.last

    def type(self, keys):
        os.write(self.master, keys)
        self.arrived(len(keys))
        return self.poll()

    def hold(self, key=b"w", repeats=5):
        for _ in range(repeats):
            self.type(key)

    def arrived(self, count):
        """Wait until the reader, which lives in real time, has read so many bytes; 0: the end of the terminal."""
        arrived = self.keyboard._arrived
        wait_until(lambda: arrived and sum(len(data) for _, data in arrived) >= count)

    def close(self):
        self.keyboard.close()
        for descriptor in (self.master, self.slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _readable(descriptor):
    return bool(select.select([descriptor], [], [], 0.1)[0])


@pytest.fixture
def terminal():
    made = Terminal()
    yield made
    made.close()


def test_what_was_typed_before_is_not_for_us(terminal):
    assert not terminal.last.deadman


def test_a_held_arrow_drives_and_its_end_stops(terminal):
    terminal.hold(b"\x1b[A", repeats=10)
    assert terminal.last.deadman
    assert terminal.last.left_rad_s == terminal.last.right_rad_s == pytest.approx(4.0)
    # The last repeat came 20 ms before the poll that took it.
    assert terminal.poll(180).deadman
    assert not terminal.poll(20).deadman


def test_nothing_waits_for_enter_and_nothing_is_echoed(terminal):
    terminal.hold(repeats=2)
    assert terminal.last.deadman
    assert not _readable(terminal.master)


def test_pasted_text_holds_nothing(terminal):
    terminal.type(b"w" * 1000)
    assert not terminal.last.deadman
    assert not terminal.poll(2000).deadman


@pytest.mark.parametrize("lines", [2, 3, 5])
def test_a_mouse_wheel_that_sends_arrows_holds_nothing(terminal, lines):
    for _ in range(20):
        terminal.type(b"\x1bOA" * lines)
        assert not terminal.last.deadman
        assert not terminal.poll(60).deadman


def test_what_a_stalled_connection_delivers_late_holds_nothing(terminal):
    terminal.hold()
    assert not terminal.poll(3000).deadman
    for waited in (1, 2, 4, 8, 16):
        terminal.type(b"w" * waited)
        assert not terminal.last.deadman
    assert not terminal.type(b"w").deadman


def test_two_repeats_that_a_busy_host_reads_at_once_drive_on(terminal):
    terminal.hold()
    for keys in (b"ww", b"w", b"ww"):
        assert terminal.type(keys).deadman


def test_each_read_since_the_last_poll_counts_by_itself(terminal):
    terminal.hold()
    assert terminal.last.deadman
    for keys, total in ((b"w", 1), (b"www", 4), (b"w", 5)):
        os.write(terminal.master, keys)
        terminal.arrived(total)
    assert not terminal.poll().deadman


def test_another_key_among_repeats_stops(terminal):
    terminal.hold()
    assert not terminal.type(b"w?w").deadman


def test_ctrl_d_ends(terminal):
    terminal.hold()
    assert not terminal.type(b"\x04").deadman
    assert terminal.keyboard.ended == "the operator ended the drive at the keyboard"
    assert terminal.keyboard.completed
    os.write(terminal.master, b"w")
    assert not terminal.poll(100).deadman


def test_ctrl_z_stops_the_robot_and_not_the_daemon(terminal):
    assert termios.tcgetattr(terminal.slave)[6][termios.VSUSP] == b"\0"
    terminal.hold()
    assert not terminal.type(b"\x1a").deadman
    assert terminal.keyboard.ended is None


def test_keys_count_from_when_they_came_not_from_when_they_are_polled(terminal):
    terminal.hold()
    os.write(terminal.master, b"w")
    terminal.arrived(1)
    # The loop was held up for 300 ms with a key waiting.
    terminal.clock.advance_ns(300 * MS)
    assert not terminal.poll().deadman


def test_a_terminal_that_closes_is_a_device_that_is_gone(terminal):
    terminal.hold()
    os.close(terminal.master)
    terminal.arrived(0)
    assert terminal.poll() is None
    assert terminal.keyboard.ended == "the terminal was closed"
    assert not terminal.keyboard.completed
    assert terminal.poll() is None


def test_while_keys_are_read_ctrl_c_is_a_signal_and_output_looks_as_before_and_all_is_put_back(terminal):
    now = termios.tcgetattr(terminal.slave)
    assert now != terminal.before
    assert now[3] & termios.ISIG
    assert now[1] == terminal.before[1]
    terminal.keyboard.close()
    assert termios.tcgetattr(terminal.slave) == terminal.before
    assert not [thread for thread in threading.enumerate() if thread.name == "keyboard"]
    terminal.keyboard.close()


def test_what_is_no_terminal_is_refused(tmp_path):
    with (tmp_path / "file").open("w+b") as file, pytest.raises(InputError, match="not a terminal; use"):
        Keyboard(file.fileno(), KeyHold(8.0), SimulatedClock())
