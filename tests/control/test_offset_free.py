"""Tests that what no parameter explains leaves no offset: losses of the wheels, and drives on foreign robots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.control import DiscoSettings, PlannerState, SentCommand
from disco_hw.control.wheel_loss import LARGEST_RAD_S, WheelLoss
from tools.foreign_plant import NOMINAL, ForeignRobot
from tools.tracking import LIMITS, Contender, Disco, drive, model, tracks

KEEP = float(np.exp(-0.02 / 0.15))


def losing(lost, turn, wanted_at, periods):
    """The losses found of a robot whose wheels lose `lost` (rad/s), and `turn` of half their difference."""
    loss, speeds = WheelLoss(), np.zeros(2)

    def after(wheels, gap_s, state):
        wanted = np.array([[state.sent[-1].left_rad_s, state.sent[-1].right_rad_s]])
        return tuple(loss.acting(wanted)[0] * (1.0 - KEEP) + KEEP * np.array(wheels))

    for k in range(periods):
        wanted = wanted_at(k)
        sent = (SentCommand(0, *wanted.tolist()),)
        loss.step(20_000_000 * k, PlannerState(20_000_000 * k, 0.0, 0.0, 0.0, *speeds.tolist(), sent=sent), after)
        apart = turn * np.clip(0.5 * (wanted[1] - wanted[0]), -1.0, 1.0)
        loaded = wanted + np.array([apart, -apart])
        speeds = (loaded - np.clip(loaded, -1.0, 1.0) * lost) * (1.0 - KEEP) + KEEP * speeds
    return loss


@pytest.mark.parametrize("lost", [(0.2, 0.2), (-0.2, 0.15), (0.0, 0.3)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_either_wheel_loses_is_found_in_either_direction(lost, sign):
    def to_either_side(k):
        return sign * np.array([2.0, 4.0] if k // 100 % 2 else [4.0, 2.0])

    loss = losing(lost, 0.0, to_either_side, 600)
    assert loss.rad_s.tolist() == pytest.approx(list(lost), abs=0.02)
    assert loss.turn_rad_s == pytest.approx(0.0, abs=0.02)
    commands = np.array([[0.0, 0.0], [0.3, -0.3], [2.0, -2.0], [5.0, 5.0], [0.1, 4.0]])
    assert loss.commanded(loss.acting(commands)) == pytest.approx(commands)


@pytest.mark.parametrize("wanted", [(0.0, 3.2), (3.0, 0.1), (-2.5, 0.0), (2.0, 5.0)])
def test_an_inner_wheel_that_the_robot_drags_along_is_planned_with(wanted):
    loss = losing((0.0, 0.0), 0.4, lambda k: np.array(wanted), 500)
    half = 0.5 * (wanted[1] - wanted[0])
    apart = 0.4 * min(max(half, -1.0), 1.0)
    assert loss.acting(np.array([wanted]))[0] == pytest.approx([wanted[0] + apart, wanted[1] - apart], abs=0.02)
    straight = np.array([[0.0, 0.0], [4.0, 4.0]])
    assert loss.acting(straight)[0] == pytest.approx([0.0, 0.0])
    assert loss.commanded(loss.acting(np.array([wanted]))) == pytest.approx(np.array([wanted]))


def test_what_turning_takes_is_told_from_what_the_wheels_lose():
    def weaving(k):
        return np.array([(2.0, 4.0), (4.0, 2.0), (3.0, 3.0)][k // 100 % 3])

    loss = losing((0.2, 0.1), 0.3, weaving, 900)
    assert loss.rad_s.tolist() == pytest.approx([0.2, 0.1], abs=0.02)
    assert loss.turn_rad_s == pytest.approx(0.3, abs=0.02)


def test_a_wheel_that_is_held_does_not_wind_the_loss_up():
    loss = WheelLoss()
    for k in range(500):
        sent = (SentCommand(0, 3.0, 3.0),)
        state = PlannerState(20_000_000 * k, 0.0, 0.0, 0.0, 0.0, 0.0, sent=sent)
        loss.step(20_000_000 * k, state, lambda wheels, gap_s, state: (3.0, 3.0))
    assert loss.rad_s.tolist() == [LARGEST_RAD_S, LARGEST_RAD_S]


EFFECTS = {
    "slope": {"slope_m_s": 0.02},
    "payload": {"mass_kg": 100.0, "inertia_kg_m2": 8.0, "x_icr_m": 0.21},
    "unequal wheels": {"left_gain": 0.95},
    "slower lag": {"lag_s": 0.25},
    "wider dead band": {"dead_rad_s": 0.5},
    "narrower dead band": {"dead_rad_s": 0.1},
}


@pytest.mark.long
@pytest.mark.parametrize("way", ["circle", "eight"])
@pytest.mark.parametrize("effect", EFFECTS)
def test_no_effect_leaves_more_than_four_millimetres(effect, way):
    nominal = ForeignRobot(*NOMINAL)
    settings = replace(DiscoSettings.for_speed(0.2, 50.0), offset_free=True)

    def planner(robot, track):
        return Disco(model(nominal), track.task, settings, LIMITS, 1)

    contender = Contender(planner, learns=True, offset_free=True)
    found = drive(contender, replace(nominal, **EFFECTS[effect]), tracks()[way]).after()
    assert abs(found.signed_mm) < 4.0, found.rms_mm
