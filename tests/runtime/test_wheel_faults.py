"""Which wheels are found not to obey, by commands, counts and poses, and which are left alone."""

from __future__ import annotations

import functools
import math
import pickle
import random
from dataclasses import dataclass, field

import pytest

from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.runtime.wheel_faults import Cause, WheelFaults
from drivers.types import PoseSample, WheelCommand, WheelSample

RADIUS_M, TRACK_M = 0.07, 0.44
GEOMETRY = OdometryParameters(RADIUS_M, TRACK_M, 0.1, ((1e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-6)))
TICK_S, TICK_NS = 0.02, 20_000_000
STD_M, STD_RAD = 0.004, 0.006
CIRCLE = (0.72, 1.28)
SLOW, FAST = 0.45, 3.2


@dataclass
class Robot:
    """Wheels that lag behind their commands, and poses of where they take the robot."""

    lag_s: float = 0.1
    dead_rad_s: float = 0.0
    stiction_rad_s: float = 0.0
    has_poses: bool = True
    std: float = 1.0
    slip: float = 0.0
    seed: int = 1
    faults: WheelFaults = field(default_factory=WheelFaults)

    def __post_init__(self):
        self.chance = random.Random(self.seed)
        self.speeds, self.angles, self.counts, self.reported = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self.x = self.y = self.yaw = 0.0
        self.tick = 0
        self.sticks = [True, True]

    def drive(self, seconds, command, turns=None, counts=None):
        """Seconds until a wheel is found not to obey and what, None for nothing.

        `turns(target)`: what the left wheel truly does; `counts(true)`: what its encoder says.
        """
        for number in range(round(seconds / TICK_S)):
            commanded = command(number * TICK_S) if callable(command) else command
            self._move(commanded, turns, counts)
            now_ns = self.tick * TICK_NS
            wheels = WheelSample(now_ns, now_ns, *self.counts, *self.reported)
            poses = [self._pose(now_ns)] if self.has_poses and self.tick % 2 == 0 else []
            found = self.faults.step(now_ns, [wheels], poses, GEOMETRY)
            if found is not None:
                return (number + 1) * TICK_S, found
            self.faults.commanded(now_ns, WheelCommand(*commanded, 0.1))
        return None

    def _move(self, commanded, turns, counts):
        self.tick += 1
        for side in (0, 1):
            target = math.copysign(max(abs(commanded[side]) - self.dead_rad_s, 0.0), commanded[side])
            self.sticks[side] = self.sticks[side] and abs(target) <= self.stiction_rad_s
            target = 0.0 if self.sticks[side] else target
            self.speeds[side] += (target - self.speeds[side]) * (1.0 - math.exp(-TICK_S / self.lag_s))
            true = self.speeds[side] if side or turns is None else turns(self.speeds[side])
            self.angles[side] += true * TICK_S
            self.reported[side] = true if side or counts is None else counts(true)
            self.counts[side] += self.reported[side] * TICK_S
            self._roll(side, true * (1.0 - self.slip))

    def _roll(self, side, speed):
        self.yaw += (1 if side else -1) * RADIUS_M * speed * TICK_S / TRACK_M
        self.x += 0.5 * RADIUS_M * speed * TICK_S * math.cos(self.yaw)
        self.y += 0.5 * RADIUS_M * speed * TICK_S * math.sin(self.yaw)

    def _pose(self, now_ns):
        place = [self.chance.gauss(value, self.std * STD_M) for value in (self.x, self.y)]
        return PoseSample(now_ns, now_ns, *place, self.chance.gauss(self.yaw, self.std * STD_RAD), STD_M, STD_RAD)


def around(speed):
    return CIRCLE[0] * speed, CIRCLE[1] * speed


FAULTS = [
    pytest.param(None, lambda true: 0.0, Cause.ENCODER_SILENT, id="frozen"),
    pytest.param(None, lambda true: -true, Cause.ENCODER_REVERSED, id="reversed"),
    pytest.param(lambda target: 0.0, None, Cause.STANDS, id="blocked"),
    pytest.param(lambda target: -target, None, Cause.TURNS_BACKWARD, id="turns-backward"),
    pytest.param(lambda target: 12.0, None, Cause.RUNS_AWAY, id="runs-away"),
    pytest.param(lambda target: 12.0, lambda true: -true, Cause.RUNS_AWAY, id="runs-away-reversed"),
]
UNDECIDED = {
    Cause.ENCODER_SILENT: Cause.SILENT, Cause.STANDS: Cause.SILENT, Cause.ENCODER_REVERSED: Cause.OPPOSED,
    Cause.TURNS_BACKWARD: Cause.OPPOSED, Cause.RUNS_AWAY: Cause.RUNS_AWAY,
}  # fmt: skip


