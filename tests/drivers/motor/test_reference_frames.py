import pytest
from hypothesis import strategies as st

from drivers.motor.reference_frames import SLOW_TIMEOUT_NS, TIMEOUT_NS, FrameReception, FrameTransmission
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.codec import PROTOCOL
from tests.drivers.motor.reference_robot import CODEC
from tests.tables import examples

MS = 1_000_000


def received(name, counter=0, t_ns=0, **signals):
    return ReceivedFrame(t_ns, Frame(*CODEC.encode(name, counter, **signals)))


def ticks(counter, t_ns=0):
    return received("WHEEL_TICKS", counter, t_ns, left_ticks=1, right_ticks=2)


def qualified():
    reception = FrameReception(CODEC)
    for counter in range(4):
        reception.accept(ticks(counter))
    return reception


@pytest.fixture
def transmission():
    return FrameTransmission(CODEC)


def test_a_sender_is_believed_after_three_good_frames_in_a_row():
    reception = FrameReception(CODEC)
    believed = [reception.accept(ticks(counter)) is not None for counter in range(5)]
    assert believed == [False, False, False, True, True]
    assert reception.accepted == 2


def test_answers_are_believed_at_once_whatever_their_counter():
    """A controller flashed meanwhile counts from zero again; its answer must not pass for a repetition."""
    reception = FrameReception(CODEC)
    hello = received("BUILD", dbc_hash=1, board_id=2)
    assert reception.accept(hello).values["board_id"] == 2
    assert reception.accept(hello) is not None
    assert reception.rejected_sequence == 0


def test_lost_repeated_and_out_of_sequence():
    reception = qualified()
    assert reception.accept(ticks(6)) is not None
    assert reception.lost == 2
    assert reception.accept(ticks(6)) is None
    assert reception.accept(ticks(12)) is None
    assert reception.rejected_sequence == 2
    assert reception.lost == 7
    assert reception.accept(ticks(13)) is not None


def test_what_is_lost_in_a_long_gap_counts_as_far_as_the_counter_shows_it():
    reception = qualified()
    reception.accept(ticks(9, 2 * TIMEOUT_NS))
    assert reception.lost == 5
    reception.accept(ticks(10, 4 * TIMEOUT_NS))
    assert reception.lost == 5, "a silence in which nothing was sent is no loss"
    reception.reset()
    reception.accept(ticks(3, 4 * TIMEOUT_NS))
    assert reception.lost == 5, "a new link, or another robot, begins anew"


def test_a_damaged_frame_is_counted_and_many_cost_the_trust():
    reception = qualified()
    good = ticks(4)
    damaged = ReceivedFrame(0, Frame(good.frame.can_id, good.frame.data[:-1] + b"\xff"))
    for _ in range(5):
        assert reception.accept(damaged) is None
    assert reception.rejected_crc == 5
    assert [reception.accept(ticks(counter)) is not None for counter in range(4, 8)] == [False, False, True, True]


def test_another_length_or_identifier_or_29_bits_are_counted():
    reception = qualified()
    can_id, data = ticks(4).frame.can_id, ticks(4).frame.data
    for frame in (Frame(can_id, data[:7]), Frame(0x7FF, bytes(8)), Frame(can_id, data, extended=True)):
        assert reception.accept(ReceivedFrame(0, frame)) is None
    assert (reception.rejected_length, reception.unknown_id, reception.accepted) == (1, 2, 1)


def test_what_only_a_host_sends_betrays_another_host():
    reception = FrameReception(CODEC)
    assert reception.foreign is None
    assert reception.accept(received("TIME_REQUEST", sequence=1)) is None
    assert reception.foreign == "TIME_REQUEST"
    assert reception.unknown_id == 1
    reception.reset()
    assert reception.foreign is None


def test_an_estop_from_outside_betrays_nobody():
    """Anybody may stop the robot, as `disco-hw estop` does beside the daemon."""
    reception = FrameReception(CODEC)
    assert reception.accept(ReceivedFrame(7, Frame(CODEC.can_id("ESTOP"), b""))) is None
    assert reception.outside_stop_ns == 7
    assert (reception.foreign, reception.unknown_id) == (None, 0)
    reception.reset()
    assert reception.outside_stop_ns is None


