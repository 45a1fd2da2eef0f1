"""The robot in MuJoCo: it shares nothing with ours, behaves as such robots do, and what is hidden in it is there."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools import joystick as people
from tools import mujoco_robot
from tools.joystick import COMMANDS_PER_S, STEPS_PER_S, joystick, keyboard
from tools.mujoco_robot import EFFECTS, ROBOTS, TRACK_M, WHEEL_RADIUS_M, Habits, driven, record

pytestmark = pytest.mark.thorough

pytest.importorskip("mujoco", reason="pip install 'disco-hw[mujoco]'")

ROOT = Path(__file__).parents[2]
SOURCES = [Path(module.__file__) for module in (mujoco_robot, people)]
PER_S = COMMANDS_PER_S
# Counts, halves and powers of ten say nothing of where they come from.
NEUTRAL = {0.5, *map(float, range(13))} | {10.0**power for power in range(-9, 10)}


def numbers(source: str) -> set[float]:
    """Every number in a source, those in its texts too, without its sign."""
    found: set[float] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            found.add(abs(float(node.value)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {float(text) for text in re.findall(r"(?<![\w.])\d+\.?\d*(?:e-?\d+)?(?![\w.])", node.value)}
    return found - NEUTRAL


def constant_commands(left_rad_s: float, right_rad_s: float, seconds: float = 4.0) -> np.ndarray:
    return np.tile([left_rad_s, right_rad_s], (round(seconds * PER_S), 1))


def steady(recording: mujoco_robot.Recording) -> tuple[np.ndarray, float]:
    """Speeds of the wheels (4,) and yaw rate over the last two seconds, rad/s."""
    settled = recording.truth_s > recording.truth_s[-1] - 2.0
    slope = np.polyfit(recording.truth_s[settled], np.c_[recording.turned, recording.truth[:, 2]][settled], 1)[0]
    return slope[:4], float(slope[4])


def test_it_shares_no_constant_and_no_code_with_our_simulator_and_model():
    source = "\n".join(file.read_text().replace("from __future__ import annotations", "") for file in SOURCES)
    ours = [file for room in ("sim", "disco_hw/model", "disco_hw/effects") for file in (ROOT / room).rglob("*.py")]
    assert len(ours) > 40
    constants = numbers(source)
    both = {file.name: constants & numbers(file.read_text()) for file in ours}
    assert not {name: shared for name, shared in both.items() if shared}
    imported = re.findall(r"^ *(?:from|import) ([\w.]+)", source, re.MULTILINE)
    strange = ("sim", "disco_hw.model", "disco_hw.effects", "tools")
    assert [name for name in imported if name.startswith(strange)] == ["tools.joystick"]


def test_constants_that_are_shared_would_be_seen():
    assert numbers('X = 0.238\ny = \'<geom size="0.061 .1" mass="-20"/>\'') == {0.238, 0.061, 20.0}


@pytest.mark.parametrize("wheels", [(-2.0, 2.0), (-4.0, 4.0), (1.0, 3.0), (4.5, 2.5)])
def test_it_turns_as_skid_steer_robots_do(wheels):
    """Effective over geometric track of published robots: 1.3 to 2.6."""
    speeds, yaw_rate = steady(record({}, 1, constant_commands(*wheels)))
    rolled = WHEEL_RADIUS_M * (speeds[[1, 3]].mean() - speeds[[0, 2]].mean())
    assert 1.3 < rolled / yaw_rate / TRACK_M < 2.6
    # The contact holds the turn up, and the servos droop equally, however fast they are asked to turn.
    short = abs(wheels[1] - wheels[0]) - abs(speeds[[1, 3]].mean() - speeds[[0, 2]].mean())
    assert 0.34 < short / 2.0 < 0.44


@pytest.mark.parametrize("name", ["heavy", "light"])
def test_robots_of_other_sizes_turn_so_too(name):
    robot = ROBOTS[name]
    for wheels in [(-4.0, 4.0), (1.0, 3.0)]:
        speeds, yaw_rate = steady(record({}, 1, constant_commands(*wheels), robot))
        rolled = robot.wheel_radius_m * (speeds[[1, 3]].mean() - speeds[[0, 2]].mean())
        assert 1.3 < rolled / yaw_rate / robot.track_m < 2.6
    speeds, _ = steady(record({"unequal_wheels": robot.size("unequal_wheels")}, 1, constant_commands(3.0, 3.0), robot))
    assert speeds[0] / speeds[1] == pytest.approx(1.0 + robot.size("unequal_wheels"), rel=0.005)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_it_stands_where_it_stands(robot):
    recording = record({}, 1, constant_commands(0.0, 0.0), robot)
    assert np.abs(recording.truth - recording.truth[0]).max() < 1e-4
    assert np.abs(recording.turned).max() < 1e-3


def test_wheels_settle_at_their_command_on_a_straight():
    speeds, yaw_rate = steady(record({}, 1, constant_commands(3.0, 3.0)))
    assert speeds == pytest.approx([3.0] * 4, rel=0.005)
    assert abs(yaw_rate) < 1e-3


def test_what_is_measured_is_the_truth_and_the_noise_that_is_stated():
    recording = record({}, 3, joystick(3, 22.0))
    seen = np.column_stack([np.interp(recording.pose_s, recording.truth_s, each) for each in recording.truth.T])
    off = recording.pose - seen
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    assert off == pytest.approx(recording.noise, abs=1e-9)
    stated = [mujoco_robot.POSITION_STD_M, mujoco_robot.POSITION_STD_M, mujoco_robot.YAW_STD_RAD]
    assert off.std(axis=0) == pytest.approx(stated, rel=0.15)
    assert np.ptp(recording.truth[:, :2]) > 1.0


def test_a_robot_is_driven_and_logged_as_its_habits_say():
    robot = replace(ROBOTS["middle"], habits=Habits(9.0, 0.6, True, 2, 3, 2, 0.004, 0.1))
    command = driven(robot, 7)
    assert command.shape == (9 * PER_S, 2)
    assert (command[::2] == command[1::2]).all()
    assert np.abs(command).max() <= 0.6 * robot.top_rad_s
    rare, all_there = record({}, 7, robot=robot), record({}, 7, command)
    assert rare.turned == pytest.approx(all_there.turned)
    assert (rare.command == command[::2]).all()
    # Stamps are late, never early, by half a normal distribution, and in order.
    delay_s = rare.command_s - np.arange(rare.command_s.size) * 2 / PER_S
    assert (delay_s >= 0.0).all()
    assert np.sqrt((delay_s**2).mean()) == pytest.approx(0.004, rel=0.15)
    for times_s, period_s in ((rare.wheel_s, 24 / STEPS_PER_S), (rare.pose_s, 32 / STEPS_PER_S)):
        assert (np.diff(times_s) >= 0.0).all()
        assert 0.84 < times_s.size * period_s / 9.0 < 0.96
    # What is logged is of the truth a moment before its stamp.
    then = np.column_stack([np.interp(rare.pose_s, rare.truth_s, each) for each in rare.truth.T[:2]])
    fastest_m_s = np.abs(command).max() * WHEEL_RADIUS_M
    assert np.abs(rare.pose[:, :2] - rare.noise[:, :2] - then).max() < 0.02 * fastest_m_s


def test_keys_are_held_and_a_stick_never_stays():
    keys, stick = keyboard(3, 20.0, 5.0), joystick(3, 20.0, 5.0)
    assert keys.shape == stick.shape == (20 * PER_S, 2)
    changes = [int(np.count_nonzero(np.abs(np.diff(each, axis=0)).max(axis=1) > 1e-9)) for each in (keys, stick)]
    assert 4 < changes[0] < 29
    assert changes[1] > 300
    assert np.abs(keys - keyboard(4, 20.0, 5.0)).max() > 0.1
    # Forward, back and both ways round, each at times.
    ways = set(map(tuple, np.sign(keyboard(3, 200.0, 5.0)).tolist()))
    assert {(-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (0.0, 0.0)} <= ways


def test_a_delay_and_a_latency_are_there_to_the_step():
    command = joystick(2, 6.0)
    plain = record({}, 2, command)
    steps = round(0.145 * STEPS_PER_S)
    delayed = record({"command_delay": 0.145}, 2, command)
    assert delayed.turned[steps:] == pytest.approx(plain.turned[:-steps], abs=1e-6)
    assert np.abs(plain.turned).max() > 1.0
    stamped = record({"pose_latency": 0.21}, 2, command)
    assert stamped.pose_s == pytest.approx(plain.pose_s[: stamped.pose_s.size] + 0.21)
    assert np.array_equal(stamped.pose, plain.pose[: stamped.pose_s.size])


def test_each_other_effect_does_what_it_says():
    straight, spin = constant_commands(3.0, 3.0, 3.0), constant_commands(-4.0, 4.0, 3.0)
    plain, turning = record({}, 1, straight), record({}, 1, spin)
    for name in ("dead_band", "dry_friction"):
        speeds, _ = steady(record({name: 0.57}, 1, straight))
        assert speeds == pytest.approx([3.0 - 0.57] * 4, rel=0.005)
        assert np.abs(record({name: 0.57}, 1, constant_commands(0.3, -0.5)).turned).max() < 0.2
    # Friction goes on while a command ends, what a drive ignores is a matter of commands alone.
    ends = np.concatenate([constant_commands(3.0, 3.0, 2.0), constant_commands(0.0, 0.0, 1.0)])
    ignoring, rubbing = (record({name: 0.57}, 1, ends).turned[-1, 0] for name in ("dead_band", "dry_friction"))
    assert rubbing < ignoring - 0.01
    lagging = record({"motor_lag": 0.23}, 1, straight)
    # What a lag costs of the way is the speed times its growth.
    assert plain.turned[-1] - lagging.turned[-1] == pytest.approx(3.0 * (0.23 - 0.037), rel=0.03)
    speeds, _ = steady(record({"unequal_wheels": 0.042}, 1, straight))
    assert speeds[0] / speeds[1] == pytest.approx(1.042, rel=0.005)
    assert record({"slope": 5.7}, 1, constant_commands(0.0, 0.0)).truth[-1, 0] > 0.01
    assert abs(steady(record({"torque_limit": 5.7}, 1, spin))[1]) < 0.95 * abs(steady(turning)[1])
    # Gently: at a blow the tyres slip.
    reversals = 2.0 * np.tile(np.sin(np.arange(6.0 * PER_S) / PER_S * 2.0), (2, 1)).T

    def play(hidden: mujoco_robot.Hidden) -> float:
        """Within what the wheels' angles, from the motors, are off the way that was driven, in rad."""
        driven = record(hidden, 1, reversals)
        return float(np.ptp(driven.turned.mean(axis=1) - driven.truth[:, 0] / WHEEL_RADIUS_M))

    assert play({"backlash": 0.11}) - play({}) == pytest.approx(0.11, rel=0.2)
    for name in ("payload", "worn_tyre"):
        moved = record({name: EFFECTS[name][0]}, 1, spin).truth[-1] - turning.truth[-1]
        assert np.hypot(*moved[:2]) > 0.02
