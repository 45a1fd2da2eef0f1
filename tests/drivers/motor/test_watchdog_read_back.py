"""A controller whose watchdog is off, or other than robot.toml declares, is refused in words where it can be asked."""

import struct
from dataclasses import replace

import pytest

from disco_hw.runtime.preflight import Level, check_watchdog
from drivers.motor import find_driver
from drivers.motor.vesc_codec import timeout
from drivers.types import DriverState
from tests.drivers.motor.bench import IDLE_STATES
from tests.drivers.motor.vendors import BY_LABEL

ODRIVE = replace(BY_LABEL["odrive-0.6"], changes="watchdog_endpoints = [220, 221]\n")
VESC = BY_LABEL["vesc"]


def vescs(bench):
    return [vesc for side in bench.robot.controller.sides for vesc in side]


def set_vesc(name, value):
    return lambda bench: setattr(vescs(bench)[1], name, value)


def set_odrive(number, value):
    return lambda bench: bench.robot.controller.boards[1].parameters.update({number: value})


@pytest.mark.parametrize(
    ("vendor", "change", "expected_detail"),
    [
        (VESC, set_vesc("timeout_ms", 0), "controller 51: its timeout is off"),
        (VESC, set_vesc("timeout_ms", 1000), "controller 51: its timeout is 1 s; set 0.1 s there"),
        (VESC, set_vesc("timeout_brake_current_a", 30.0), "brakes with 30 A"),
        (
            ODRIVE,
            set_odrive(220, bytes(4)),
            "node 5: its watchdog is off; set axis0.config.enable_watchdog and call odrv0.save_configuration()",
        ),
        (ODRIVE, set_odrive(221, struct.pack("<f", 2.0)), "node 5: its watchdog is set to 2 s; set it to 0.1 s"),
        (
            ODRIVE,
            lambda bench: bench.robot.controller.boards[0].parameters.clear(),
            "node 3 does not report its watchdog; correct link.watchdog_endpoints",
        ),
    ],
    ids=str,
)
def test_a_controller_whose_watchdog_is_another_or_not_where_it_should_be_is_refused(vendor, change, expected_detail):
    bench = vendor.bench()
    change(bench)
    bench.run_until(DriverState.REFUSED)
    assert expected_detail in bench.driver.detail
    assert bench.driver.identity is bench.driver.limits is None
    assert not [frame for frame in bench.robot.received if vendor.is_motion(frame)]


def test_the_safety_card_says_that_the_watchdog_was_not_read_back_only_where_it_is_not():
    declared, read_back = (find_driver("odrive").safety_card(one.settings) for one in (BY_LABEL["odrive-0.6"], ODRIVE))
    assert "watchdog (0.1 s), velocity limit and heartbeat" in " ".join(declared.unverified)
    assert "watchdog (" not in " ".join(read_back.unverified)
    assert "velocity limit and heartbeat period are declared" in " ".join(read_back.unverified)


def test_a_vesc_that_does_not_answer_is_driven_as_declared_and_said_to_be():
    bench = VESC.bench()
    for vesc in vescs(bench):
        obey = vesc._obey
        vesc._obey = lambda payload, behind, obey=obey: (None, []) if payload[:1] == b"\x11" else obey(payload, behind)
    bench.arm()
    assert check_watchdog(bench.driver.limits).level is Level.WARNING


@pytest.mark.parametrize("payload", [b"", b"\x11", struct.pack(">BIBIf", 17, 1, 24, 100, 0.0), b"\x32" + bytes(20)])
def test_settings_of_another_layout_or_controller_are_not_used(payload):
    assert timeout(payload, 23) is None


@pytest.mark.parametrize(
    ("vendor", "level", "expected_text"),
    [
        (BY_LABEL["odrive-0.5"], Level.WARNING, "could not be read back"),
        (ODRIVE, Level.OK, "reported by the controller"),
        (VESC, Level.OK, "reported by the controller"),
        (BY_LABEL["agilex"], Level.OK, "cannot be set otherwise"),
        (BY_LABEL["roboclaw"], Level.OK, "reported by the controller"),
    ],
)
def test_the_check_says_whether_it_was_read_back(vendor, level, expected_text):
    bench = vendor.bench()
    bench.run_until(*IDLE_STATES)
    found = check_watchdog(bench.driver.limits)
    assert (found.level, expected_text in found.text) == (level, True)
    bench.arm()
