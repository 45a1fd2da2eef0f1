"""A schedule carried out: on the robot, on a simulated bus and on a serial line."""

import os

import pytest

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import OptionError, VirtualRobotOptions, _check_faults
from sim.fault_player import COMMANDS, CpuHogs, FaultPlayer, Injection
from sim.fault_schedule import KINDS, parse_schedule
from sim.hub import Hub
from sim.plant import Plant
from sim.serial_line import SerialLine
from sim.virtual_robot import TRUTH_COLUMNS, VirtualRobot
from tests.drivers.waiting import wait_until
from tools.faults.in_process import SimulatedCan

MS = 1_000_000


class Rig:
    def __init__(self, *faults, processes=None):
        self.schedule = parse_schedule("".join(f"[[fault]]\n{fault}\n" for fault in faults))
        self.robot = VirtualRobot(Plant(), FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0))
        self.can = SimulatedCan()
        self.can.host.open()
        self.reported = []
        self.player = FaultPlayer(self.schedule, self.robot, self.can, 0, self.reported.append, processes)
        self.ms = 0
        self.received_ids = []

    def run(self, until_ms):
        while self.ms < until_ms:
            self.ms += 1
            self.can.advance(self.ms * MS)
            self.received_ids += [received.frame.can_id for received in self.can.host.receive()]
            self.can.send(self.robot.step(self.ms * 1000, self.can.error_counters))
            self.player.step(self.ms * MS)


def test_one_way_loss_silences_one_side_and_ends():
    rig = Rig('kind="one_way"\nat_s=0.1\nfor_s=0.1\nto="host"')
    rig.run(100)
    assert rig.received_ids
    rig.received_ids.clear()
    rig.run(199)
    assert len(rig.received_ids) <= 1
    rig.run(300)
    assert len(rig.received_ids) > 20
    assert rig.reported == ["fault 1 begins: one_way to=host", "fault 1 ends: one_way"]
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


def test_button_and_babble_are_taken_back_and_of_two_of_a_kind_at_once_the_end_of_one_leaves_the_other():
    rig = Rig(
        'kind="estop_button"\nat_s=0.05\nfor_s=0.3',
        'kind="estop_button"\nat_s=0.1\nfor_s=0.05',
        'kind="babble"\nat_s=0.05\nfor_s=0.3\nid=0x7fe\nrate_hz=500',
        'kind="babble"\nat_s=0.1\nfor_s=0.05\nid=0x7ff\nrate_hz=500',
    )
    babblers = {0x7FE, 0x7FF}
    for until_ms, is_pressed, babbling in ((140, True, babblers), (300, True, {0x7FE}), (450, False, set())):
        rig.run(until_ms - 50)
        rig.received_ids.clear()
        rig.run(until_ms)
        assert rig.robot.estop_button == is_pressed
        assert babblers & set(rig.received_ids) == babbling


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
    assert rig.reported == ["fault 1 begins: unplug"]


class Processes:
    def __init__(self):
        self.reported = []

    def begin(self, fault):
        self.reported.append(("+", fault.kind.name))

    def end(self, fault):
        self.reported.append(("-", fault.kind.name))


def test_faults_of_processes_go_to_whoever_has_them_in_hand():
    processes = Processes()
    rig = Rig('kind="sigstop"\nat_s=0.01\nfor_s=0.01', 'kind="drop"\nat_s=0.01\nfor_s=0.01', processes=processes)
    rig.run(50)
    assert processes.reported == [("+", "sigstop"), ("-", "sigstop")]


@pytest.mark.parametrize(
    ("kind", "options", "expected_error"),
    [
        ("sigkill", {}, "tests/hil"),
        ("babble", {"kind": "serial"}, "CAN bus"),
        ("bus_off", {"kind": "serial"}, "CAN bus"),
        ("drop", {"interface": "socketcan"}, "unixcan"),
        *((kind, {"board": "/dev/tty"}, "--board") for kind in ("drop", "unplug", "sigstop", "reboot")),
    ],
)
def test_what_the_simulator_cannot_do_is_refused(kind, options, expected_error):
    lasts = "for_s=1" if KINDS[kind].lasts else ""
    schedule = parse_schedule(f'[[fault]]\nkind="{kind}"\nat_s=0\n{lasts}')
    with pytest.raises(OptionError, match=expected_error):
        _check_faults(schedule, VirtualRobotOptions(**options))


@pytest.fixture
def robot():
    return VirtualRobot(Plant(), FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0))


@pytest.fixture
def link(tmp_path):
    link = Hub(tmp_path / "hub", 0)
    yield link
    link.close()


@pytest.fixture
def injection(robot, link):
    return Injection(robot, link)


def stepped(injection, link, until_ms):
    """Let time pass; return the frames that came."""
    frames = []
    for now_ms in range(1, until_ms + 1):
        frames += link.advance(now_ms * MS)
        injection.step(now_ms * MS)
    return frames


def test_estop_button(robot, injection):
    assert injection.execute("estop_button on", 0) == "ok"
    step_robot(robot, 1, 4)
    assert robot.outputs.state == "ESTOP"
    assert injection.execute("estop_button off", 0) == "ok"
    assert not robot.estop_button


