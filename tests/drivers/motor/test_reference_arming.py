import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.motor.reference_arming import ARMING_TIMEOUT_NS, SESSION_REFUSED_AFTER_NS, Arming, Handshake
from drivers.types import Request
from firmware_protocol import protection
from firmware_protocol.codec import Decoded

HASH = 0xCAFE1234


def arming(draw=None):
    return Arming(HASH, draw or itertools.count(10).__next__)


def report(arming, state, session=None, stop_cause="NONE", reject_reason="NONE"):
    arming.handle_status(state, arming.session if session is None else session, stop_cause, reject_reason)


def at_standby(request=None):
    """An arming whose robot is in standby; with a request, one that has also begun on that."""
    one = arming()
    report(one, "STANDBY", 0)
    if request is not None:
        one.request(request)
        one.step(0)
    return one


def armed():
    """An arming that has gone all the way."""
    one = at_standby(Request.ARM)
    report(one, "READY")
    one.handle_session(0x1234, one.session, (), 0)
    report(one, "ARMED")
    assert one.armed
    return one


def test_the_way_up_step_by_step_and_that_it_lasts():
    one = at_standby()
    assert one.host_state().request == "STANDBY"
    assert one.session == 0, "no session before one is wanted"
    one.request(Request.ARM)
    one.step(0)
    assert (one.host_state().request, one.host_state().session) == ("READY", one.session)
    assert one.session != 0
    assert not one.needs_zeros
    report(one, "READY")
    assert one.host_state().request == "READY", "no ARM without an answer to the challenge"
    one.handle_session(0x1234, one.session, ("CHALLENGE", "ZERO_COMMANDS"), 0)
    assert one.host_state().request == "ARM"
    assert one.host_state().challenge_answer == protection.challenge_answer(0x1234, one.session, HASH)
    assert one.needs_zeros
    assert not one.armed
    report(one, "ARMED")
    one.step(100 * ARMING_TIMEOUT_NS)
    assert one.armed
    assert not one.needs_zeros


def test_ready_alone_opens_a_session_and_asks_for_no_more():
    one = at_standby(Request.READY)
    assert one.host_state().request == "READY"
    assert not one.ready
    report(one, "READY", one.session + 1)
    assert not one.ready, "that session is another host's"
    report(one, "READY")
    assert one.ready
    one.handle_session(0x1234, one.session, (), 0)
    one.step(10 * ARMING_TIMEOUT_NS)
    assert one.host_state().request == "READY"
    assert not one.needs_zeros
    one.request(Request.STANDBY)
    assert not one.ready
    one.request(Request.READY)
    assert one.host_state().request == "STANDBY", "a session given up is closed first"


def test_no_session_is_no_session_of_ours():
    one = arming()
    one.request(Request.ARM)
    for state in ("READY", "ARMED"):
        report(one, state, 0)
        assert not one.armed
        assert not one.needs_zeros


def test_a_stopping_robot_that_still_shows_our_session_has_closed_it():
    one = armed()
    report(one, "STOPPING", one.session)
    assert one.session == 0


def test_a_challenge_of_another_session_is_not_answered():
    one = at_standby(Request.ARM)
    one.handle_session(0x1234, one.session + 1, (), 0)
    report(one, "READY")
    assert one.host_state().request == "READY"


@pytest.mark.parametrize("request_", [Request.STANDBY, Request.READY, Request.RESET])
def test_asking_for_less_ends_the_session_at_once(request_):
    one = armed()
    spent = one.session
    one.request(request_)
    assert not one.armed
    assert one.host_state().request == "STANDBY"
    assert one.host_state().session == spent, "so that the robot's stop cause is the request, not a changed session"
    one.request(Request.ARM)
    assert not one.armed, "the old session cannot be taken up again"
    assert one.host_state().request == "STANDBY"
    report(one, "STOPPING", 0)
    report(one, "STANDBY", 0)
    one.step(0)
    assert one.session not in (0, spent)
    assert one.host_state().request == "READY"


@pytest.mark.parametrize("state", ["STOPPING", "STANDBY", "FAULT", "ESTOP", "BOOT", "READY"])
def test_arm_is_consumed_when_the_robot_leaves_armed(state):
    one = armed()
    report(one, state, 0, stop_cause="COMMAND_TIMEOUT")
    assert one.target is Request.STANDBY
    assert "no wheel command arrived in time" in one.note
    for later in ("STANDBY", "READY", "ARMED"):
        report(one, later, 0, stop_cause="ESTOP")
        assert "no wheel command arrived in time" in one.note
        one.step(0)
        assert one.host_state().request == "STANDBY"
        assert not one.armed
        assert not one.needs_zeros


