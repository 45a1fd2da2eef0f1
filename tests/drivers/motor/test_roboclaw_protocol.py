"""RoboClaw's bytes: computed examples, what belongs to which question, and that no reply breaks the decoder."""

import pytest
from hypothesis import strategies as st

from drivers.motor import roboclaw_protocol as protocol
from tests.tables import examples


def test_a_command_of_both_speeds():
    sent = protocol.setting(0x80, "speed_m1m2", speed_m1_counts_s=1000, speed_m2_counts_s=-1000).data
    assert sent.hex() == "8025000003e8fffffc188290"


def test_a_value_is_held_to_what_the_wire_can_say():
    assert protocol.setting(0x80, "duty_m1m2", duty_m1=40000, duty_m2=-40000).data[2:6].hex() == "7fff8000"


def test_an_answer_is_read_with_its_sign():
    received = bytes.fromhex("00000001fffffffffb04")
    assert protocol.query(0x80, "encoders").data == b"\x80\x4e"
    assert protocol.reply(0x80, "encoders", received) == ({"encoder_m1": 1, "encoder_m2": -1}, 10)


@pytest.mark.parametrize(("address", "name"), [(0x81, "encoders"), (0x80, "speeds")])
def test_an_answer_of_another_board_or_to_another_question_is_none(address, name):
    assert protocol.reply(address, name, bytes.fromhex("00000001fffffffffb04")) is None


def test_an_answer_that_is_not_whole_is_none_yet():
    received = bytes.fromhex("00000001fffffffffb04")
    assert [protocol.reply(0x80, "encoders", received[:n]) for n in range(10)] == [None] * 10


def test_the_status_may_have_two_bytes():
    head = b"\x80\x5a"
    older = protocol.with_crc(head + b"\x40\x01")[2:]
    newer = protocol.with_crc(head + b"\0\0\x40\x01")[2:]
    assert protocol.reply(0x80, "status", older) == ({"status_u32": 0x4001}, 4)
    assert protocol.reply(0x80, "status", newer) == ({"status_u32": 0x4001}, 6)


def test_an_address_that_no_board_has_is_refused():
    with pytest.raises(ValueError, match="0x7f"):
        protocol.query(0x7F, "status")


@examples(quick=40, every=100, received=st.binary(max_size=60), name=st.sampled_from(sorted(protocol.GETTERS)))
def test_no_reply_breaks_the_decoder(received, name):
    read = protocol.reply(0x80, name, received)
    assert read is None or read[1] <= len(received)
