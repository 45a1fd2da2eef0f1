"""Tests of a vendor's motor loop with a wrong encoder, and that a sound one changes nothing."""

import pytest

from firmware_protocol.firmware_core import FirmwareInputs
from sim.encoder_loop import EncoderLoop, EncoderUse

FULL_RAD_S = 20.0


def speeds(left, right=1.0):
    return FirmwareInputs(left_ticks=0, right_ticks=0, left_speed_rad_s=left, right_speed_rad_s=right)


def driven(use, reports, seconds, target_rad_s=0.5, regulates=True):
    """What the left motor is driven at, after a motor that follows at once was reported so."""
    loop, true = EncoderLoop(use, FULL_RAD_S), target_rad_s
    for _ in range(round(seconds * 1000)):
        loop.see((target_rad_s, 1.0), speeds(true), speeds(reports(true)), 1e-3, regulates)
        true = loop.drive((target_rad_s, 1.0))[0]
    return loop.drive((target_rad_s, 1.0))


@pytest.mark.parametrize("use", EncoderUse)
def test_a_sound_encoder_leaves_the_wanted_speeds_as_they_are(use):
    assert driven(use, lambda true: true, 1.0) == (0.5, 1.0)


@pytest.mark.parametrize("reports", [lambda true: 0.0, lambda true: -true], ids=["frozen", "reversed"])
def test_a_wrong_encoder_makes_a_speed_loop_run_away_and_locks_a_commutated_motor(reports):
    assert driven(EncoderUse.SPEED, reports, 0.3)[0] > 1.5
    assert driven(EncoderUse.SPEED, reports, 5.0) == (FULL_RAD_S, 1.0)
    assert driven(EncoderUse.COMMUTATION, reports, 1.0) == (0.0, 1.0)


def test_a_loop_that_is_let_go_forgets_what_it_wound_up():
    loop = EncoderLoop(EncoderUse.SPEED, FULL_RAD_S)
    for _ in range(1000):
        loop.see((0.5, 1.0), speeds(5.0), speeds(0.0), 1e-3, True)
    loop.see((0.5, 1.0), speeds(5.0), speeds(0.0), 1e-3, False)
    assert loop.drive((0.5, 1.0)) == (0.5, 1.0)