def test_arm_is_consumed_when_the_link_or_robot_is_another_one():
    one = armed()
    one.reset("the link was lost")
    assert one.target is Request.STANDBY
    assert one.session == 0
    assert one.note == "disarmed: the link was lost"
    report(one, "ARMED", 17)
    assert not one.armed
    report(one, "STANDBY", 0)
    assert one.host_state().request == "STANDBY"


def test_no_session_before_the_robot_has_been_heard_again():
    one = at_standby(Request.READY)
    report(one, "READY")
    one.reset("the link was lost")
    assert one.note == "", "nothing was taken away from anybody"
    one.request(Request.READY)
    one.step(0)
    assert one.session == 0
    report(one, "STANDBY", 0)
    one.step(0)
    assert one.session != 0


def test_a_robot_armed_in_another_session_is_not_ours():
    one = arming()
    report(one, "ARMED", 99)
    one.request(Request.ARM)
    one.step(0)
    assert not one.armed
    assert one.host_state().session == 0


def test_arming_that_takes_too_long_is_given_up_with_the_robots_reason():
    one = at_standby()
    one.note = "of an earlier attempt"
    one.request(Request.ARM)
    assert one.note == ""
    start_ns = 10**15
    one.step(start_ns)
    report(one, "READY", reject_reason="CHALLENGE")
    one.handle_session(1, one.session, ("CHALLENGE", "WHEELS_MOVING"), start_ns)
    one.step(start_ns + ARMING_TIMEOUT_NS)
    assert one.target is Request.ARM
    one.step(start_ns + ARMING_TIMEOUT_NS + 1)
    assert one.target is Request.STANDBY
    for fragment in (
        "the robot did not arm within 1.5 s",
        "challenge is not answered",
        "wheels are turning",
        "was wrong",
    ):
        assert fragment in one.note
    report(one, "ARMED")
    assert not one.armed, "an arming that comes too late is not taken"
    assert one.host_state().request == "STANDBY"
    one.request(Request.ARM)
    assert not one.armed
    assert one.host_state().request == "STANDBY", "its session is spent"


def test_a_new_request_to_arm_has_all_the_time_again():
    one = at_standby(Request.ARM)
    one.request(Request.READY)
    one.request(Request.ARM)
    one.step(10 * ARMING_TIMEOUT_NS)
    assert one.target is Request.ARM
    one.step(11 * ARMING_TIMEOUT_NS + 1)
    assert one.target is Request.STANDBY
    assert "the robot gave no reason" in one.note


@pytest.mark.parametrize("state", ["FAULT", "ESTOP"])
def test_arm_is_consumed_by_a_latch_and_reset_is_held_until_the_robot_has_left_it(state):
    one = at_standby()
    one.request(Request.ARM)
    report(one, state, 0)
    assert one.target is Request.STANDBY
    one.note = "not arming: the robot has a fault"
    one.request(Request.RESET)
    report(one, state, 0)
    assert one.host_state().request == "RESET"
    report(one, "STANDBY", 0)
    assert one.target is Request.STANDBY
    assert one.note == "", "what was said of the fault is over"
    report(one, state, 0)
    assert one.host_state().request == "STANDBY", "a later stop is not reset by an earlier request"


@given(st.lists(st.integers(0, 2**64), min_size=1, max_size=40), st.integers(0, 255))
def test_a_session_is_never_zero_nor_the_last_nor_the_robots(draws, foreign):
    one = arming(itertools.cycle(draws).__next__)
    last = 0
    for _ in range(20):
        report(one, "READY", foreign)
        one.request(Request.READY)
        one.step(0)
        assert 1 <= one.session <= 255
        assert one.session not in (last, foreign)
        last = one.session
        one.reset("")


def test_a_session_that_the_robot_has_had_before_is_replaced():
    one = at_standby()
    one.request(Request.READY)
    start_ns = 10**15
    one.step(start_ns)
    refused = one.session
    one.handle_session(1, 0, ("SESSION",), start_ns + SESSION_REFUSED_AFTER_NS)
    assert one.session == refused
    later_ns = start_ns + SESSION_REFUSED_AFTER_NS + 1
    one.handle_session(1, 0, ("CHALLENGE",), later_ns)
    assert one.session == refused
    one.handle_session(1, 0, ("SESSION",), later_ns)
    one.step(later_ns)
    assert one.session not in (0, refused)
    report(one, "READY")
    one.handle_session(1, one.session, ("SESSION",), 2 * later_ns)
    assert one.ready, "open sessions are not refused"