@functools.cache
def _after_six_seconds(command):
    """A robot, pickled, that has driven by a command so long, and whose wheels obeyed."""
    robot = Robot()
    assert robot.drive(6.0, command) is None
    return pickle.dumps(robot)


@pytest.mark.parametrize(("turns", "counts", "cause"), FAULTS)
@pytest.mark.parametrize("speed", [SLOW, 0.8, FAST])
@pytest.mark.parametrize("way", [1.0, -1.0], ids=["forward", "backward"])
def test_a_wheel_that_ceases_to_obey_is_found_within_seven_tenths_of_a_second(turns, counts, cause, speed, way):
    command = tuple(way * each for each in around(speed))
    robot = pickle.loads(_after_six_seconds(command))
    after_s, found = robot.drive(2.0, command, turns, counts)
    assert after_s <= 0.7
    assert found.cause in (cause, UNDECIDED[cause])
    assert found.side == "left"
    if speed == FAST and cause is not Cause.RUNS_AWAY:
        assert found.cause is cause, "at this speed the poses decide"


@pytest.mark.parametrize(("turns", "counts", "cause"), FAULTS[:5])
def test_without_poses_it_is_found_and_both_explanations_are_named(turns, counts, cause):
    robot = Robot(has_poses=False)
    assert robot.drive(4.0, around(FAST)) is None
    after_s, found = robot.drive(2.0, around(FAST), turns, counts)
    assert after_s <= 0.7
    assert found.cause is UNDECIDED[cause]


@pytest.mark.parametrize("frozen", [lambda true: 0.0, lambda true: 0.1 * true])
def test_an_encoder_that_never_counted_is_shown_by_the_poses_where_commands_are_too_slow_to_expect_anything(frozen):
    after_s, found = Robot().drive(4.0, around(0.9), None, frozen)
    assert found.cause is Cause.ENCODER_SILENT
    assert after_s <= 1.5


HEALTHY = [
    pytest.param(Robot(lag_s=0.6), FAST, id="slow-motors"),
    pytest.param(Robot(dead_rad_s=0.3), SLOW, id="dead-band"),
    pytest.param(Robot(dead_rad_s=1.2), SLOW, id="within-the-dead-band"),
    pytest.param(Robot(stiction_rad_s=1.0), 0.8, id="stiction-of-one-wheel"),
    pytest.param(Robot(slip=0.25), FAST, id="slip"),
    pytest.param(Robot(slip=1.0), FAST, id="lifted"),
    pytest.param(Robot(std=4.0), SLOW, id="poses-worse-than-they-say"),
    pytest.param(Robot(has_poses=False), SLOW, id="no-poses"),
]


@pytest.mark.parametrize(("robot", "speed"), HEALTHY)
def test_a_robot_that_obeys_as_well_as_it_can_is_left_alone(robot, speed):
    assert robot.drive(15.0, around(speed)) is None


