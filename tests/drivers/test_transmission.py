import pytest

from drivers.transmission import FrameTransmission
from firmware_protocol.codec import Codec

COMMAND = {"mode": "SPEED", "left_speed": 1.0, "right_speed": -1.0, "valid_for": 0.1, "session": 5}


def test_counters_count_per_message_and_wrap():
    codec = Codec()
    transmission = FrameTransmission(codec)
    counters = []
    for number in range(18):
        frame = transmission.frame("WHEEL_COMMAND", number, 7, **COMMAND)
        assert frame.deadline_ns == number + 7
        counters.append(codec.decode(frame.frame.can_id, frame.frame.data).counter)
        transmission.frame("TIME_REQUEST", number, 7, sequence=0)
    assert counters == [number % 16 for number in range(18)]


def test_a_frame_that_could_not_be_made_uses_no_counter():
    codec = Codec()
    transmission = FrameTransmission(codec)
    with pytest.raises(ValueError, match="left_speed"):
        transmission.frame("WHEEL_COMMAND", 0, 7, **{**COMMAND, "left_speed": 100.0})
    frame = transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND)
    assert codec.decode(frame.frame.can_id, frame.frame.data).counter == 0


def test_due_after_a_period_or_when_forgotten():
    transmission = FrameTransmission(Codec())
    assert transmission.due("TIME_REQUEST", 100, 50)
    transmission.frame("TIME_REQUEST", 100, 7, sequence=0)
    assert not transmission.due("TIME_REQUEST", 149, 50)
    assert transmission.due("TIME_REQUEST", 150, 50)
    transmission.forget()
    assert transmission.due("TIME_REQUEST", 101, 50)


def outgoing_ids(frames):
    return [outgoing.frame.can_id for outgoing in frames]


def test_with_a_key_a_proof_goes_before_each_frame_that_needs_one_with_the_same_deadline():
    transmission = FrameTransmission(Codec(), bytes(16))
    frames = [
        transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND),
        transmission.frame("TIME_REQUEST", 0, 9, sequence=0),
    ]
    assert outgoing_ids(transmission.proved(frames)) == [0x150], "nothing unproved before the robot's nonce is known"
    transmission.challenge(5)
    proved = transmission.proved(frames)
    assert outgoing_ids(proved) == [0x0F0, 0x100, 0x150]
    assert [outgoing.deadline_ns for outgoing in proved] == [7, 7, 9]
    transmission.forget()
    assert outgoing_ids(transmission.proved(frames)) == [0x150]


def test_without_a_key_frames_stay_as_they_are():
    transmission = FrameTransmission(Codec())
    frames = (transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND),)
    transmission.challenge(5)
    assert transmission.proved(frames) == frames
