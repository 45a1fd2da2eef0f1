"""Sticks to wheel speeds, silence, and a gamepad that goes and comes back."""

from __future__ import annotations

from disco_hw.drive import GamepadSource, RobotView
from disco_hw.drive.hand_pilot import Deadman
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import Manual, Standstill
from drivers.gamepad import GamepadError, GamepadState

MS = 1_000_000
VIEW = RobotView(State.READY, driving=False)


class Pad:
    """Stands for an open gamepad."""

    name = "pad"
    refusal = ""

    def __init__(self):
        self.state, self.closed = GamepadState(0, 0.0, 0.0, False), False

    def poll(self, _now_ns):
        return self.state

    def close(self):
        self.closed = True


class Bench:
    def __init__(self, silence_s=2.0):
        self.pad, self.plugged, self.opened = Pad(), True, 0
        self.source = GamepadSource(self.pad, self.open, top_rad_s=8.0, turn_share=0.5, silence_s=silence_s)
        self.on_return = GamepadState(0, 0.0, 0.0, False)
        self.now_ns = 0

    def open(self, _now_ns):
        self.opened += 1
        if not self.plugged:
            raise GamepadError("none")
        self.pad = Pad()
        self.pad.state = self.on_return
        return self.pad

    def poll(self, state=None, ms=20):
        if state is not None:
            self.pad.state = state
        self.now_ns += ms * MS
        return self.source.poll(self.now_ns, VIEW)


def test_sticks_become_wheel_speeds():
    bench = Bench()
    forward = bench.poll(GamepadState(0, 1.0, 0.0, True))
    assert (forward.left_rad_s, forward.right_rad_s, forward.deadman) == (8.0, 8.0, True)
    left = bench.poll(GamepadState(0, 0.0, 1.0, True))
    assert (left.left_rad_s, left.right_rad_s) == (-4.0, 4.0)
    back_left = bench.poll(GamepadState(0, -1.0, 1.0, True))
    assert (back_left.left_rad_s, back_left.right_rad_s) == (-8.0, -8 / 3)


def test_what_is_held_still_stays_new_until_the_silence_is_too_long():
    bench = Bench()
    assert bench.poll(GamepadState(0, 1.0, 0.0, True), ms=2000).t_ns == bench.now_ns
    assert bench.poll().t_ns == 0
    # An open deadman is known however long ago it was opened, so that the next press counts.
    assert bench.poll(GamepadState(0, 0.0, 0.0, False), ms=60_000).t_ns == bench.now_ns
    bench = Bench(silence_s=0.0)
    assert bench.poll(GamepadState(0, 1.0, 0.0, True), ms=60_000).t_ns == bench.now_ns


def test_a_press_that_does_not_count_is_said():
    bench = Bench()
    assert "hold the deadman" in bench.source.status_text
    bench.pad.refusal = "let go of the stick"
    assert bench.source.status_text == "pad: let go of the stick"


def test_a_gone_pad_is_closed_and_looked_for_once_a_second():
    bench = Bench()
    first = bench.pad
    bench.plugged = False
    first.state = None
    assert bench.poll() is None
    assert first.closed
    assert "plug it in again" in bench.source.status_text
    for _ in range(99):
        assert bench.poll() is None
    assert bench.opened == 1
    bench.plugged = True
    for _ in range(51):
        bench.poll()
    assert bench.poll() is not None
    assert bench.source.ended is None


def test_a_pad_that_comes_back_held_arms_nothing_by_itself():
    bench, deadman = Bench(), Deadman()

    def step(state, robot_state):
        newest = bench.poll(state)
        return deadman.step(bench.now_ns, newest, robot_state)

    step(GamepadState(0, 0.0, 0.0, False), State.READY)
    assert isinstance(step(GamepadState(0, 1.0, 0.0, True), State.READY).motion, Manual)
    bench.pad.state = None
    assert isinstance(step(None, State.ARMED).motion, Standstill)
    bench.on_return = GamepadState(0, 1.0, 0.0, True)
    for _ in range(100):
        assert step(None, State.READY).requests == ()
    assert bench.opened == 1
    step(GamepadState(bench.now_ns, 1.0, 0.0, False), State.READY)
    assert isinstance(step(GamepadState(bench.now_ns, 1.0, 0.0, True), State.READY).motion, Manual)


def test_closing_closes_the_pad():
    bench = Bench()
    bench.source.close()
    bench.source.close()
    assert bench.pad.closed
