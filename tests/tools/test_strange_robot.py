"""The robot with forms that no dictionary holds: it shares nothing with ours, and each form does what its name says."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.tools.test_mujoco_robot import numbers
from tools.gap import strange_robot
from tools.gap.strange_robot import COMMANDS_PER_S, FORMS, NOMINAL, record, sampled_parameters

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]


def constant_commands(*stretches):
    """Commands (N, 2) that are held for some seconds each: (left, right, seconds)."""
    return np.concatenate([np.tile(wheels, (round(seconds * COMMANDS_PER_S), 1)) for *wheels, seconds in stretches])


def speeds(recording, after_s, before_s):
    """Mean wheel speeds (2,) over some time, rad/s."""
    wheels = recording.log.wheels
    part = (wheels.t_s > after_s) & (wheels.t_s < before_s)
    return np.array(
        [np.polyfit(wheels.t_s[part], a[part], 1)[0] for a in (wheels.left_angle_rad, wheels.right_angle_rad)]
    )


def turned(recording, after_s, before_s):
    """True yaw gained over some time, rad."""
    t_s, yaw = recording.log.poses.t_s, recording.truth[:, 2]
    return float(np.interp(before_s, t_s, yaw) - np.interp(after_s, t_s, yaw))


def test_it_shares_no_constant_and_no_code_with_our_simulator_model_and_search():
    source = Path(strange_robot.__file__).read_text()
    rooms = ("sim", "disco_hw/model", "disco_hw/effects", "disco_hw/gap")
    ours = [file for room in rooms for file in (ROOT / room).rglob("*.py")]
    assert len(ours) > 60
    both = {file.name: numbers(source) & numbers(file.read_text()) for file in ours}
    assert not {name: shared for name, shared in both.items() if shared}
    imported = re.findall(r"^ *(?:from|import) ([\w.]+)", source, re.MULTILINE)
    ours = ("sim", "disco_hw.model", "disco_hw.effects", "disco_hw.gap", "tools.simulated")
    assert not [name for name in imported if name.startswith(ours)]


def test_without_a_form_it_rolls_and_turns_as_its_geometry_says():
    recording = record(None, 4, constant_commands((3.0, 3.0, 2.0), (1.0, 5.0, 4.0)))
    assert speeds(recording, 1.0, 1.9) == pytest.approx([3.0, 3.0], abs=0.02)
    rate = turned(recording, 3.0, 5.5) / 2.5
    assert rate == pytest.approx(NOMINAL[0] * 4.0 / NOMINAL[1], rel=0.12)
    seen = np.column_stack([recording.log.poses.x_m, recording.log.poses.y_m, recording.log.poses.yaw_rad])
    off = (seen - recording.truth).std(axis=0)
    assert off == pytest.approx([strange_robot.POSITION_STD_M] * 2 + [strange_robot.YAW_STD_RAD], rel=0.25)


def test_every_form_is_drawn_within_its_ranges_and_moves_the_robot():
    command = constant_commands((3.0, 3.0, 2.0), (1.0, 4.0, 3.0), (0.0, 0.0, 1.0), (-3.0, -1.0, 3.0), (3.0, -3.0, 2.0))
    plain = record(None, 5, command)
    for form, ranges in FORMS.items():
        recording = record(form, 5, command)
        assert recording.values == sampled_parameters(form, 5)
        assert all(low <= recording.values[name] <= high for name, (low, high) in ranges.items())
        assert np.abs(recording.truth - plain.truth).max() > 0.01, form


def test_what_is_hidden_does_what_its_name_says():
    up = record("hysteresis", 6, constant_commands((4.0, 4.0, 2.0), (2.0, 2.0, 2.0)))
    half = up.values["half_width_rad_s"]
    assert speeds(up, 1.0, 1.9)[0] == pytest.approx(4.0 - half, abs=0.01)
    assert speeds(up, 3.0, 3.9)[0] == pytest.approx(2.0 + half, abs=0.01)
    creeping = record("stribeck_friction", 6, constant_commands((0.4, 5.0, 3.0)))
    assert speeds(creeping, 1.0, 2.9) == pytest.approx([0.0, 5.0 - creeping.values["sliding_rad_s"]], abs=0.01)
    both, one = (record("cross_coupled_supply", 6, constant_commands((4.0, other, 6.0))) for other in (4.0, 0.0))
    assert speeds(both, 5.0, 5.9)[0] < speeds(one, 5.0, 5.9)[0] - 0.08
    warm = record("thermal_fade", 6, constant_commands((4.0, 4.0, 40.0)))
    assert speeds(warm, 38.0, 39.9)[0] < 4.0 * (1.0 - 0.4 * warm.values["most_share"]) < speeds(warm, 1.0, 3.0)[0]
    loose = record("backlash", 6, constant_commands((2.0, 2.0, 2.0), (-2.0, -2.0, 2.0)))
    way = np.hypot(*np.diff(loose.truth[:, :2], axis=0).T)
    # The motors turn on through the play while the wheels stand.
    assert np.count_nonzero(way < 1e-5) / 32.7 > 0.5 * loose.values["play_rad"] / 2.0
    delayed = record("rate_dependent_latency", 6, constant_commands((0.0, 0.0, 1.0), (4.0, 4.0, 1.0)))
    wheels = delayed.log.wheels
    begins = wheels.t_s[np.flatnonzero(wheels.left_angle_rad > 1e-3)[0]]
    assert begins - 1.0 == pytest.approx(delayed.values["most_s"] + 0.04, abs=0.03)


def test_what_the_body_does_does_what_its_name_says():
    spin = constant_commands((-3.0, 3.0, 60.0))
    plain, slippery = record(None, 7, spin), record("time_varying_friction", 7, spin)
    ratio = [turned(slippery, t, t + 3) / turned(plain, t, t + 3) for t in range(1, 55, 3)]
    assert max(ratio) - min(ratio) > slippery.values["share"]
    start = constant_commands((0.0, 0.0, 0.5), (-3.0, 3.0, 1.0))
    assert turned(record("tyre_relaxation", 7, start), 0.5, 1.5) < turned(record(None, 7, start), 0.5, 1.5) - 0.05
    arc = constant_commands((2.0, 5.0, 6.0))
    out, plain = record("com_shift", 7, arc), record(None, 7, arc)
    # The load slides outwards, and with it the point about which the robot turns: the arc is wider.
    along = [np.hypot(*np.diff(each.truth[100:, :2], axis=0).T).sum() for each in (out, plain)]
    assert along[0] > 1.004 * along[1]
    rough, even = (
        record("gear_eccentricity", 7, constant_commands((4.0, 4.0, 5.0))),
        record(None, 7, constant_commands((4.0, 4.0, 5.0))),
    )
    wobble = [np.diff(each.truth[40:, 2]).std() for each in (rough, even)]
    assert wobble[0] > 5.0 * wobble[1]
