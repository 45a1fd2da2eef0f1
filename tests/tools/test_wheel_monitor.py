"""The monitor sees what it is there for: each violation that it can see, committed once."""

import pytest
from msgspec.structs import replace

from drivers.types import Frame
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareOutputs
from tools.faults.wheel_monitor import WheelMonitor, crc8h2f, read_command

BASE = FirmwareOutputs(0.0, 0.0, True, False, False, "ARMED", 0, 7, "NONE", "NONE", 0, 10, 0, 0, 0)
CODEC = Codec()
STEP_US = 5000


def command(left, right, counter=1, session=7):
    can_id, data = CODEC.encode(
        "WHEEL_COMMAND", counter, mode="SPEED", left_speed=left, right_speed=right, valid_for=0.1, session=session
    )
    return Frame(can_id, data)


class Scene:
    def __init__(self, **start):
        self.monitor = WheelMonitor()
        self.us = 0
        self.outputs = replace(BASE, **start)
        self.monitor.see(0, [], self.outputs, (0.0, 0.0))
        self.accept(command(*self.setpoints))

    @property
    def setpoints(self):
        return self.outputs.left_setpoint_rad_s, self.outputs.right_setpoint_rad_s

    def step(self, *frames, wheels=(0.0, 0.0), **changes):
        self.us += STEP_US
        self.outputs = replace(self.outputs, **changes)
        self.monitor.see(self.us, frames, self.outputs, wheels)
        return self.monitor.violations

    def accept(self, frame, **changes):
        return self.step(frame, accepted_commands=self.outputs.accepted_commands + 1, **changes)


def test_check_value_and_layout():
    assert crc8h2f(b"123456789") == 0xDF
    read = read_command(0x100, command(1.5, -0.75, counter=3).data)
    assert (read.counter, read.speeds, read.session, read.mode) == (3, (1.5, -0.75), 7, 1)
    assert read_command(0x100, command(1.5, -0.75).data[:7]) is None
    assert read_command(0x100, bytes(8)) is None


def test_a_robot_that_obeys_is_left_alone():
    scene = Scene()
    for k in range(2, 12):
        ramp = 0.1 * (k - 1)
        assert scene.accept(command(2.0, 2.0, k), left_setpoint_rad_s=ramp, right_setpoint_rad_s=ramp) == []
    for k in range(1, 11):
        ramp = max(0.0, 1.0 - 0.1 * k)
        changes = {"left_setpoint_rad_s": ramp, "right_setpoint_rad_s": ramp}
        assert scene.step(state="STOPPING", wheels=(1.0, 1.0), **changes) == []


@pytest.mark.parametrize(
    ("commit", "expected_text"),
    [
        (lambda s: s.accept(Frame(0x100, bytes(8))), "have a proof"),
        (lambda s: s.step(accepted_commands=99), "have a proof"),
        (lambda s: s.accept(command(1, 1, 2, session=9)), "have a proof"),
        (lambda s: s.accept(command(0, 0, 1)), "repeated"),
        (lambda s: s.accept(command(1, 1, 2), left_setpoint_rad_s=0.5), "in 0.005 s"),
        (lambda s: s.accept(command(1, 1, 2), left_setpoint_rad_s=-0.05), "asked was"),
        (lambda s: s.step(left_setpoint_rad_s=9.0), "beyond 8"),
        (lambda s: s.step(left_setpoint_rad_s=float("nan")), "beyond 8"),
        (lambda s: s.step(state="STANDBY", left_setpoint_rad_s=0.05), "in STANDBY"),
        (lambda s: s.accept(command(1, 1, 2), left_setpoint_rad_s=0.1, driver_enabled=False), "driver off"),
        (lambda s: [s.step() for _ in range(23)], "ARMED 0.1"),
        (lambda s: [s.step(state="STANDBY") for _ in range(104)], "driver is on"),
        (
            lambda s: [s.step(wheels=(1.0, 0.0), state="STANDBY", driver_enabled=False) for _ in range(130)],
            "wheels turn",
        ),
    ],
)
def test_each_violation_is_reported(commit, expected_text):
    scene = Scene()
    commit(scene)
    assert any(expected_text in text for text in scene.monitor.violations), scene.monitor.violations


@pytest.mark.parametrize(("cycles_armed", "reported"), [(21, False), (24, True)])
def test_the_watchdog_runs_from_the_instant_of_arming(cycles_armed, reported):
    scene = Scene(state="READY", driver_enabled=False)
    for _ in range(3):
        scene.step()
    for _ in range(cycles_armed):
        scene.step(state="ARMED", driver_enabled=True)
    assert any("ARMED 0.1" in text for text in scene.monitor.violations) is reported, scene.monitor.violations


def test_an_arming_without_a_command_shortly_before_is_reported():
    scene = Scene(state="READY", driver_enabled=False)
    for _ in range(23):
        scene.step()
    assert scene.monitor.violations == []
    scene.step(state="ARMED", driver_enabled=True)
    assert any("armed 0.120 s after" in text for text in scene.monitor.violations), scene.monitor.violations


def test_a_stop_that_does_not_slow_down_is_reported():
    scene = Scene(left_setpoint_rad_s=2.0, right_setpoint_rad_s=2.0)
    for _ in range(5):
        scene.step(state="STOPPING")
    assert any("is due" in text for text in scene.monitor.violations)


def test_a_command_of_an_ended_session_is_reported():
    scene = Scene()
    scene.step(state="STOPPING", driver_enabled=False)
    scene.accept(command(0.0, 0.0, 2), state="STANDBY")
    assert any("ended session 7" in text for text in scene.monitor.violations)


def test_after_a_restart_nothing_is_held_against_the_new_controller():
    scene = Scene(left_setpoint_rad_s=2.0, right_setpoint_rad_s=2.0)
    scene.monitor.restarted()
    scene.step(state="BOOT", driver_enabled=False, left_setpoint_rad_s=0.0, right_setpoint_rad_s=0.0, session=0)
    assert scene.monitor.violations == []