def test_a_ready_session_serves_the_arming_that_follows():
    one = at_standby(Request.READY)
    report(one, "READY")
    assert one.ready
    session = one.session
    one.request(Request.READY)
    one.request(Request.ARM)
    one.step(0)
    assert one.session == session
    assert one.needs_zeros


HELLO = {
    "protocol_major": 1,
    "protocol_minor": 3,
    "firmware_major": 2,
    "firmware_minor": 0,
    "firmware_patch": 7,
    "capabilities": 255 - 64,
}
BUILD = {"dbc_hash": HASH, "board_id": 9}
PAGE0 = {"page": 0, "max_wheel_speed": 8.0, "max_wheel_acceleration": 20.0, "ticks_per_rev": 2048}
PAGE1 = {"page": 1, "command_timeout": 0.1, "drive_off_timeout": 0.5, "stop_deceleration": 15.0}
FRAMES = (("HELLO", HELLO), ("BUILD", BUILD), ("LIMITS", PAGE0), ("LIMITS", PAGE1))


def handshake_after(*frames, host=(1, 0, HASH), has_key=False):
    """A handshake of a host with this protocol and DBC, after these frames of the robot."""
    handshake = Handshake(*host, has_key=has_key)
    for name, values in frames:
        handshake.handle(Decoded(name, 0, 0, values))
    return handshake


def changed_frames(frame, **values):
    """The robot's frames, with other values in those of this name, or of this page of the limits."""
    return [(name, {**had, **values} if frame in (name, had.get("page")) else had) for name, had in FRAMES]


@pytest.mark.parametrize("frames", list(itertools.permutations(FRAMES)))
def test_complete_with_the_last_frame_in_any_order(frames):
    for count in range(len(FRAMES)):
        handshake = handshake_after(*frames[:count])
        assert handshake.identity is handshake.limits is None
        assert handshake.missing
    handshake = handshake_after(*frames)
    assert handshake.missing == ()
    assert handshake.refusal is None
    identity, limits = handshake.identity, handshake.limits
    assert (identity.firmware, identity.said_by) == ("2.0.7", "device")
    assert identity.details == "board 9, protocol 1.3, DBC cafe1234"
    assert {limit.said_by for limit in limits.known().values()} == {"device"}
    assert limits.ticks_per_rev.value == 2048
    assert (limits.command_timeout_s.value, limits.drive_off_timeout_s.value) == (0.1, 0.5)
    assert (limits.max_wheel_speed_rad_s.value, limits.stop_deceleration_rad_s2.value) == (8.0, 15.0)


def test_another_major_version_is_refused_at_the_first_frame():
    handshake = handshake_after(("HELLO", HELLO), host=(2, 5, HASH))
    assert "the robot speaks protocol 1.3, this host 2.5" in handshake.refusal
    assert "flash" in handshake.refusal


def test_another_hash_may_be_read_but_is_refused_until_the_robot_is_flashed():
    frames = changed_frames("BUILD", dbc_hash=0xBEEF)
    handshake = handshake_after(*frames)
    assert handshake.limits is not None
    for fragment in ("cafe1234", "0000beef", "can be read but not driven", "flash"):
        assert fragment in handshake.refusal
    assert handshake_after(*frames, ("BUILD", BUILD)).refusal is None


@pytest.mark.parametrize(("page", "name"), [(0, "ticks_per_rev"), (0, "max_wheel_speed"), (1, "command_timeout")])
def test_limits_that_make_no_sense_are_refused(page, name):
    handshake = handshake_after(*changed_frames(page, **{name: 0}))
    assert handshake.identity is handshake.limits is None
    assert "that are not above zero" in handshake.refusal


@pytest.mark.parametrize(
    ("has_key", "bits", "refusal"),
    [(False, 64, "accepts authenticated commands only"), (True, 63, "accepts commands without authentication")],
)
def test_a_key_on_one_end_alone_is_refused_in_words(has_key, bits, refusal):
    frames = changed_frames("HELLO", capabilities=bits)
    handshake = handshake_after(*frames, has_key=has_key)
    assert refusal in handshake.refusal
    assert "link.key_file" in handshake.refusal
    assert handshake_after(*frames, has_key=not has_key).refusal is None