def step_robot(robot, *range_ms):
    for ms in range(*range_ms):
        robot.step(ms * 1000)


def test_kidnap(robot, injection):
    assert injection.execute("kidnap 0.5 -1 0.25", 0) == "ok"
    truth = robot.plant.truth
    assert (truth.x_m, truth.y_m, truth.yaw_rad) == pytest.approx((0.5, -1.0, 0.25))


def test_babble_at_its_rate_until_asked_to_stop(link, injection):
    assert injection.execute("babble 0x100 200", 0) == "ok"
    frames = stepped(injection, link, 1000)
    assert len(frames) == pytest.approx(200, abs=2)
    assert {received.frame for received in frames} == {Frame(0x100, bytes(8))}
    assert injection.execute("babble 256 0", 1000 * MS) == "ok"
    link.advance(1010 * MS)
    injection.step(2000 * MS)
    assert link.advance(2000 * MS) == []


def test_babble_beyond_the_bit_rate_fills_the_bus_and_no_more(link, injection):
    assert injection.execute("babble 0x001 50000", 0) == "ok"
    frames = stepped(injection, link, 100)
    assert 0.1 * 500_000 / 135 - 35 < len(frames) < 0.1 * 500_000 / 100


def test_reboot(robot, injection):
    step_robot(robot, 1, 100)
    assert injection.execute("reboot watchdog", 0) == "ok"
    step_robot(robot, 100, 101)
    assert robot.outputs.state in {"BOOT", "FAULT"}
    step_robot(robot, 101, 102)
    assert robot.outputs.fault != 0
    assert injection.execute("reboot", 0) == "ok"
    step_robot(robot, 102, 200)
    assert robot.outputs.fault == 0


def test_state_answers_with_a_row_of_the_truth(injection):
    row = dict(zip(TRUTH_COLUMNS, injection.execute("state", 42).split(","), strict=True))
    assert row["t_ns"] == "42"
    assert row["state"] == "BOOT"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not a command"),
        ("explode", "'explode' is not a command; write one of bus_off, unplug"),
        ("unplug", "0 arguments given; usage: unplug SECONDS"),
        ("unplug x", "not a number"),
        ("unplug nan", "not within 0 to 3600"),
        ("unplug -1", "not within"),
        ("unplug 1e9", "not within"),
        ("estop_button maybe", "write on or off"),
        ("estop_button on off", "2 arguments given"),
        ("kidnap 1 2", "usage: kidnap DX_M DY_M DYAW_RAD"),
        ("kidnap inf 0 0", "not within"),
        ("babble 0x800 1", "11 bits"),
        ("babble x 1", "write it as 0x100 or 256"),
        ("babble 1 1e12", "not within"),
        ("bus_off moon", "say host or robot"),
        ("reboot moon", "write one of power_on, watchdog, brown_out"),
        ("state now", "1 arguments given"),
    ],
)
def test_a_bad_command_is_refused_with_one_line_and_changes_nothing(robot, link, injection, text, why):
    before = robot.plant.truth
    response = injection.execute(text, 0)
    assert response.startswith("error: ")
    assert why in response
    assert "\n" not in response
    assert robot.plant.truth == before
    assert link.path.exists()
    assert stepped(injection, link, 5) == []


def test_what_a_link_cannot_do_is_refused(robot):
    line = SerialLine(None, 0)
    injection = Injection(robot, line)
    assert injection.execute("bus_off", 0) == "error: bus_off host: a serial line has no bus-off"
    assert "two ends" in injection.execute("babble 0x100 10", 0)
    injection.step(10**9)
    line.close()


def test_every_command_is_described(injection):
    response = injection.execute("help", 0)
    named = response.partition("write one of ")[2].split(", ")
    assert named == [line.split()[0] for line in COMMANDS.splitlines()]


def fault_of(kind, **values):
    fields = "".join(f"\n{name}={value}" for name, value in values.items())
    return parse_schedule(f'[[fault]]\nkind="{kind}"\nat_s=0\nfor_s=1{fields}').faults[0]


def test_hogs_run_while_their_fault_lasts_no_other_and_not_beyond_the_block():
    fault = fault_of("cpu_hog", cores=2)
    with CpuHogs() as hogs:
        hogs.begin(fault)
        running = hogs._busy[fault.number]
        assert [process.poll() for process in running] == [None, None]
        hogs.end(fault)
        assert all(process.poll() is not None for process in running)
        hogs.begin(fault_of("sigstop"))
        hogs.end(fault_of("sigstop"))
        assert hogs._busy == {}
        hogs.begin(fault)
        running = hogs._busy[fault.number]
    assert all(process.poll() is not None for process in running)


def test_hogs_are_no_real_time_processes_though_their_parent_is():
    with CpuHogs() as hogs:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        except PermissionError:
            pytest.skip("no real-time scheduling allowed here")
        try:
            hogs.begin(fault_of("cpu_hog", cores=1))
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pid = hogs._busy[1][0].pid
        wait_until(lambda: os.sched_getscheduler(pid) == os.SCHED_OTHER, 60.0)
