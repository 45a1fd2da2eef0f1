"""Wheels that are wired otherwise than robot.toml says, with every vendor's driver and in the whole tick."""

import math
import random
import tracemalloc

import numpy as np
import pytest

from disco_hw.runtime import State
from disco_hw.runtime.directions import Directions
from disco_hw.runtime.supervisor import UserRequest
from drivers.motor import AS_CONFIGURED, Wiring, rewired
from drivers.types import PoseSample, WheelCommand, WheelSample
from sim.plant_parameters import PlantParameters
from tests.drivers.motor.vendors import VENDORS
from tests.runtime.simulated import simulated_stack
from tests.tables import thinned

RADIUS_M, TRACK_M = 0.06, 0.31
TICK_NS = 20_000_000
ONE_OF_EACH = [next(vendor for vendor in VENDORS if vendor.name == name) for name in {v.name: 0 for v in VENDORS}]
LEFT_REVERSED = Wiring(motor_direction=(-1, 1), encoder_direction=(-1, 1))
RIGHT_REVERSED = Wiring(motor_direction=(1, -1), encoder_direction=(1, -1))
ALL_REVERSED = Wiring(motor_direction=(-1, -1), encoder_direction=(-1, -1))
WRONG = [
    pytest.param(LEFT_REVERSED, (3.0, 2.0), "the left wheel turns backward; .*motor_direction = [-1, 1] and "
                 "wheels.encoder_direction = [-1, 1]", id="left-reversed"),
    pytest.param(RIGHT_REVERSED, (2.0, 2.0), "the right wheel turns backward; .*motor_direction = [1, -1]",
                 id="right-reversed"),
    pytest.param(ALL_REVERSED, (2.0, 3.0), "the left wheel turns backward, the right wheel turns backward",
                 id="both-reversed"),
    pytest.param(Wiring(sides_swapped=True), (1.0, 3.0), "left and right are swapped; .*sides_swapped = true",
                 id="sides-swapped"),
    pytest.param(Wiring(sides_swapped=True), (-2.0, 2.0), "", id="sides-swapped-on-the-spot"),
    pytest.param(Wiring(encoder_direction=(-1, 1)), (3.0, 3.0), "the left wheel counted opposite .*"
                 "encoder_direction = [-1, 1]", id="left-encoder-reversed"),
    pytest.param(Wiring(encoder_direction=(1, -1)), (3.0, 3.0), "the right wheel counted opposite",
                 id="right-encoder-reversed"),
    pytest.param(Wiring(motor_direction=(-1, 1)), (3.0, 2.0), "the left wheel counted opposite .*"
                 "motor_direction = [-1, 1]", id="left-motor-reversed"),
    pytest.param(Wiring(encoders_swapped=True), (1.5, 4.0), "encoders_swapped = true", id="encoders-swapped"),
]  # fmt: skip


class Floor:
    """Where truly turning wheels take the robot, and the poses that are measured of it; turns less than it should."""

    def __init__(self, noise_m=0.002, skid=1.8):
        self.x = self.y = self.yaw = 0.0
        self._noise_m, self._skid, self._random = noise_m, skid, random.Random(1)

    def roll(self, left_rad, right_rad):
        ahead = 0.5 * RADIUS_M * (left_rad + right_rad)
        self.yaw += RADIUS_M * (right_rad - left_rad) / (self._skid * TRACK_M)
        self.x += ahead * math.cos(self.yaw)
        self.y += ahead * math.sin(self.yaw)

    def pose(self, t_ns):
        x, y, yaw = (self._random.gauss(value, std) for value, std in (
            (self.x, self._noise_m), (self.y, self._noise_m), (self.yaw, 0.005)
        ))  # fmt: skip
        return PoseSample(t_ns, t_ns, x, y, yaw, self._noise_m, 0.005)


