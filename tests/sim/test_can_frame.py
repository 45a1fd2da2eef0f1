import can
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame
from hypothesis import given
from hypothesis import strategies as st

from sim.can_frame import (
    CanFrame,
    bus_off_frame,
    candump_line,
    controller_error_frame,
    pack_frame,
    receive_overflow_frame,
    unpack_frame,
)


@st.composite
def frames(draw):
    extended = draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    if draw(st.booleans()):
        return CanFrame(can_id, b"", extended, remote=True, remote_length=draw(st.integers(0, 8)))
    return CanFrame(can_id, draw(st.binary(max_size=8)), extended)


@given(frames())
def test_bytes_are_those_of_socketcan(frame):
    message = can.Message(
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        data=None if frame.remote else frame.data,
        dlc=frame.remote_length if frame.remote else len(frame.data),
    )
    expected = bytearray(build_can_frame(message))
    expected[7] = 0  # python-can writes the length again into a field that means "9 to 15" only
    packed = pack_frame(frame)
    assert packed == bytes(expected)
    assert unpack_frame(packed) == frame


@pytest.mark.parametrize("make", [bus_off_frame, receive_overflow_frame, lambda: controller_error_frame(130, 7, 0x20)])
def test_error_frames_survive_the_bytes(make):
    frame = make()
    can_id, length, _, data = dissect_can_frame(pack_frame(frame))
    assert can_id == 0x20000000 | frame.can_id
    assert length == 8
    assert data == frame.data
    assert unpack_frame(pack_frame(frame)) == frame


def test_controller_error_frame_carries_the_counters():
    frame = controller_error_frame(300, 7, 0x20)
    assert frame.can_id == 0x204
    assert frame.data == bytes((0, 0x20, 0, 0, 0, 0, 255, 7))


@given(st.binary(max_size=40))
def test_any_bytes_are_a_frame_or_none(packet):
    frame = unpack_frame(packet)
    assert frame is None or (len(packet) == 16 and len(frame.data) <= 8)


def test_length_beyond_eight_is_no_frame():
    assert unpack_frame(bytes((1, 0, 0, 0, 9)) + bytes(11)) is None


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x800),
        CanFrame(-1),
        CanFrame(0x20000000, extended=True),
        CanFrame(1, bytes(9)),
        CanFrame(1, remote=True, remote_length=9),
    ],
)
def test_what_does_not_fit_is_refused(frame):
    with pytest.raises(ValueError, match="not a classic CAN frame"):
        pack_frame(frame)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (CanFrame(0x110, bytes.fromhex("8d300102")), "110#8D300102"),
        (CanFrame(0x5, b""), "005#"),
        (CanFrame(0x5, b"\x01", extended=True), "00000005#01"),
        (CanFrame(0x123, remote=True, remote_length=4), "123#R4"),
        (bus_off_frame(), "20000040#0000000000000000"),
    ],
)
def test_candump_line(frame, text):
    assert candump_line(1_000_270_999, "can0", frame) == f"(1.000270) can0 {text}"


def test_candump_line_is_read_by_python_can(tmp_path):
    path = tmp_path / "bus.log"
    frame = CanFrame(0x110, bytes(range(8)))
    path.write_text(candump_line(2_500_000_000, "can0", frame) + "\n")
    (message,) = can.LogReader(path)
    assert (message.timestamp, message.channel) == (2.5, "can0")
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x110, frame.data, False)