@pytest.mark.parametrize("lag_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("dead_rad_s", [0.4, 0.8])
def test_a_dead_band_is_known_as_well_after_a_stop_as_before(dead_rad_s, lag_s):
    def turns_stops_and_curves(t_s):
        if t_s < 5.4:
            turn = max(min(4.8, 20.0 * t_s, 20.0 * (5.0 - t_s)), 0.0)
            return turn, -turn
        part = min((t_s - 5.4) / 0.15, 1.0)
        return 1.02 * part, 2.82 * part

    robot = Robot(lag_s=lag_s, dead_rad_s=dead_rad_s)
    assert robot.drive(12.0, turns_stops_and_curves) is None
    assert robot.faults.not_following == 0
    # And a wheel that ceases to turn then is found.
    assert robot.drive(3.0, (1.6, 2.82), turns=lambda target: 0.0) is not None


@pytest.mark.parametrize("lag_s", [0.02, 0.1, 0.3])
def test_wheels_that_lag_behind_swinging_commands_follow_them(lag_s):
    robot = Robot(lag_s=lag_s)
    assert robot.drive(12.0, lambda t_s: (3.0 * math.sin(2.5 * t_s), 4.0 * math.sin(1.7 * t_s))) is None
    assert robot.faults.not_following == 0


@pytest.mark.parametrize("stands_s", [0.16, 0.26])
def test_a_wheel_that_stands_against_a_stone_for_up_to_a_quarter_second_is_counted_once_and_no_fault(stands_s):
    robot = Robot()
    robot.drive(3.0, (3.0, 3.0))
    assert robot.drive(stands_s, (3.0, 3.0), lambda target: 0.0) is None
    assert robot.drive(3.0, (3.0, 3.0)) is None
    assert robot.faults.not_following == 1


def test_a_wheel_that_is_held_up_again_and_again_is_told_of_every_five_seconds():
    robot = Robot()
    robot.drive(3.0, (3.0, 3.0))
    told = []
    step = robot.faults.step

    def listening(*given):
        found = step(*given)
        told.extend(robot.faults.events)
        return found

    robot.faults.step = listening
    for _ in range(14):
        robot.drive(0.2, (3.0, 3.0), lambda target: 0.0)
        assert robot.drive(0.8, (3.0, 3.0)) is None
    assert robot.faults.not_following == 14
    assert [text.split(":")[0] for text in told] == ["the left wheel does not follow its command"] * 3


def test_a_jump_of_the_poses_is_no_fault_of_a_wheel():
    robot = Robot(stiction_rad_s=1.0)
    robot.drive(1.0, around(0.8))
    for _ in range(5):
        robot.x, robot.yaw = robot.x + 0.3, robot.yaw - 0.4
        assert robot.drive(1.5, around(0.8)) is None


def test_a_wheel_that_never_followed_and_counts_backward_is_left_to_whoever_knows_the_wiring():
    robot = Robot()
    robot.faults.commanded(0, WheelCommand(0.0, 0.0, 0.1))
    step = robot.faults.step
    robot.faults.step = lambda *given: step(*given, is_wiring_known=False)
    assert robot.drive(3.0, around(FAST), None, lambda true: -true) is None
    assert robot.faults.has_followed == (False, True)


def test_disarmed_nothing_is_expected():
    robot = Robot()
    robot.drive(3.0, around(FAST))
    robot.drive(0.2, around(FAST), lambda target: 0.0)
    robot.faults.commanded(robot.tick * TICK_NS, None)
    for _ in range(100):
        robot.tick += 1
        now_ns = robot.tick * TICK_NS
        assert robot.faults.step(now_ns, [WheelSample(now_ns, now_ns, *robot.counts, 0.0, 0.0)], [], GEOMETRY) is None


@pytest.mark.parametrize("takes_body_speeds", [True, False])
def test_a_base_that_makes_wheel_speeds_of_its_own_may_turn_by_more(takes_body_speeds):
    robot = Robot(faults=WheelFaults(takes_body_speeds))
    robot.drive(4.0, (3.0, 3.0))
    move = robot._move
    # It turns by half more than is commanded.
    mean, difference = 0.5 * (0.6 + 3.5), 0.5 * (3.5 - 0.6)
    turned = (mean - 1.5 * difference, mean + 1.5 * difference)
    robot._move = lambda _commanded, turns, counts: move(turned, turns, counts)
    assert (robot.drive(2.0, (0.6, 3.5)) is None) is takes_body_speeds


@pytest.mark.parametrize("speed", [SLOW, FAST])
@pytest.mark.parametrize(("turns", "counts"), [(lambda target: 0.0, None), (None, lambda true: 0.0)])
def test_a_base_that_has_shown_to_turn_as_it_is_asked_to_is_judged_as_soon_as_single_wheels(turns, counts, speed):
    found = {}
    for is_base in (True, False):
        robot = Robot(faults=WheelFaults(takes_body_speeds=is_base, stops_by_own_ramp=is_base))
        assert robot.drive(6.0, around(speed)) is None
        found[is_base], _ = robot.drive(3.0, around(speed), turns, counts)
    assert found[True] <= found[False]
