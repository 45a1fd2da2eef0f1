"""An echo is told from another host's frame."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.own_frames import ECHO_NS, OwnFrames
from drivers.types import Frame

A, B = Frame(0x100, b"\1"), Frame(0x100, b"\2")


@pytest.fixture
def own():
    return OwnFrames()


def test_each_frame_sent_excuses_one_that_is_equal(own):
    own.sent(0, A)
    own.sent(0, A)
    assert [own.is_echo(1, A) for _ in range(3)] == [True, True, False]


def test_another_frame_is_no_echo_and_takes_no_excuse(own):
    own.sent(0, A)
    assert not own.is_echo(1, B)
    assert not own.is_echo(1, Frame(0x101, A.data))
    assert own.is_echo(1, A)


def test_an_excuse_ends_after_a_second(own):
    own.sent(0, A)
    own.sent(ECHO_NS, B)
    assert not own.is_echo(ECHO_NS + 1, A)
    assert own.is_echo(2 * ECHO_NS, B)


def test_a_frame_that_was_not_sent_excuses_nothing(own):
    for frame in (A, B, A):
        own.sent(0, frame)
    own.not_sent(A)
    assert [own.is_echo(1, frame) for frame in (A, A, B)] == [True, False, True]
    own.not_sent(B)


@given(st.lists(st.tuples(st.sampled_from([A, B]), st.booleans()), max_size=40))
def test_whoever_else_sends_is_heard_as_often_as_he_sends(events):
    """Echoes and another host's frames of the same contents, in any order: what is not excused is as many as his."""
    own = OwnFrames()
    for frame, is_ours in events:
        if is_ours:
            own.sent(0, frame)
    heard = [frame for frame, _ in events if not own.is_echo(1, frame)]
    strangers = [frame for frame, is_ours in events if not is_ours]
    assert sorted(heard, key=lambda frame: frame.data) == sorted(strangers, key=lambda frame: frame.data)
