"""Drives on foreign robots that differ from the model in ways that the geometry does not explain."""

from __future__ import annotations

from dataclasses import replace

import pytest

from disco_hw.control import DiscoSettings
from tools.foreign_plant import NOMINAL, ForeignRobot
from tools.tracking import disco, drive, tracks

EFFECTS = {
    "slope": {"slope_m_s": 0.02},
    "payload": {"mass_kg": 100.0, "inertia_kg_m2": 8.0, "x_icr_m": 0.21},
    "unequal wheels": {"left_gain": 0.95},
    "slower lag": {"lag_s": 0.25},
    "wider dead band": {"dead_rad_s": 0.5},
    "narrower dead band": {"dead_rad_s": 0.1},
}


@pytest.mark.long
def test_a_body_that_slides_late_stays_on_a_slalom():
    contender = disco(DiscoSettings.for_speed(0.3, 50.0), learns=True)
    robot = replace(ForeignRobot(*NOMINAL), side_s=0.08)
    assert drive(contender, robot, tracks(0.3)["slalom"]).after().rms_mm < 4.0


@pytest.mark.long
@pytest.mark.parametrize("way", ["circle", "eight"])
@pytest.mark.parametrize("effect", EFFECTS)
def test_no_effect_leaves_more_than_four_millimetres(effect, way):
    contender = disco(DiscoSettings.for_speed(0.2, 50.0), learns=True)
    robot = replace(ForeignRobot(*NOMINAL), **EFFECTS[effect])
    driven = drive(contender, robot, tracks()[way])
    assert abs(driven.after().signed_mm) < 4.0
    # A slope is found on the way.
    assert driven.after(20.0).rms_mm < 4.0
