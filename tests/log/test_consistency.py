"""A log that contradicts itself is told apart from a sound one, with the most likely cause."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from disco_hw.errors import LogError
from disco_hw.log.consistency import find_contradictions, refuse_contradictions
from disco_hw.log.contradictions import Contradiction
from disco_hw.log.drive import concatenate
from disco_hw.log.load import load_drive
from sim.effects import EFFECTS
from tests.log.contradictory_drives import AXIAL_M, FAULTS, RADIUS_M, rotated, sound, without_commands
from tests.tables import thinned
from tools.gap.logs import realistic, simulated_drive

REAL = os.environ.get("DISCO_HW_DATA")
# Nominal wheel radius and axial distance (m) by the beginning of a file's name.
REAL_ROBOTS = {
    "husky_tile": (0.161827, 0.480865),
    "husky_lifted": (0.15875, 0.53846),
    "warthog": (0.30, 1.08),
    **dict.fromkeys(("circular", "free", "square"), (0.042, 0.2)),
}


def found(log):
    return find_contradictions(log, RADIUS_M, AXIAL_M)


@thinned("fault", FAULTS, quick=4)
def test_the_cause_is_named_first_with_its_remedy(fault):
    change, cause, hint = FAULTS[fault]
    first, *_ = found(change(sound()))
    assert first.cause == cause
    assert hint in first.message
    assert first.message.startswith("simulated: ")
    assert "\n" not in first.message


@thinned("fault", [name for name in FAULTS if "reversed" in name and "encoder" in name], quick=1)
def test_a_reversed_encoder_is_put_right_without_turning_its_motor_round(fault):
    change, _, _ = FAULTS[fault]
    first, *_ = found(change(sound()))
    # link.direction of a driver turns command and count round together.
    assert "(wheels.encoder_direction)" in first.message
    assert "link." not in first.message
    assert "the columns of a CSV" in first.message


@thinned("drive", ["free", "rich", "random_steps", "straight", "poor", "circle"], quick=2)
def test_a_sound_log_is_sound_also_in_another_frame_and_without_commands(drive):
    log = sound(drive)
    assert found(log) == found(rotated(1.1)(log)) == found(without_commands(log)) == ()


@pytest.mark.parametrize("drive", ["poor", pytest.param("free", marks=pytest.mark.long)])
@thinned("name", EFFECTS, quick=3)
def test_what_a_robot_may_do_is_no_contradiction(name, drive):
    assert found(simulated_drive(realistic(name, 5), seed=5, drive=drive, dirty=True, motors="real")) == ()


def test_a_sound_log_does_not_hide_what_is_wrong_with_another():
    change, cause, _ = FAULTS["y mirrored"]
    wrong = replace(change(sound()), sources=("wrong",))
    (only,) = found(concatenate([sound(), sound("circle"), wrong]))
    assert only.cause == cause
    assert only.message.startswith("wrong: ")


def test_only_what_spoils_what_is_needed_is_refused():
    slight = Contradiction("slight", "a.csv: slight", ())
    of_commands = Contradiction("commands", "a.csv: commands", ("response",))
    assert refuse_contradictions((slight, of_commands), ("body",)) == ("a.csv: slight", "a.csv: commands")
    with pytest.raises(LogError, match=r"^a\.csv: commands$"):
        refuse_contradictions((slight, of_commands), ("body", "response"))


def test_too_short_a_log_contradicts_nothing():
    log = sound()
    few = slice(0, 20)
    wheels = replace(log.wheels, **{name: getattr(log.wheels, name)[few] for name in log.wheels.__slots__[:6]})
    assert found(replace(log, wheels=wheels)) == ()


@pytest.mark.skipif(REAL is None, reason="needs DISCO_HW_DATA, a directory of real logs as CSV")
def test_real_logs_are_sound():
    logs = sorted(Path(REAL or "").glob("**/*.csv"))
    assert logs
    for path in logs:
        radius_m, axial_m = next(values for name, values in REAL_ROBOTS.items() if path.name.startswith(name))
        assert find_contradictions(load_drive(path, 2796.8, radius_m), radius_m, axial_m) == (), path
