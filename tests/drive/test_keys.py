"""Keys of a terminal: bytes to keys, and what counts as held."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.drive.terminal import DIRECTIONS, KeyHold, parse, wheel_speeds

MS = 1_000_000
UP, LEFT = b"\x1b[A", b"\x1b[D"


class Typist:
    """A hold and a clock; `hold` is a key held on a terminal with this delay before it repeats at 30 Hz."""

    def __init__(self, top_rad_s=8.0):
        self.keys = KeyHold(top_rad_s)
        self.now_ns = 0
        self.keys.at(0)
        self.wait(1000)

    def wait(self, ms):
        seen = []
        for _ in range(ms // 10):
            self.now_ns += 10 * MS
            seen.append(self.keys.at(self.now_ns))
        return seen

    def press(self, key):
        self.keys.press(self.now_ns, key)

    def hold(self, key, ms, delay_ms=180):
        self.press(key)
        seen = self.wait(min(ms, delay_ms))
        spent = delay_ms
        while spent < ms:
            self.press(key)
            seen += self.wait(30)
            spent += 30
        return seen


@pytest.fixture
def typist():
    return Typist()


def deadman_states(seen):
    return [moment.deadman for moment in seen]


def test_a_held_key_drives_until_200_ms_after_its_last_repeat(typist):
    seen = typist.hold(UP, 1000)
    assert not any(deadman_states(seen[:17]))
    assert all(deadman_states(seen[20:]))
    assert seen[-1].left_rad_s == seen[-1].right_rad_s == pytest.approx(4.0)
    after = typist.wait(400)
    # The newest input carries its own time, so that whoever judges its age can.
    assert all(moment.t_ns <= typist.now_ns - 400 * MS for moment in after if moment.deadman)
    assert sum(deadman_states(after)) * 10 <= 200
    assert after[-1].left_rad_s == 0.0


def test_a_key_held_from_the_start_holds_nothing_and_is_reported(typist):
    typist.keys = KeyHold(8.0)
    typist.keys.at(typist.now_ns)
    assert not any(deadman_states(typist.hold(UP, 300)))
    assert not typist.keys.is_ignored
    assert not any(deadman_states(typist.hold(UP, 700, delay_ms=30)))
    assert typist.keys.is_ignored
    typist.wait(500)
    assert not typist.keys.is_ignored
    assert any(deadman_states(typist.hold(UP, 1000)))
    assert not typist.keys.is_ignored


def test_a_tap_holds_nothing(typist):
    typist.press(UP)
    assert not any(deadman_states(typist.wait(2000)))


def test_slow_taps_hold_nothing(typist):
    for _ in range(10):
        typist.press(UP)
        assert not any(deadman_states(typist.wait(300)))


def test_what_comes_faster_than_any_repeat_holds_nothing(typist):
    for _ in range(100):
        typist.now_ns += 9 * MS
        typist.press(UP)
        assert not typist.keys.at(typist.now_ns).deadman


def test_a_late_first_repeat_is_waited_for():
    assert any(deadman_states(Typist().hold(UP, 1000, delay_ms=660)))


def test_another_key_takes_over_without_a_break_where_repeats_begin_early(typist):
    typist.hold(UP, 600)
    seen = typist.hold(LEFT, 600, delay_ms=180)
    assert all(deadman_states(seen))
    assert seen[-1].left_rad_s < 0.0 < seen[-1].right_rad_s


def test_another_key_ends_the_hold_where_repeats_begin_late(typist):
    typist.hold(UP, 600)
    seen = typist.hold(LEFT, 1500, delay_ms=400)
    assert not any(deadman_states(seen[30:]))


def test_a_stutter_of_the_connection_does_not_hold_again(typist):
    typist.hold(UP, 600)
    typist.wait(300)
    assert not any(deadman_states(typist.hold(UP, 2000, delay_ms=30)))
    assert "release all keys" in typist.keys.status_text
    typist.wait(600)
    assert "release" not in typist.keys.status_text
    assert any(deadman_states(typist.hold(UP, 1000)))


def test_any_other_key_stops(typist):
    typist.hold(UP, 600)
    typist.press(b"\x1b")
    assert not any(deadman_states(typist.hold(UP, 1000, delay_ms=30)))


def test_digits_choose_the_speed_and_stop(typist):
    typist.hold(UP, 600)
    typist.press(b"9")
    assert not any(deadman_states(typist.wait(600)))
    assert typist.hold(UP, 600)[-1].left_rad_s == pytest.approx(8.0)
    assert "100% speed" in typist.keys.status_text


@given(st.lists(st.tuples(st.integers(0, 1500), st.sampled_from([*DIRECTIONS, b"5", b"?"])), max_size=60))
def test_never_held_more_than_200_ms_after_a_driving_key(story):
    typist = Typist()
    last_ns = None
    for wait_ms, key in story:
        for moment in typist.wait(wait_ms):
            if moment.deadman:
                assert last_ns is not None
                assert moment.t_ns == last_ns
            assert max(abs(moment.left_rad_s), abs(moment.right_rad_s)) <= 8.0
        typist.press(key)
        last_ns = typist.now_ns


@given(st.binary(max_size=60))
def test_parsing_loses_no_byte_and_never_raises(data):
    assert b"".join(parse(data)) == data


def test_parsing_keeps_control_sequences_whole():
    assert parse(b"w\x1b[A\x1b[1;5C \x1bOD\x1b") == [b"w", UP, b"\x1b[1;5C", b" ", b"\x1bOD", b"\x1b"]


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 60))
def test_wheel_speeds_keep_the_limit_and_the_sense_of_turning(forward, turn, top):
    left, right = wheel_speeds(forward, turn, top)
    assert max(abs(left), abs(right)) <= top * (1 + 1e-12)
    assert (right - left) * turn >= 0.0
    assert (right + left) * forward >= -1e-9


def test_pushing_left_turns_left():
    assert wheel_speeds(0.0, 1.0, 8.0) == (-8.0, 8.0)


@pytest.mark.parametrize(("key", "left", "right"), [(b"q", 1, 3), (b"e", 3, 1), (b"z", -3, -1), (b"c", -1, -3)])
def test_the_keys_on_the_left_turn_left_and_those_on_the_right_turn_right(typist, key, left, right):
    newest = typist.hold(key, 600)[-1]
    assert (newest.left_rad_s, newest.right_rad_s) == (2 * left, 2 * right)
    assert wheel_speeds(1.0, 0.5, 9.0) == (3.0, 9.0)
