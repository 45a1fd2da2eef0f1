"""The page's pad as a source: what counts as held, how old it may be, and who holds."""

from __future__ import annotations

import pytest

from disco_hw.drive import INPUT_LIMIT_NS, PageSource, RobotView, Steering, steering_from
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import NoPlanner
from tests.runtime.simulated import simulated_stack

MS = 1_000_000
VIEW = RobotView(State.READY, driving=False)
OPEN = Steering(0.0, 0.0, held=False, stamp_ns=0)


def steering(stamp_ns, forward=1.0, left=0.0):
    return Steering(forward, left, held=True, stamp_ns=stamp_ns)


def pressed(now_ns=1000 * MS, page=1):
    """A source whose pad page 1 has just begun to hold."""
    source = PageSource(8.0, 0.5)
    assert source.steer(now_ns - 20 * MS, page, OPEN) is None
    assert source.steer(now_ns, page, steering(now_ns - 20 * MS)) is None
    return source


def test_without_a_page_the_deadman_is_open():
    newest = PageSource(8.0, 0.5).poll(5, VIEW)
    assert (newest.deadman, newest.left_rad_s, newest.right_rad_s, newest.t_ns) == (False, 0.0, 0.0, 5)


def test_a_hold_is_as_old_as_the_stamp_that_the_page_had_seen():
    newest = pressed(1000 * MS).poll(1000 * MS, VIEW)
    assert newest.deadman
    assert newest.t_ns == 980 * MS
    assert (newest.left_rad_s, newest.right_rad_s) == (8.0, 8.0)


@pytest.mark.parametrize(
    ("forward", "left", "wheels"),
    [
        (-0.5, 0.0, (-4.0, -4.0)),
        (0.0, 1.0, (-4.0, 4.0)),
        (1.0, 1.0, (8 / 3, 8.0)),
        (-1.0, 1.0, (-8.0, -8 / 3)),
    ],
)
def test_shares_become_wheel_speeds_within_the_limit(forward, left, wheels):
    source = pressed()
    source.steer(1010 * MS, 1, steering(1000 * MS, forward, left))
    newest = source.poll(1010 * MS, VIEW)
    assert (newest.left_rad_s, newest.right_rad_s) == pytest.approx(wheels)


def test_a_released_pad_is_open_in_the_same_tick():
    source = pressed()
    source.steer(1010 * MS, 1, OPEN)
    assert not source.poll(1010 * MS, VIEW).deadman


def test_silence_and_late_messages_end_the_hold():
    source = pressed(1000 * MS)
    # Delivered in a burst, long after: each carries the stamp of then.
    for index in range(5):
        source.steer(1181 * MS, 1, steering((980 - index) * MS))
    assert source.poll(1181 * MS, VIEW).t_ns < 1181 * MS - INPUT_LIMIT_NS
    assert not source.poll(1200 * MS, VIEW).deadman
    assert "release" in source.steer(1220 * MS, 1, steering(1200 * MS))
    assert not source.poll(1220 * MS, VIEW).deadman
    source.steer(1240 * MS, 1, OPEN)
    assert source.steer(1260 * MS, 1, steering(1240 * MS)) is None
    assert source.poll(1260 * MS, VIEW).deadman


def test_a_hold_that_lapsed_at_once_needs_a_new_release():
    source = PageSource(8.0, 0.5)
    source.steer(1000 * MS, 1, OPEN)
    assert source.steer(1010 * MS, 1, steering(815 * MS)) is None
    assert source.poll(1020 * MS, VIEW).t_ns == 815 * MS
    # The open pad is fresh still, but the person has not let go since the hold lapsed.
    assert "release" in source.steer(1030 * MS, 1, steering(1020 * MS))
    assert not source.poll(1030 * MS, VIEW).deadman


def test_a_hold_without_an_open_pad_before_does_not_count():
    source = PageSource(8.0, 0.5)
    assert "release the pad" in source.steer(1000 * MS, 1, steering(990 * MS))
    source.steer(1000 * MS, 2, OPEN)
    assert "release the pad" in source.steer(1010 * MS, 1, steering(1000 * MS))
    source.steer(1010 * MS, 1, OPEN)
    assert "release the pad" in source.steer(1300 * MS, 1, steering(1290 * MS))
    assert not source.poll(1300 * MS, VIEW).deadman


