"""Real pseudo-terminals opened with pyserial; time given by the test."""

import os
import stat
import time

import pytest
import serial

from drivers.types import Frame
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from sim import LinkFaultError
from sim.bus import FrameOutcome
from sim.serial_line import SerialLine, SerialPathError
from tests.drivers.waiting import wait_until

MS = 1_000_000
FRAME = Frame(0x110, bytes(range(1, 9)))
BYTES = encode_frame(FRAME.can_id, FRAME.data)
FRAME_NS = len(BYTES) * (10 * 1_000_000_000 // 921_600)


@pytest.fixture
def line(tmp_path):
    line = SerialLine(tmp_path / "tty", 0)
    yield line
    line.close()


def host(line, now_ns=0, baud=921_600):
    port = serial.Serial(line.port, baud, timeout=0.2, exclusive=True)
    line.collect(now_ns)
    return port


def collect(line, now_ns, count=1):
    """Bytes cross a pseudo-terminal through a kernel thread: give it time."""
    wait_until(lambda: line.collect(now_ns) >= count, 30.0)


def read(port, count):
    """So many bytes, as soon as they have come; no more may have come with them."""
    port.timeout = 30.0
    received = port.read(count)
    port.timeout = 0.2
    return received + port.read(port.in_waiting)


def test_only_the_owner_may_open_the_port(tmp_path, line):
    assert os.readlink(tmp_path / "tty") == line.port
    assert stat.S_IMODE(os.stat(line.port).st_mode) == 0o600


def test_a_frame_to_the_robot_takes_its_time(line):
    with host(line) as port:
        port.write(BYTES + BYTES)
        collect(line, 5 * MS, 2)
        assert line.advance(5 * MS) == []
        assert line.next_event_ns() == 5 * MS + FRAME_NS
        assert line.advance(5 * MS + FRAME_NS - 1) == []
        received = line.advance(5 * MS + FRAME_NS) + line.advance(9 * MS)
        assert [(one.t_ns, one.frame) for one in received] == [(5 * MS + n * FRAME_NS, FRAME) for n in (1, 2)]


def test_a_frame_to_the_host_takes_its_time(line):
    with host(line) as port:
        line.advance(5 * MS)
        line.send([FRAME, FRAME])
        line.advance(5 * MS + FRAME_NS - 1)
        assert port.read(1) == b""
        line.advance(5 * MS + FRAME_NS)
        assert read(port, len(BYTES)) == BYTES
        line.advance(5 * MS + 2 * FRAME_NS)
        assert read(port, len(BYTES)) == BYTES
        assert line.next_event_ns() is None


def test_waiting_frames_can_be_let_in_a_few_at_a_time(line):
    with host(line) as port:
        port.write(4 * BYTES)
        collect(line, MS, 4)
        batches = [*(line.advance(step * 10 * MS, admit=1) for step in range(1, 5)), line.advance(50 * MS)]
        times = [[received.t_ns for received in batch] for batch in batches]
        assert times == [[], *([step * 10 * MS + FRAME_NS] for step in range(1, 5))]


def test_opening_and_closing_is_noticed_again_and_again(line):
    for round_ in range(3):
        assert not line.connected
        assert line.filenos() == []
        with host(line) as port:
            assert line.connected
            assert len(line.filenos()) == 1
            line.advance(10 * round_ * MS)
            line.send([FRAME])
            line.advance((10 * round_ + 5) * MS)
            assert read(port, len(BYTES)) == BYTES
        line.collect(10 * round_ * MS)
    assert line.stats.opened == 3


def test_what_a_host_wrote_before_it_closed_arrives(line):
    """An e-stop from a command that opens, writes and closes must not be lost, seen open or not."""
    with serial.Serial(line.port, 921_600) as port:
        port.write(encode_frame(0x080, b"\x01") * 3)
    collect(line, MS, 3)
    assert not line.connected
    assert [received.frame.can_id for received in line.advance(MS) + line.advance(9 * MS)] == [0x080] * 3


@pytest.mark.parametrize("settle_s", [0.0, 0.02])
def test_a_new_host_sees_nothing_of_what_the_last_one_left(line, settle_s):
    with host(line):
        line.advance(MS)
        line.send([FRAME] * 5)
        line.advance(9 * MS)
        line.send([FRAME])
        time.sleep(settle_s)
    line.collect(10 * MS)
    line.advance(20 * MS)
    time.sleep(0.02)
    # Unlike pyserial, this host does not flush its input when it opens the port; read() does not wait (VMIN is 0).
    descriptor = os.open(line.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    assert os.read(descriptor, 100) == b""
    os.close(descriptor)


def test_half_a_frame_of_the_last_host_does_not_spoil_the_next_ones(line):
    with host(line) as port:
        port.write(BYTES[:5])
    line.collect(MS)
    with host(line, MS) as port:
        port.write(BYTES)
        collect(line, MS)
        assert [received.frame for received in line.advance(9 * MS) + line.advance(20 * MS)] == [FRAME]


def test_without_a_host_nothing_is_kept(line):
    line.send([FRAME])
    assert line.next_event_ns() is None
    assert line.stats.frames_out == 0


def test_a_host_that_does_not_read_loses_bytes_and_they_are_counted(line):
    with host(line):
        for ms in range(1, 3001):
            line.collect(ms * MS)
            line.advance(ms * MS)
            line.send([FRAME])
        assert 0 < line.stats.bytes_lost < line.stats.frames_out * len(BYTES)


def test_garbage_is_counted_and_the_frames_after_it_arrive(line):
    with host(line) as port:
        port.write(os.urandom(200).replace(b"\0", b"\x01") + b"\0" + BYTES)
        collect(line, MS)
        assert [received.frame for received in line.advance(MS) + line.advance(9 * MS)] == [FRAME]
        assert "errors=0, crc_errors=0, length_errors=0" not in line.summary()


def test_with_different_baud_rates_only_garbage_arrives(line):
    with host(line, baud=115_200) as port:
        for step in range(1, 21):
            port.write(BYTES)
            line.advance(step * 10 * MS)
            line.send([FRAME])
            line.collect(step * 10 * MS)
        line.advance(900 * MS)
        received = read(port, 20 * len(BYTES))
        wait_until(lambda: line.collect(900 * MS) or line.stats.garbled_bytes == 40 * len(BYTES), 30.0)
        assert FrameDecoder().feed(received) == []
        assert len(received) == 20 * len(BYTES)
        assert line.advance(900 * MS) == []
        assert line.stats.garbled_bytes >= 20 * len(BYTES)


def test_unplugging_takes_the_port_away_and_brings_a_new_one(tmp_path, line):
    port = host(line)
    line.unplug(500 * MS)
    with pytest.raises((serial.SerialException, OSError)):
        port.read(1)
    port.close()
    assert not os.path.lexists(tmp_path / "tty")
    assert line.next_event_ns() == 500 * MS
    line.collect(499 * MS)
    assert not os.path.lexists(tmp_path / "tty")
    line.send([FRAME])
    line.advance(499 * MS)
    line.collect(500 * MS)
    with serial.Serial(str(tmp_path / "tty"), 921_600, timeout=0.2) as again:
        line.collect(501 * MS)
        line.advance(501 * MS)
        line.send([FRAME])
        line.advance(510 * MS)
        assert read(again, len(BYTES)) == BYTES


def test_the_link_replaces_one_of_a_dead_process_and_nothing_else(tmp_path):
    (tmp_path / "tty").symlink_to("/dev/pts/999")
    line = SerialLine(tmp_path / "tty", 0)
    assert os.readlink(tmp_path / "tty") == line.port
    line.close()
    assert not os.path.lexists(tmp_path / "tty")
    (tmp_path / "tty").write_text("precious")
    with pytest.raises(SerialPathError, match="is no link to a port"):
        SerialLine(tmp_path / "tty", 0)
    (tmp_path / "other").symlink_to("/etc/passwd")
    with pytest.raises(SerialPathError, match="links to something else"):
        SerialLine(tmp_path / "other", 0)
    with pytest.raises(SerialPathError, match="cannot be made"):
        SerialLine(tmp_path / "missing" / "tty", 0)


def test_a_link_that_another_has_taken_over_is_left_and_close_may_be_repeated(tmp_path, line):
    (tmp_path / "tty").unlink()
    (tmp_path / "tty").symlink_to("/dev/pts/999")
    line.close()
    line.close()
    assert os.path.lexists(tmp_path / "tty")


def test_faults_of_a_bus_are_refused(line):
    with pytest.raises(LinkFaultError, match="no bus-off"):
        line.force_bus_off("host")
    with pytest.raises(LinkFaultError, match="two ends"):
        line.babble(FRAME)


class FixedOutcome:
    """Does the same to every frame from one side."""

    def __init__(self, sender, **outcome):
        self.sender, self.what = sender, FrameOutcome(**outcome)

    def outcome(self, now_ns, sender, frame):
        return self.what if sender == self.sender else FrameOutcome()


@pytest.mark.parametrize(
    ("outcome", "frames"),
    [
        ({}, 1),
        ({"lost": True}, 0),
        ({"copies": 2}, 2),
        ({"wire_error_bit": 40}, 0),
        ({"wire_error_bit": 40, "cut": True}, 0),
        ({"data": b"other"}, 1),
    ],
)
def test_faults_on_the_way_to_the_host_are_what_the_host_reads(line, outcome, frames):
    line.set_bus_fault(FixedOutcome("robot", **outcome))
    with host(line) as port:
        line.send([FRAME])
        line.advance(MS)
        assert FrameDecoder().feed(port.read(200)) == [(FRAME.can_id, outcome.get("data", FRAME.data))] * frames


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        ({"lost_at": ("robot",)}, []),
        ({"wire_error_bit": 3}, []),
        ({"copies": 2}, [b"abc", b"abc"]),
        ({"data": b"x"}, [b"x"]),
    ],
)
def test_faults_on_the_way_to_the_robot_are_what_the_robot_reads(line, outcome, expected):
    line.set_bus_fault(FixedOutcome("host", **outcome))
    with host(line) as port:
        port.write(encode_frame(0x100, b"abc"))
        collect(line, 2)
        line.advance(3)
        assert [received.frame.data for received in line.advance(MS)] == expected
