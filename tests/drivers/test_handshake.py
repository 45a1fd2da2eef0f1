import itertools

import pytest

from drivers.handshake import Handshake
from firmware_protocol.codec import Decoded

HELLO = {
    "protocol_major": 1,
    "protocol_minor": 3,
    "firmware_major": 2,
    "firmware_minor": 0,
    "firmware_patch": 7,
    "capabilities": 255 - 64,
}
BUILD = {"dbc_hash": 0xCAFE1234, "board_id": 9}
PAGE0 = {"page": 0, "max_wheel_speed": 8.0, "max_wheel_acceleration": 20.0, "ticks_per_rev": 2048}
PAGE1 = {"page": 1, "command_timeout": 0.1, "drive_off_timeout": 0.5, "stop_deceleration": 15.0}
FRAMES = (("HELLO", HELLO), ("BUILD", BUILD), ("LIMITS", PAGE0), ("LIMITS", PAGE1))


def take(handshake, *frames):
    for name, values in frames:
        handshake.take(Decoded(name, 0, 0, values))
    return handshake


@pytest.mark.parametrize("frames", list(itertools.permutations(FRAMES)))
def test_complete_with_the_last_frame_in_any_order(frames):
    handshake = Handshake(1, 0, 0xCAFE1234)
    for frame in frames:
        assert handshake.capabilities is None
        assert handshake.missing
        take(handshake, frame)
    assert handshake.missing == ()
    assert handshake.refusal is None
    capabilities = handshake.capabilities
    assert capabilities.firmware_version == "2.0.7"
    assert capabilities.dbc_hash == 0xCAFE1234
    assert capabilities.ticks_per_rev == 2048
    assert (capabilities.command_timeout_s, capabilities.drive_off_timeout_s) == (0.1, 0.5)
    assert (capabilities.max_wheel_speed_rad_s, capabilities.stop_deceleration_rad_s2) == (8.0, 15.0)


def test_another_major_version_is_refused_at_the_first_frame():
    handshake = take(Handshake(2, 5, 0xCAFE1234), ("HELLO", HELLO))
    assert "the robot speaks protocol 1.3, this host 2.5" in handshake.refusal
    assert "flash" in handshake.refusal


def test_another_hash_may_be_read_but_is_refused():
    handshake = take(Handshake(1, 0, 0x0000BEEF), *FRAMES)
    assert handshake.capabilities is not None
    for words in ("cafe1234", "0000beef", "telemetry only", "flash"):
        assert words in handshake.refusal


def test_a_robot_flashed_meanwhile_is_accepted():
    handshake = take(Handshake(1, 0, 0xBEEF), *FRAMES)
    assert handshake.refusal
    take(handshake, ("BUILD", {**BUILD, "dbc_hash": 0xBEEF}))
    assert handshake.refusal is None


@pytest.mark.parametrize(("page", "name"), [(0, "ticks_per_rev"), (0, "max_wheel_speed"), (1, "command_timeout")])
def test_limits_that_make_no_sense_are_refused(page, name):
    broken = [(kind, {**values, name: 0} if values.get("page") == page else values) for kind, values in FRAMES]
    handshake = take(Handshake(1, 0, 0xCAFE1234), *broken)
    assert handshake.capabilities is None
    assert "make no sense" in handshake.refusal


@pytest.mark.parametrize(
    ("has_key", "bits", "refusal"), [(False, 64, "obeys only who holds"), (True, 63, "takes commands from anybody")]
)
def test_a_key_on_one_end_alone_is_refused_in_words(has_key, bits, refusal):
    frames = [(name, {**values, "capabilities": bits} if name == "HELLO" else values) for name, values in FRAMES]
    handshake = take(Handshake(1, 0, 0xCAFE1234, has_key=has_key), *frames)
    assert refusal in handshake.refusal
    assert "link.key_file" in handshake.refusal
    assert take(Handshake(1, 0, 0xCAFE1234, has_key=not has_key), *frames).refusal is None
