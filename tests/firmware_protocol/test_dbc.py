import re

import pytest

from firmware_protocol.codec import PROTOCOL, packaged_dbc
from tools.generate.protocol import dbc_hash, load_protocol

TEXT = packaged_dbc()


def test_comments_and_white_space_do_not_change_the_hash():
    reformatted = re.sub(r"^ SG_ (\w+) : ", r"\tSG_  \1  :   ", TEXT, flags=re.MULTILINE).replace("\n", "\r\n\r\n")
    commented = TEXT.replace('CM_ "Wire', 'CM_ "With ; and CM_ and \\" in it; Wire', 1)
    assert dbc_hash(reformatted) == dbc_hash(commented) == dbc_hash(TEXT)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("SG_ left_speed : 16|16@1- (0.002,0)", "SG_ left_speed : 16|16@1- (0.001,0)"),
        ("SG_ session : 56|8", "SG_ session_id : 56|8"),
        ("BO_ 256 WHEEL_COMMAND", "BO_ 260 WHEEL_COMMAND"),
        ('3 "COAST"', '3 "FREE"'),
        ('4097 "UNDER_VOLTAGE"', '4099 "UNDER_VOLTAGE"'),
        ('BA_ "ProtocolMajor" 1', 'BA_ "ProtocolMajor" 2'),
    ],
)
def test_what_matters_on_the_wire_changes_the_hash(old, new):
    changed = TEXT.replace(old, new, 1)
    assert changed != TEXT
    assert dbc_hash(changed) != dbc_hash(TEXT)


def test_major_version_enters_every_data_id_but_the_handshakes():
    other = load_protocol(TEXT.replace('BA_ "ProtocolMajor" 1', 'BA_ "ProtocolMajor" 2'))
    ours = load_protocol(TEXT)
    equal = {a.name for a, b in zip(ours.messages, other.messages, strict=True) if a.data_id == b.data_id}
    proofs = {"WHEEL_COMMAND_MAC", "HOST_STATE_MAC", "PARAM_REQUEST_MAC"}
    assert equal == {"ESTOP", "HELLO_REQUEST", "HELLO"} | proofs


@pytest.mark.parametrize(
    ("old", "new"),
    [("SG_ sequence : 16|8@1+", "SG_ sequence : 23|8@0+"), ('(0.01,0) [0|655.35] "V"', '(0.01,5) [0|655.35] "V"')],
)
def test_layouts_that_the_codec_does_not_speak_are_refused(old, new):
    assert old in TEXT
    with pytest.raises(ValueError, match="only little-endian signals without offset"):
        load_protocol(TEXT.replace(old, new))


def test_a_dbc_without_version_is_refused():
    with pytest.raises(ValueError, match="no attributes ProtocolMajor"):
        load_protocol('VERSION ""')


def test_tables_say_what_the_file_says():
    protocol = load_protocol(TEXT)
    command = next(message for message in protocol.messages if message.name == "WHEEL_COMMAND")
    signal = next(signal for signal in command.signals if signal.name == "left_speed")
    assert (command.can_id, command.length, command.sender) == (0x100, 8, "HOST")
    assert (signal.shift, signal.width, signal.signed, signal.scale, signal.unit) == (16, 16, True, 0.002, "rad/s")
    limits = next(message for message in protocol.messages if message.name == "LIMITS")
    assert limits.page_signal == "page"
    assert {signal.name: signal.page for signal in limits.signals}["stop_deceleration"] == 1


def test_every_signal_has_a_unit_or_a_table_or_is_a_plain_number():
    """Guards against the scale and unit mistakes that a bare number invites."""
    for message in load_protocol(TEXT).messages:
        for signal in message.signals:
            assert signal.unit or signal.scale == 1, f"{message.name}.{signal.name}"


def test_the_written_tables_are_those_of_the_packaged_dbc():
    assert load_protocol(TEXT) == PROTOCOL