def test_one_page_at_a_time():
    source = pressed(1000 * MS, page=1)
    source.steer(1000 * MS, 2, OPEN)
    assert source.steer(1010 * MS, 2, steering(1000 * MS, -1.0)) == "another page is driving"
    newest = source.poll(1010 * MS, VIEW)
    assert newest.deadman
    assert newest.left_rad_s == 8.0
    source.steer(1020 * MS, 1, OPEN)
    source.steer(1020 * MS, 2, OPEN)
    assert source.steer(1030 * MS, 2, steering(1020 * MS, -1.0)) is None
    assert source.poll(1030 * MS, VIEW).left_rad_s == -8.0


def test_a_stamp_from_the_future_is_none_of_this_loop():
    source = PageSource(8.0, 0.5)
    source.steer(1000 * MS, 1, OPEN)
    assert "another daemon" in source.steer(1010 * MS, 1, steering(2000 * MS))
    assert not source.poll(1010 * MS, VIEW).deadman


GOOD = {"forward": 0.5, "left": -1, "held": True, "stamp": "123"}


def test_a_request_is_read():
    assert steering_from(GOOD) == Steering(0.5, -1.0, True, 123)


@pytest.mark.parametrize(
    "change",
    [
        {"forward": 1.01}, {"forward": float("nan")}, {"forward": "1"}, {"left": True}, {"left": None}, {"held": 1},
        {"stamp": 123}, {"stamp": "-1"}, {"stamp": ""}, {"stamp": "1" * 20}, {"stamp": "²"}, {"more": 1},
    ],
)  # fmt: skip
def test_a_request_that_is_none_is_refused_in_words(change):
    with pytest.raises(ValueError, match=r"drive takes|not a number|not true|must be the digits"):
        steering_from({**GOOD, **change})


class Bench:
    """The daemon's tick and the real firmware in simulated time, with a page that answers every 40 ms."""

    def __init__(self):
        self.source = PageSource(6.0, 0.5)
        self.stack = simulated_stack(NoPlanner())
        self.pilot = self.stack.pilot = HandPilot(self.source, Coverage(6.0), self.source)
        self.stamp = "0"

    def run(self, seconds, hold=None):
        """`hold` None: the page is silent."""
        for number in range(round(seconds / 0.02)):
            now_ns = self.stack.now_us * 1000
            if hold is not None and number % 2 == 0:
                request = {"forward": 0.5 if hold else 0.0, "left": 0.0, "held": hold, "stamp": self.stamp}
                self.pilot.steer(now_ns, 1, request)
                self.stamp = str(now_ns)
            self.stack.run(0.02)
        return self

    def largest_setpoint_rad_s(self):
        outputs = self.stack.robot.board.outputs
        return max(abs(outputs.left_setpoint_rad_s), abs(outputs.right_setpoint_rad_s))

    def driving(self):
        self.run(1.5, hold=False).run(1.5, hold=True)
        assert self.largest_setpoint_rad_s() == pytest.approx(3.0, abs=0.01)
        return self


def test_a_held_pad_drives_and_a_released_one_stops():
    bench = Bench().driving()
    assert bench.pilot.status()["drive"]["by_page"]
    bench.run(0.25, hold=False)
    assert bench.largest_setpoint_rad_s() == 0.0
    bench.run(0.6, hold=False)
    assert bench.stack.core.last.output.state is State.READY


def test_a_page_that_falls_silent_stops_the_wheels_and_must_let_go_before_it_drives_again():
    bench = Bench().driving()
    ramp_s = 3.0 / 20.0
    bench.run(0.2 + ramp_s + 0.06)
    assert bench.largest_setpoint_rad_s() == 0.0
    bench.run(1.0, hold=True)
    assert bench.largest_setpoint_rad_s() == 0.0
    assert bench.stack.core.last.output.state is State.READY
    bench.run(0.1, hold=False).run(1.0, hold=True)
    assert bench.largest_setpoint_rad_s() == pytest.approx(3.0, abs=0.01)


def test_a_drive_without_page_refuses_it():
    source = PageSource(6.0, 0.5)
    pilot = HandPilot(source, Coverage(6.0))
    assert "--page" in pilot.steer(0, 1, GOOD)
    assert not pilot.status()["drive"]["by_page"]
