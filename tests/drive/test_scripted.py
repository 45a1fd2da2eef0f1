"""A script as a source, and the deadman that holds itself."""

from __future__ import annotations

import pytest

from disco_hw.drive import ManualInput, RobotView
from disco_hw.drive.script import Manoeuvre, Script, ScriptSource, Unattended
from disco_hw.runtime import State

TICK = 20_000_000
READY = RobotView(State.READY, driving=False)
DRIVING = RobotView(State.ARMED, driving=True)
HOLDING = RobotView(State.ARMED, driving=False)


class Finger:
    """A deadman in the test's hand."""

    def __init__(self):
        self.held, self.gone, self.ended, self.completed = True, False, None, True
        self.status_text, self.task, self.closed = "hold it", "", False

    def poll(self, now_ns, _robot):
        return None if self.gone else ManualInput(now_ns - 7, 9.0, 9.0, self.held)

    def close(self):
        self.closed = True


class Bench:
    def __init__(self):
        steps = tuple(Manoeuvre(f"m{k}", f"for {k}", 1.0, lambda t_s, k=k: (float(k), t_s)) for k in (1, 2))
        self.finger = Finger()
        self.source = ScriptSource(Script("s", steps), self.finger)
        self.now_ns = 0

    def run(self, robot, ticks):
        for _ in range(ticks):
            self.now_ns += TICK
            self.last = self.source.poll(self.now_ns, robot)
        return self.last


@pytest.fixture
def bench():
    return Bench()


def test_time_runs_while_driving_only(bench):
    assert bench.run(READY, 100).left_rad_s == 1.0
    bench.run(DRIVING, 25)
    assert bench.last.right_rad_s == 0.5
    bench.run(HOLDING, 100)
    assert bench.run(DRIVING, 1).right_rad_s == 0.52
    assert "m1" in bench.source.task


def test_deadman_and_time_are_the_other_sources(bench):
    assert bench.run(DRIVING, 1).t_ns == bench.now_ns - 7
    bench.finger.held = False
    assert bench.run(DRIVING, 1).deadman is False
    bench.finger.gone = True
    assert bench.run(DRIVING, 1) is None


def test_what_was_broken_off_begins_anew(bench):
    bench.run(DRIVING, 75)
    assert bench.last.left_rad_s == 2.0
    bench.run(READY, 5)
    bench.run(DRIVING, 1)
    assert (bench.last.left_rad_s, bench.last.right_rad_s) == (2.0, pytest.approx(0.02))


def test_the_end_opens_the_deadman(bench):
    bench.run(DRIVING, 101)
    assert bench.source.ended == "script s completed"
    assert bench.source.completed
    assert bench.last == ManualInput(bench.now_ns, 0.0, 0.0, deadman=False)
    assert bench.run(READY, 1).deadman is False


def test_the_end_of_the_deadman_is_the_end(bench):
    bench.finger.ended = "the terminal was closed"
    assert bench.source.ended == "the terminal was closed"
    assert not bench.source.completed
    bench.source.close()
    assert bench.finger.closed


def test_a_stalled_loop_skips_nothing(bench):
    bench.run(DRIVING, 1)
    bench.now_ns += 5_000_000_000
    assert bench.run(DRIVING, 1).left_rad_s == 1.0


def limited(reached):
    """A script that finds limits at 4 rad/s each way, then asks for half of them, on wheels that reach `reached`."""
    search = Manoeuvre("fastest", "finds", 2.0, lambda t_s: (4.0, -4.0), finds_limits=True)
    step = Manoeuvre("step 1", "holds", 2.0, lambda t_s: (2.0, -2.0), within_limits=True)
    bench = Bench()
    bench.source = ScriptSource(Script("s", (search, step)), bench.finger)
    # What is reached at first is the wheels speeding up.
    assert bench.run(RobotView(State.ARMED, True, (0.1, -0.1)), 50) == ManualInput(bench.now_ns - 7, 4.0, -4.0, True)
    bench.run(RobotView(State.ARMED, True, reached), 60)
    return bench


def test_steps_are_held_within_what_the_wheels_reached_at_the_end_of_the_search():
    bench = limited((3.0, -3.99))
    assert (bench.last.left_rad_s, bench.last.right_rad_s) == (1.5, -2.0)
    assert "step 1 (" in bench.source.task


def test_limits_that_nobody_measured_are_those_asked_for():
    bench = limited(None)
    assert (bench.last.left_rad_s, bench.last.right_rad_s) == (2.0, -2.0)
    assert "not found: no wheel speeds were measured" in bench.source.task


def deadman_states(source, robot, ticks, start_ns=0):
    return [source.poll(start_ns + k * TICK, robot).deadman for k in range(1, ticks + 1)]


def test_unattended_presses_once_the_robot_is_ready_and_was_seen_open():
    source = Unattended()
    assert deadman_states(source, RobotView(State.HANDSHAKE, driving=False), 3) == [False] * 3
    assert deadman_states(source, READY, 3, 3 * TICK) == [False, True, True]
    assert deadman_states(source, DRIVING, 3, 6 * TICK) == [True] * 3


def test_unattended_never_presses_again():
    source = Unattended()
    deadman_states(source, READY, 2)
    deadman_states(source, DRIVING, 2, 2 * TICK)
    assert deadman_states(source, HOLDING, 1, 4 * TICK) == [True]
    source.poll(5 * TICK, RobotView(State.STOPPING, driving=False))
    assert "disarmed before" in source.ended
    assert deadman_states(source, READY, 100, 6 * TICK) == [False] * 100


def test_unattended_goes_on_after_a_short_hold_however_late():
    source = Unattended(driving_within_s=1.0)
    deadman_states(source, READY, 2)
    deadman_states(source, DRIVING, 100, 2 * TICK)
    assert deadman_states(source, HOLDING, 50, 102 * TICK) == [True] * 50
    assert deadman_states(source, DRIVING, 1, 152 * TICK) == [True]
    assert deadman_states(source, HOLDING, 60, 153 * TICK)[-1] is False
    assert "stood still for 1 s" in source.ended


def test_unattended_gives_up():
    source = Unattended(ready_within_s=1.0)
    deadman_states(source, RobotView(State.HANDSHAKE, driving=False), 52)
    assert "not ready within 1 s" in source.ended
    source = Unattended(driving_within_s=1.0)
    deadman_states(source, READY, 60)
    assert "did not start" in source.ended
    assert not source.completed