def test_trust_ends_with_silence_and_at_a_new_link():
    reception = qualified()
    assert reception.accept(ticks(4, TIMEOUT_NS)) is not None
    assert reception.accept(ticks(5, 2 * TIMEOUT_NS + 1)) is None
    reception = qualified()
    reception.reset()
    assert reception.accept(ticks(4)) is None


def test_slow_messages_may_be_silent_for_longer():
    reception = FrameReception(CODEC)
    values = {"voltage": 24.0, "current": 1.0, "temperature": 20}
    frames = [received("POWER", n, n * SLOW_TIMEOUT_NS // 2, **values) for n in range(4)]
    assert [reception.accept(frame) is not None for frame in frames] == [False, False, False, True]


def test_poses_may_come_at_one_a_second():
    reception = FrameReception(CODEC)
    values = {"yaw": 0.5, "position_std": 0.02, "yaw_std": 0.02, "sample_time": 0.0, "valid": 1}
    poses = {"POSE_POSITION": {"x": 1.0, "y": 2.0, "valid": 1}, "POSE_HEADING": values}
    for name, signals in poses.items():
        frames = [received(name, n, n * 1000 * MS, **signals) for n in range(5)]
        assert [reception.accept(frame) is not None for frame in frames] == [False, False, False, True, True]


@examples(
    quick=40,
    every=100,
    frames=st.lists(
        st.tuples(
            st.one_of(st.integers(0, 0x7FF), st.sampled_from([layout.can_id for layout in PROTOCOL.messages])),
            st.binary(max_size=64),
        ),
        max_size=30,
    ),
)
def test_nothing_that_arrives_makes_it_raise_and_everything_is_counted(frames):
    reception = FrameReception(CODEC)
    for can_id, data in frames:
        reception.accept(ReceivedFrame(0, Frame(can_id, data)))
    counted = reception.rejected_crc + reception.rejected_length + reception.unknown_id
    assert counted + reception.rejected_sequence + reception.accepted <= len(frames)
    assert counted >= sum(can_id not in {layout.can_id for layout in PROTOCOL.messages} for can_id, _ in frames)


COMMAND = {"mode": "SPEED", "left_speed": 1.0, "right_speed": -1.0, "valid_for": 0.1, "session": 5}


def test_counters_count_per_message_and_wrap(transmission):
    counters = []
    for number in range(18):
        frame = transmission.frame("WHEEL_COMMAND", number, 7, **COMMAND)
        assert frame.deadline_ns == number + 7
        counters.append(CODEC.decode(frame.frame.can_id, frame.frame.data).counter)
        transmission.frame("TIME_REQUEST", number, 7, sequence=0)
    assert counters == [number % 16 for number in range(18)]


def test_a_frame_that_could_not_be_made_uses_no_counter(transmission):
    with pytest.raises(ValueError, match="left_speed"):
        transmission.frame("WHEEL_COMMAND", 0, 7, **{**COMMAND, "left_speed": 100.0})
    frame = transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND)
    assert CODEC.decode(frame.frame.can_id, frame.frame.data).counter == 0


def test_due_after_a_period_or_when_forgotten(transmission):
    assert transmission.due("TIME_REQUEST", 100, 50)
    transmission.frame("TIME_REQUEST", 100, 7, sequence=0)
    assert not transmission.due("TIME_REQUEST", 149, 50)
    assert transmission.due("TIME_REQUEST", 150, 50)
    transmission.clear()
    assert transmission.due("TIME_REQUEST", 101, 50)


def outgoing_ids(frames):
    return [outgoing.frame.can_id for outgoing in frames]


def test_with_a_key_a_proof_goes_before_each_frame_that_needs_one_with_the_same_deadline():
    transmission = FrameTransmission(CODEC, bytes(16))
    command = transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND)
    frames = [command, transmission.frame("TIME_REQUEST", 0, 9, sequence=0)]
    assert outgoing_ids(transmission.proved(frames)) == [0x150], "nothing unproved before the robot's nonce is known"
    transmission.challenge(5)
    proved = transmission.proved(frames)
    assert outgoing_ids(proved) == [0x0F0, 0x100, 0x150]
    assert [outgoing.deadline_ns for outgoing in proved] == [7, 7, 9]
    transmission.clear()
    assert outgoing_ids(transmission.proved(frames)) == [0x150]


def test_without_a_key_frames_stay_as_they_are(transmission):
    frames = (transmission.frame("WHEEL_COMMAND", 0, 7, **COMMAND),)
    transmission.challenge(5)
    assert transmission.proved(frames) == frames
