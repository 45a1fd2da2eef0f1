"""AgileX's frames: those of the manual, what is refused, and that no frame breaks the decoder."""

import pytest
from hypothesis import strategies as st

from drivers.motor import agilex_protocol as protocol
from drivers.motor import create_driver
from drivers.types import Frame, ReceivedFrame
from tests.tables import examples

SETTINGS = protocol.AgilexSettings(wheel_radius_m=0.06, track_m=0.31, max_speed_m_s=1.5)


def test_a_motion_command_is_in_thousandths():
    assert protocol.motion(0.15, -0.2) == Frame(0x111, bytes.fromhex("0096ff3800000000"))


def test_a_motion_command_is_held_to_what_the_wire_can_say():
    assert protocol.motion(40.0, -40.0).data.hex() == "7fff800000000000"


def test_the_mode_is_asked_for_with_eight_bytes():
    assert protocol.control_mode(protocol.CAN_MODE) == Frame(0x421, b"\1" + bytes(7))


def test_the_state_and_the_odometry_are_read():
    state = protocol.decode(Frame(0x211, bytes.fromhex("010301080004002a")))
    assert state is not None
    assert state.values == {
        "vehicle_state": protocol.EMERGENCY_STOP,
        "control_mode": protocol.RC_MODE,
        "battery_v": pytest.approx(26.4),
        "error_code": 4,
    }
    odometry = protocol.decode(Frame(0x311, bytes.fromhex("01000001ffffffff")))
    assert odometry is not None
    assert odometry.values == {"left_mm": 2**24 + 1, "right_mm": -1}


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (Frame(0x254, bytes(8)), "frames_accepted"),
        (Frame(0x362, bytes(8)), "frames_accepted"),
        (Frame(0x254, bytes(7)), "rejected_length"),
        (Frame(0x211, bytes(7)), "rejected_length"),
        (Frame(0x259, bytes(8)), "unknown_id"),
        (Frame(0x254, bytes(8), extended=True), "unknown_id"),
    ],
)
def test_messages_without_a_use_are_known_all_the_same(frame, expected):
    driver = create_driver("agilex", SETTINGS)
    driver.link_up(0)
    driver.receive(0, [ReceivedFrame(0, frame)])
    assert getattr(driver.stats, expected) == 1


@pytest.mark.parametrize("can_id", [0x211, 0x221, 0x311])
def test_a_short_frame_is_none(can_id):
    assert protocol.decode(Frame(can_id, bytes(7))) is None


def test_a_29_bit_frame_is_none():
    assert protocol.decode(Frame(0x211, bytes(8), extended=True)) is None


@examples(quick=40, every=100, can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8), extended=st.booleans())
def test_no_frame_breaks_the_decoder(can_id, data, extended):
    protocol.decode(Frame(can_id, data, extended))
