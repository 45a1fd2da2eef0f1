"""SLCAN as the controller speaks it in C, against python-can's on the host, and against Lawicel's manual."""

import os
import select
import tty

import can
import pytest
from can.interfaces.slcan import slcanBus
from hypothesis import strategies as st

from tests.firmware_protocol.c_framing import Slcan
from tests.tables import examples

FRAMES = [
    (0x100, bytes.fromhex("8D306902B4FB2C01")),
    (0x7FF, b"\xff" * 8),
    (0x080, b""),
    (0x000, b"\0"),
    (0xABC & 0x7FF, b"\xa5"),
]


def read_until(board_end, end):
    """What python-can has written, to this end: a terminal takes its time."""
    text = b""
    while not text.endswith(end):
        assert select.select([board_end], [], [], 5.0)[0], f"python-can wrote {text!r} and no more"
        text += os.read(board_end, 1000)
    return text


OPENED = b"O\rO\r"


def opened():
    line = Slcan()
    line.feed(b"O\r")
    return line


@pytest.fixture
def host():
    """python-can on a terminal, the board's line, and the end of the terminal that the board has."""
    board_end, host_end = os.openpty()
    tty.setraw(host_end)
    os.set_blocking(board_end, False)
    line = Slcan()
    bus = slcanBus(os.ttyname(host_end), bitrate=500_000, sleep_after_open=0)
    yield bus, line, board_end
    bus.shutdown()
    os.close(board_end)
    os.close(host_end)


def test_python_can_opens_the_channel_and_every_command_is_obeyed(host):
    _bus, line, board_end = host
    assert line.encode(0x100, b"") == b""
    _, replies = line.feed(read_until(board_end, OPENED))
    assert replies == b"\r" * 4
    assert line.line.errors == 0
    assert line.encode(0x100, b"") == b"t1000\r"


@pytest.mark.parametrize(("can_id", "data"), FRAMES)
def test_frames_pass_in_both_directions(host, can_id, data):
    bus, line, board_end = host
    line.feed(read_until(board_end, OPENED))
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
    frames, replies = line.feed(read_until(board_end, b"\r"))
    assert (frames, replies) == ([(can_id, data)], b"\r")
    os.write(board_end, replies + line.encode(can_id, data))
    received = None
    while received is None:
        received = bus.recv(2.0)
    assert (received.arbitration_id, bytes(received.data), received.is_extended_id) == (can_id, data, False)


@examples(quick=60, every=100, can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
def test_the_text_is_lawicels(can_id, data):
    line = opened()
    text = f"t{can_id:03X}{len(data)}{data.hex().upper()}\r".encode()
    assert line.encode(can_id, data) == text
    assert line.feed(text) == ([(can_id, data)], b"\r")
    assert line.feed(text.lower()) == ([(can_id, data)], b"\r")
    assert line.line.frames == 2


@pytest.mark.parametrize(
    "text",
    [b"t", b"t10", b"t1008", b"t100", b"t1009" + b"0" * 18, b"t8000", b"tFFF0", b"t10g0", b"t1001a", b"t1001ag",
     b"t1001aaa", b"t100A", b"X", b"\0", b"t1/00", b"t1:00", b"t1@00", b"t1G00", b"t1`00", b"t1g00",
     b"t" * 28, b"O" * 200],
)  # fmt: skip
def test_nonsense_is_answered_with_a_bell_and_counted(text):
    line = opened()
    assert line.feed(text + b"\r") == ([], b"\a")
    assert (line.line.errors, line.line.frames) == (1, 0)
    assert line.feed(b"t1000\r") == ([(0x100, b"")], b"\r")


@pytest.mark.parametrize(
    ("text", "reply"),
    [(b"V", b"V1013\r"), (b"N", b"NDISC\r"), (b"F", b"F00\r"), (b"S8", b"\r"), (b"s031C", b"\r"), (b"", b""),
     (b"T000001238" + b"0" * 16, b"\r"), (b"r1000", b"\r"), (b"R000001230", b"\r")],
)  # fmt: skip
def test_commands_are_answered(text, reply):
    line = opened()
    assert line.feed(text + b"\r") == ([], reply)
    assert line.line.frames == 0


@pytest.mark.parametrize(
    ("opens", "receives", "speaks"), [(b"C\r", False, False), (b"L\r", True, False), (b"O\r", True, True)]
)
def test_a_channel_that_is_closed_passes_nothing_and_one_that_listens_does_not_speak(opens, receives, speaks):
    line = opened()
    line.feed(opens)
    assert (line.encode(0x100, b"") != b"") == receives
    frame = [(0x100, b"")] if speaks else []
    assert line.feed(b"t1000\r") == (frame, b"\r" if speaks else b"\a")
    for other in (b"T000001230\r", b"r1000\r", b"R000001230\r"):
        assert line.feed(other) == ([], b"\r" if speaks else b"\a")


@examples(quick=60, every=100, pieces=st.lists(st.binary(max_size=60)))
def test_garbage_does_no_harm(pieces):
    line = Slcan()
    for piece in pieces:
        line.feed(piece)
    line.feed(b"\rO\r")
    assert line.feed(b"t1000\r") == ([(0x100, b"")], b"\r")


def test_replies_that_nobody_takes_are_dropped_and_never_run_over():
    line = Slcan()
    frames, replies = line.feed(b"V\r" * 10)
    assert (frames, replies) == ([], b"V1013\r" * 3 + b"\r" * 4)