def first_finding(vendor, reported, true, speeds, seconds=3.0):
    """Seconds of motion until something is found, and what; None where nothing is."""
    bench = vendor.bench()
    # What robot.toml says stands before a robot that is wired as the driver believes: the other way round is as true.
    bench.driver = rewired(bench.driver, true)
    watch, floor = Directions(RADIUS_M, TRACK_M, reported), Floor()
    bench.arm()
    seen, before, moving_ns = len(bench.wheels), list(bench.robot.angle), None
    for tick in range(round(seconds / 0.02)):
        command = WheelCommand(*(speeds if tick > 10 else (0.0, 0.0)), 0.1)
        bench.command = command
        for _ in range(20):
            bench.step()
            now = list(bench.robot.angle)
            floor.roll(now[0] - before[0], now[1] - before[1])
            before = now
        if moving_ns is None and bench.robot.speed_rad_s > 0.1:
            moving_ns = bench.now_ns
        wheels, seen = bench.wheels[seen:], len(bench.wheels)
        found = watch.step(bench.now_ns, wheels, (floor.pose(bench.now_ns),), command)
        if found is not None:
            return (bench.now_ns - moving_ns) * 1e-9, found
    return None


# Quick is each wiring once, with one driver after the other.
WRONG_WITH_EACH = [
    pytest.param(
        vendor, *case.values, id=f"{vendor}-{case.id}", marks=() if k % len(ONE_OF_EACH) == j else pytest.mark.thorough
    )
    for j, vendor in enumerate(ONE_OF_EACH)
    for k, case in enumerate(WRONG)
]


@pytest.mark.parametrize(("vendor", "wiring", "speeds", "expected"), WRONG_WITH_EACH)
def test_a_wrong_wiring_is_noticed_in_the_first_half_second_of_motion(vendor, wiring, speeds, expected):
    after_s, found = first_finding(vendor, AS_CONFIGURED, wiring, speeds)
    assert after_s <= 0.5
    assert all(part in found for part in expected.split(".*"))


@thinned("speeds", [(3.0, 2.0), (-2.0, 2.0), (6.0, 6.0), (-1.0, -3.0), (1.0, 3.0)], quick=2)
@thinned("vendor", ONE_OF_EACH, ids=str, quick=1)
def test_a_right_wiring_is_let_alone(vendor, speeds):
    assert first_finding(vendor, AS_CONFIGURED, AS_CONFIGURED, speeds) is None


def watching(reported=AS_CONFIGURED):
    return Directions(RADIUS_M, TRACK_M, reported)


def drive(watch, commands, turned, *followed):
    """Ticks with speeds asked and angles counted; what was found, None for nothing."""
    last = (0.0, 0.0)
    for tick, (speeds, angles) in enumerate(zip(commands, turned, strict=True)):
        now_ns = tick * TICK_NS
        rates = [(now - was) / 0.02 for now, was in zip(angles, last, strict=True)]
        sample, last = WheelSample(now_ns, now_ns, *angles, *rates), angles
        found = watch.step(now_ns, (sample,), (), WheelCommand(*speeds, 0.1), *followed)
        if found is not None:
            return found
    return None


def test_wheels_that_lag_while_the_command_swings_are_let_alone():
    commands = [(4.0 * math.cos(tick / 9), 3.0 * math.cos(tick / 7)) for tick in range(200)]
    turned = 0.02 * np.cumsum([[0.0, 0.0]] * 12 + commands[:-12], axis=0)
    assert drive(watching(), commands, turned.tolist()) is None


def test_what_was_already_written_is_what_changes():
    found = drive(
        watching(Wiring(encoder_direction=(1, -1))),
        [(0.0, 0.0)] + [(2.0, 2.0)] * 30,
        [(0.04 * max(tick - 2, 0), -0.04 * max(tick - 2, 0)) for tick in range(31)],
    )
    assert "wheels.encoder_direction = [1, 1] if it turned as commanded" in found


