"""ODrive's frames: the examples of its documentation, what is refused, and that no frame breaks the decoder."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.motor import odrive_protocol as protocol
from drivers.types import Frame
from tests.tables import examples

V05, V06 = "0.5", "0.6"


def test_a_velocity_is_the_documented_frame():
    frame = protocol.encode(V05, 3, "Set_Input_Vel", vel_turns_s=1.5, torque_nm=0.0)
    assert frame == Frame(0x06D, bytes.fromhex("0000C03F00000000"))


def test_the_frames_of_arming_and_stopping():
    assert protocol.encode(V06, 3, "Set_Controller_Mode", control_mode=2, input_mode=1) == Frame(
        0x06B, bytes.fromhex("0200000001000000")
    )
    assert protocol.encode(V06, 3, "Set_Axis_State", state=8) == Frame(0x067, bytes.fromhex("0800000000000000"))
    assert protocol.encode(V06, 3, "Estop") == Frame(0x062, b"")
    assert protocol.encode(V05, 3, "Clear_Errors") == Frame(0x078, b"")
    assert protocol.encode(V06, 3, "Clear_Errors", identify=0) == Frame(0x078, b"\0")


def test_a_heartbeat_says_other_things_in_each_generation():
    frame = Frame(3 << 5 | 1, struct.pack("<IBBBB", 0x800, 1, 1, 0, 0x80))
    old, new = protocol.decode(V05, frame), protocol.decode(V06, frame)
    assert old is not None
    assert new is not None
    assert (old.node, old.values["axis_error"], old.values["axis_state"]) == (3, 0x800, 1)
    assert (old.values["motor_flags"], old.values["controller_flags"]) == (1, 0x80)
    assert (new.values["procedure_result"], new.values["trajectory_done"]) == (1, 0)


@pytest.mark.parametrize("length", [0, 4, 7])
def test_telemetry_that_is_too_short_is_none(length):
    assert protocol.decode(V05, Frame(3 << 5 | 9, bytes(length))) is None


def test_a_29_bit_frame_is_none_of_ours():
    assert protocol.decode(V05, Frame(3 << 5 | 9, bytes(8), extended=True)) is None


def test_a_node_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="63"):
        protocol.encode(V05, 63, "Estop")


def test_a_parameter_is_read_only_from_the_answer_to_its_own_endpoint():
    assert protocol.read_parameter(3, 0x102) == Frame(0x064, bytes.fromhex("0002010000000000"))
    response = Frame(0x065, bytes.fromhex("00020100") + struct.pack("<f", 0.1))
    assert protocol.parameter(response, 3, 0x102, "f32") == pytest.approx(0.1)
    assert protocol.parameter(response, 3, 0x103, "f32") is None
    assert protocol.parameter(response, 4, 0x102, "f32") is None


@examples(
    quick=40,
    every=100,
    can_id=st.integers(0, 0x7FF),
    data=st.binary(max_size=8),
    generation=st.sampled_from((V05, V06)),
    extended=st.booleans(),
)
def test_no_frame_breaks_the_decoder(can_id, data, generation, extended):
    decoded = protocol.decode(generation, Frame(can_id, data, extended))
    assert decoded is None or (decoded.node == can_id >> 5 and len(data) == 8)


@given(st.floats(width=32, allow_nan=False), st.integers(0, protocol.LARGEST_NODE))
def test_what_a_drive_says_is_read_as_it_was_meant(turns, node):
    decoded = protocol.decode(V05, Frame(node << 5 | 9, struct.pack("<ff", turns, -turns)))
    assert decoded is not None
    assert decoded.values["pos_turns"] == turns
    assert math.copysign(1.0, decoded.values["vel_turns_s"]) == -math.copysign(1.0, turns)
