"""The deadman: what arms, what stops, and that nothing arms by itself."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.drive import ManualInput, RobotView
from disco_hw.drive.hand_pilot import Deadman
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import Manual, Standstill
from disco_hw.runtime.supervisor import UserRequest

MS = 1_000_000
TICK = 20 * MS
ARM_START = (UserRequest.ARM, UserRequest.START)
DISARM = (UserRequest.DISARM,)


class Bench:
    """A deadman with a robot that arms at once and disarms at once, as far as its state is concerned."""

    def __init__(self):
        self.deadman = Deadman()
        self.now_ns = 0
        self.state = State.READY

    def tick(self, held, age_ns=0, gone=False):
        self.now_ns += TICK
        newest = None if gone else ManualInput(self.now_ns - age_ns, 1.0, 2.0, held)
        self.verdict = self.deadman.step(self.now_ns, newest, self.state)
        if self.verdict.requests == ARM_START:
            self.state = State.ARMED
        elif self.verdict.requests == DISARM:
            self.state = State.READY
        return self.verdict

    def driving(self):
        self.tick(False)
        self.tick(True)
        assert self.tick(True).motion == Manual(1.0, 2.0)
        return self


@pytest.fixture
def bench():
    return Bench()


def test_a_press_while_ready_arms_and_starts_once(bench):
    assert bench.tick(False).requests == ()
    assert bench.tick(True).requests == ARM_START
    assert [bench.tick(True).requests for _ in range(50)] == [()] * 50
    assert bench.verdict.motion == Manual(1.0, 2.0)


def test_a_deadman_held_from_the_start_counts_for_nothing_until_released(bench):
    assert [bench.tick(True).requests for _ in range(100)] == [()] * 100
    assert bench.verdict.motion == Standstill()
    bench.tick(False)
    assert bench.tick(True).requests == ARM_START


def test_who_holds_in_vain_is_asked_once_to_let_go_when_the_robot_is_ready(bench):
    bench.state = State.HANDSHAKE
    assert [bench.tick(True).event for _ in range(50)] == [None] * 50
    bench.state = State.READY
    events = [bench.tick(True).event for _ in range(50)]
    assert events[0] is not None
    assert "release it and press it again" in events[0]
    assert events[1:] == [None] * 49
    bench.tick(False)
    assert bench.tick(True).requests == ARM_START
    # What says already that the deadman is to be let go is not said again.
    assert "release the deadman" in bench.deadman.refused("no poses")
    bench.state = State.READY
    assert [bench.tick(True).event for _ in range(50)] == [None] * 50


@pytest.mark.parametrize(
    ("loss", "expected_event"),
    [
        ({"held": False}, "released"),
        ({"held": True, "gone": True}, "disconnected"),
        ({"held": True, "age_ns": 200 * MS + 1}, "200 ms"),
        ({"held": True, "age_ns": -1}, "200 ms"),
    ],
)
def test_release_loss_and_silence_stop_in_the_same_tick(loss, expected_event):
    bench = Bench().driving()
    verdict = bench.tick(**loss)
    assert verdict.requests == DISARM
    assert verdict.motion == Standstill()
    assert expected_event in verdict.event


def test_what_was_read_cannot_be_changed():
    manual, seen = ManualInput(1, 0.0, 0.0, deadman=False), RobotView(State.READY, driving=False)
    with pytest.raises(AttributeError):
        manual.deadman = True
    with pytest.raises(AttributeError):
        seen.driving = True


def test_input_of_exactly_200_ms_still_counts():
    bench = Bench().driving()
    assert bench.tick(True, age_ns=200 * MS).motion == Manual(1.0, 2.0)


@pytest.mark.parametrize("loss", [{"held": True, "gone": True}, {"held": True, "age_ns": 300 * MS}])
def test_nothing_arms_again_until_the_deadman_was_seen_open(loss):
    bench = Bench().driving()
    bench.tick(**loss)
    assert [bench.tick(True).requests for _ in range(100)] == [()] * 100
    bench.tick(False)
    bench.tick(**loss)
    assert bench.tick(True).requests == ()
    bench.tick(False)
    assert bench.tick(True).requests == ARM_START


@pytest.mark.parametrize("state", [state for state in State if state is not State.READY])
def test_a_press_counts_while_ready_only_and_is_used_up(state, bench):
    bench.tick(False)
    bench.state = state
    verdict = bench.tick(True)
    assert UserRequest.ARM not in verdict.requests
    assert verdict.event
    bench.state = State.READY
    assert bench.tick(True).requests == ()


@pytest.mark.parametrize("state", [State.STOPPING, State.FAULT, State.DISCONNECTED, State.HANDSHAKE, State.READY])
def test_once_disarmed_by_others_a_new_press_is_needed(state):
    bench = Bench().driving()
    bench.state = state
    assert bench.tick(True).motion == Standstill()
    bench.state = State.READY
    assert [bench.tick(True).requests for _ in range(20)] == [()] * 20


def test_whoever_else_arms_the_robot_finds_it_disarmed(bench):
    bench.tick(False)
    bench.state = State.ARMED
    assert bench.tick(False).requests == DISARM
    bench = Bench().driving()
    bench.state = State.STOPPING
    bench.tick(True)
    bench.state = State.ARMED
    verdict = bench.tick(True)
    assert verdict.requests == DISARM
    assert verdict.motion == Standstill()


def test_a_release_while_arming_takes_the_request_back(bench):
    bench.tick(False)
    bench.tick(True)
    bench.state = State.READY
    assert bench.tick(False).requests == DISARM


def test_a_refusal_needs_a_new_press(bench):
    bench.tick(False)
    bench.tick(True)
    bench.state = State.READY
    assert "wheels are turning" in bench.deadman.refused("the wheels are turning")
    assert [bench.tick(True).requests for _ in range(20)] == [()] * 20


moments = st.tuples(
    st.booleans(), st.sampled_from([0, 20 * MS, 150 * MS, 250 * MS]), st.booleans(), st.sampled_from([None, *State])
)


@given(st.lists(moments, max_size=80))
def test_motion_only_between_a_press_and_the_first_loss(story):
    """Whatever happens: motion means held, fresh and armed-to-be; arming means that the tick before saw it open."""
    bench = Bench()
    open_before = False
    for held, age_ns, gone, state in story:
        if state is not None:
            bench.state = state
        before = bench.state
        verdict = bench.tick(held, age_ns, gone)
        good = held and not gone and age_ns <= 200 * MS
        if verdict.motion != Standstill():
            assert good
        if UserRequest.ARM in verdict.requests:
            assert good
            assert open_before
            assert before is State.READY
        if before is State.ARMED and not good:
            assert verdict.requests == DISARM
        open_before = not held and not gone and age_ns <= 200 * MS