@thinned("wiring", [RIGHT_REVERSED, Wiring(sides_swapped=True), Wiring(encoder_direction=(1, -1))], quick=1)
def test_the_daemons_tick_stops_the_robot_and_says_what_to_change(wiring):
    run = simulated_stack()
    run.core.driver = rewired(run.core.driver, wiring)
    run.start()
    moving_s = stopped_s = None
    for tick in run.ticks(2.0):
        speeds = run.core.newest_wheels
        now_s = run.now_us * 1e-6
        if moving_s is None and max(abs(speeds.left_speed_rad_s), abs(speeds.right_speed_rad_s)) > 0.1:
            moving_s = now_s
        if stopped_s is None and not tick.output.motion_allowed and moving_s is not None:
            stopped_s = now_s
    assert stopped_s - moving_s <= 0.5
    assert tick.output.state is State.FAULT
    assert "in robot.toml write wheels." in tick.output.detail
    assert max(abs(speeds.left_speed_rad_s), abs(speeds.right_speed_rad_s)) < 0.05
    (refused,) = run.run(0.02, UserRequest.RESET)[0].output.replies
    assert not refused.accepted


@pytest.mark.thorough
def test_a_robot_that_is_wired_as_declared_is_let_alone():
    run = simulated_stack()
    run.start()
    assert all(tick.output.motion_allowed for tick in run.ticks(4.0))


@pytest.mark.thorough
def test_ten_minutes_of_driving_keep_no_more_than_the_first_seconds():
    directions = watching()
    command, floor = WheelCommand(2.0, 2.0, 0.1), Floor()

    def drive(ticks):
        for tick in ticks:
            t_ns, turned = tick * TICK_NS, max(tick - 2, 0) * 0.04
            floor.roll(0.04 * (tick > 2), 0.04 * (tick > 2))
            wheels = WheelSample(t_ns, t_ns, turned, turned, 2.0 * (tick > 2), 2.0 * (tick > 2))
            assert directions.step(t_ns, [wheels], [floor.pose(t_ns)], command) is None

    tracemalloc.start()
    drive(range(500))
    before, _ = tracemalloc.get_traced_memory()
    drive(range(500, 30_000))
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 10_000


@thinned(("radius", "axle", "seed"), [(0.85, 1.2, 3), (1.18, 0.8, 4), (1.15, 1.15, 5), (1.0, 1.0, 2)], quick=1)
def test_a_robot_whose_geometry_is_written_down_wrongly_is_not_taken_for_miswired(radius, axle, seed):
    reported = PlantParameters()
    run = simulated_stack(
        seed=seed, wheel_radius_m=radius * reported.wheel_radius_m, axial_distance_m=axle * reported.axial_distance_m
    )
    run.start()
    assert all("wheels." not in tick.output.detail for tick in run.ticks(2.5))


@pytest.mark.parametrize("runs_at", [3.0, 9.0])
def test_a_wheel_that_does_not_count_gets_no_wiring_advice_however_it_turns(runs_at):
    watch, floor, found = watching(), Floor(), []
    for tick in range(150):
        now_ns, moves = tick * TICK_NS, tick > 12
        floor.roll(0.02 * runs_at * moves, 0.06 * moves)
        right = 0.06 * max(tick - 12, 0)
        wheels = WheelSample(now_ns, now_ns, 0.0, right, 0.0, 3.0 * moves)
        command = WheelCommand(*((3.0, 3.0) if tick > 10 else (0.0, 0.0)), 0.1)
        found.append(watch.step(now_ns, (wheels,), (floor.pose(now_ns),), command))
    assert not any(found)


def test_a_wheel_that_counts_backward_after_it_has_followed_gets_no_wiring_advice():
    commands = [(0.0, 0.0)] + [(2.0, 2.0)] * 60
    turned = [(0.0, 0.0)] + [(0.04 * (tick if tick < 10 else 20 - tick), 0.04 * tick) for tick in range(60)]
    assert "wheels.encoder_direction" in drive(watching(), commands, turned, (False, False))
    assert drive(watching(), commands, turned, (True, True)) is None
