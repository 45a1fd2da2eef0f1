"""A schedule carried out: on the robot, on a simulated bus and on a serial line."""

import pytest

from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import OptionError, _check_faults
from sim.fault_player import FaultPlayer
from sim.fault_schedule import KINDS, parse_schedule
from sim.plant import Plant
from sim.simulated_can import SimulatedCan
from sim.virtual_robot import VirtualRobot

MS = 1_000_000


class Rig:
    def __init__(self, *faults, processes=None):
        self.schedule = parse_schedule("".join(f"[[fault]]\n{fault}\n" for fault in faults))
        self.robot = VirtualRobot(Plant(), FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0))
        self.can = SimulatedCan()
        self.can.host.open()
        self.told = []
        self.player = FaultPlayer(self.schedule, self.robot, self.can, 0, self.told.append, processes)
        self.ms = 0
        self.heard = []

    def run(self, until_ms):
        while self.ms < until_ms:
            self.ms += 1
            self.can.advance(self.ms * MS)
            self.heard += [received.frame.can_id for received in self.can.host.receive()]
            self.can.send(self.robot.step(self.ms * 1000, self.can.error_counters))
            self.player.step(self.ms * MS)


def test_one_way_loss_silences_one_side_and_ends():
    rig = Rig('kind="one_way"\nat_s=0.1\nfor_s=0.1\nto="host"')
    rig.run(100)
    assert rig.heard
    rig.heard.clear()
    rig.run(199)
    assert len(rig.heard) <= 1
    rig.run(300)
    assert len(rig.heard) > 20
    assert rig.told == ["fault 1 begins: one_way to=host", "fault 1 ends: one_way"]
    assert rig.player.frames.struck[1] > 20


def test_unplugged_in_mid_frame_a_frame_breaks_and_the_line_is_gone_for_so_long():
    rig = Rig('kind="unplug_mid_frame"\nat_s=0.1\nfor_s=0.1')
    rig.run(150)
    assert rig.can.bus.error_frames == 1
    assert rig.can.host.node is None
    rig.run(220)
    assert rig.can.host.generation == 2


def test_the_controller_restarts_and_says_why():
    rig = Rig('kind="brown_out"\nat_s=0.1')
    rig.run(99)
    clock = rig.robot.device_us(99_000)
    rig.run(150)
    assert rig.robot.device_us(150_000) < clock
    assert rig.robot.outputs.fault != 0


@pytest.mark.parametrize("step_s", [5.0, -5.0])
def test_the_clock_jumps_but_never_before_its_beginning(step_s):
    rig = Rig(f'kind="clock_jump"\nat_s=0.1\nstep_s={step_s}')
    rig.run(99)
    before = rig.robot.device_us(99_000)
    rig.run(101)
    assert rig.robot.device_us(101_000) - before == pytest.approx(step_s * 1e6 + 2000, abs=5)
    rig.robot.jump_clock(-(10**15))
    assert rig.robot.device_us(101_000) == 10_000_000


def test_button_and_babble_are_taken_back():
    rig = Rig('kind="estop_button"\nat_s=0.1\nfor_s=0.1', 'kind="babble"\nat_s=0.1\nfor_s=0.1\nid=0x7ff\nrate_hz=500')
    rig.run(150)
    assert rig.robot.estop_button
    assert 0x7FF in rig.heard
    rig.run(205)
    rig.heard.clear()
    rig.run(300)
    assert not rig.robot.estop_button
    assert 0x7FF not in rig.heard


def test_of_two_faults_of_a_kind_at_once_the_end_of_one_leaves_the_other():
    rig = Rig(
        'kind="estop_button"\nat_s=0.05\nfor_s=0.3',
        'kind="estop_button"\nat_s=0.1\nfor_s=0.05',
        'kind="babble"\nat_s=0.05\nfor_s=0.3\nid=0x7fe\nrate_hz=500',
        'kind="babble"\nat_s=0.1\nfor_s=0.05\nid=0x7ff\nrate_hz=500',
    )
    rig.run(200)
    assert rig.robot.estop_button
    rig.heard.clear()
    rig.run(300)
    assert rig.robot.estop_button
    assert 0x7FE in rig.heard
    assert 0x7FF not in rig.heard
    rig.run(400)
    rig.heard.clear()
    rig.run(450)
    assert not rig.robot.estop_button
    assert 0x7FE not in rig.heard


@pytest.mark.parametrize("second", ["unplug", "unplug_mid_frame"])
def test_a_line_that_is_out_comes_back_no_sooner_for_a_second_fault(second):
    rig = Rig('kind="unplug"\nat_s=0.05\nfor_s=0.3', f'kind="{second}"\nat_s=0.1\nfor_s=0.05')
    rig.run(340)
    assert rig.can.host.node is None
    rig.run(420)
    assert rig.can.host.node is not None


def test_a_line_may_be_out_for_hours():
    rig = Rig('kind="unplug"\nat_s=0.05\nfor_s=5000')
    rig.run(100)
    assert rig.can.host.node is None
    assert rig.told == ["fault 1 begins: unplug"]


class Processes:
    def __init__(self):
        self.told = []

    def begin(self, fault):
        self.told.append(("+", fault.kind.name))

    def end(self, fault):
        self.told.append(("-", fault.kind.name))


def test_faults_of_processes_go_to_whoever_has_them_in_hand():
    processes = Processes()
    rig = Rig('kind="sigstop"\nat_s=0.01\nfor_s=0.01', 'kind="drop"\nat_s=0.01\nfor_s=0.01', processes=processes)
    rig.run(50)
    assert processes.told == [("+", "sigstop"), ("-", "sigstop")]


@pytest.mark.parametrize(
    ("kind", "link", "interface", "words"),
    [
        ("sigkill", "can", "unixcan", "tests/hil"),
        ("babble", "serial", "", "CAN bus"),
        ("bus_off", "serial", "", "CAN bus"),
        ("drop", "can", "socketcan", "unixcan"),
    ],
)
def test_what_the_simulator_cannot_do_is_refused(kind, link, interface, words):
    lasts = "for_s=1" if KINDS[kind].lasts else ""
    schedule = parse_schedule(f'[[fault]]\nkind="{kind}"\nat_s=0\n{lasts}')
    with pytest.raises(OptionError, match=words):
        _check_faults(schedule, link, interface)
