"""What no host can ask of a board: garbage, hosts that freeze, hangs, brown-outs, a clock that wraps."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.transport import serial
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.firmware_protocol.emulated.board_end import EMULATED, BoardEnd
from tests.firmware_protocol.other_end import LinkEnd
from tests.firmware_protocol.protocol_host import CODEC, ProtocolHost
from tests.sim.test_board import SimProcess
from tests.sim.test_python_can_link import HubProcess, drive_with_another_node
from tools.check.emulated_board import build_board, run_fast, running_bare_board, running_board

ROOT = Path(__file__).parents[3]
ARMED = 3
pytestmark = [*EMULATED, pytest.mark.timeout(300)]


@contextlib.contextmanager
def settled(end):
    host = ProtocolHost(end, first_session=end.now_ns // 1000 % 255)
    host.settle()
    yield host
    end.close()


@pytest.fixture(params=["m3", "m4f"])
def host(request):
    with settled(BoardEnd(request.param)) as host:
        yield host


@pytest.fixture(params=["m3", "m4f"])
def host_at_a_terminal(request):
    """A terminal, unlike a socket, has room for a second writer."""
    with settled(BoardEnd(request.param, terminal=True)) as host:
        yield host


def restarted_with(host, what, fault):
    """Do this to the board while it drives; what it says of itself afterwards, until it is reset by a host."""
    host.to_driving()
    bench = host.end.bench
    number = bench.latest().start + 1
    bench.do(what)
    host.request = host.command = None
    host.end.wait_for_start(number)
    host.run(0.5)
    assert (host.state, host.fault) == ("FAULT", fault)
    assert (host.session, host.accepted) == (0, False)
    since = [row for row in bench.rows if row.start == number]
    assert since
    assert {row.setpoints for row in since} == {(0.0, 0.0)}
    host.settle()
    host.to_driving()


def test_a_brown_out_ends_the_session_and_is_told(host):
    restarted_with(host, "b", "BROWN_OUT_RESET")


def test_a_firmware_that_hangs_is_restarted_by_the_hardware_watchdog(host):
    restarted_with(host, "h", "WATCHDOG_RESET")


def test_it_drives_on_when_its_computer_has_held_up_the_emulator(host):
    """Longer than the core lets a clock leap, shorter than it waits for a command."""
    host.to_driving()
    for _ in range(3):
        os.kill(host.end.board.process.pid, signal.SIGSTOP)
        host.run(0.06)
        os.kill(host.end.board.process.pid, signal.SIGCONT)
        host.run(0.2)
    assert (host.state, host.fault) == ("ARMED", "NONE")


def test_the_emergency_stop_button_stops_the_wheels(host):
    host.to_driving()
    host.end.bench.do("p")
    assert host.wait_for_state("ESTOP", within_s=1.0) <= 0.1 + host.end.slack_s
    host.wait_for("standing wheels", lambda: host.fastest == 0.0, 1.0)
    host.set_request("RESET")
    host.run(1.0)
    assert host.state == "ESTOP"
    host.end.bench.do("p")
    host.set_request("STANDBY")
    host.run(0.2)
    host.settle()


def test_parameters_that_were_written_outlive_a_restart(host):
    assert host.request_parameter("READ", key=4) == ("OK", 20.0)
    assert host.request_parameter("WRITE", key=4, value=5.0) == ("OK", 5.0)
    host.run(0.1)
    host.restart()
    assert host.request_parameter("READ", key=4) == ("OK", 5.0)


def test_a_thousand_frames_of_garbage_move_nothing_and_leave_it_sound(host_at_a_terminal):
    host = host_at_a_terminal
    draw = random.Random(24)
    pty = os.open(host.end.board.port, os.O_WRONLY | os.O_NOCTTY)
    host.request = host.command = None
    ids = [0x100, 0x101, 0x102, 0x150, 0x160, 0x0F0, 0x0F1, 0x0F2, 0x7FF, 0x110]
    for number in range(1000):
        kind = number % 4
        if kind == 0:  # well framed, random data
            garbage = encode_frame(draw.choice(ids), draw.randbytes(draw.choice([8, 8, 8, draw.randint(0, 7)])))
        elif kind == 1:  # damaged on the line
            line = bytearray(encode_frame(draw.choice(ids), draw.randbytes(8)))
            line[draw.randrange(len(line))] ^= 1 << draw.randrange(8)
            garbage = bytes(line)
        elif kind == 2:  # noise
            garbage = draw.randbytes(draw.randint(1, 100))
        else:  # a frame without its end, or an endless one
            garbage = encode_frame(draw.choice(ids), draw.randbytes(8))[: draw.randint(1, 14)] * draw.randint(1, 8)
        os.write(pty, garbage)
        host.step()
    os.write(pty, b"\0")
    os.close(pty)
    host.run(0.3)
    assert host.state == "STANDBY"
    assert host.rejected > 0
    rows = host.end.bench.rows
    assert {row.start for row in rows} == {1}
    assert {row.setpoints for row in rows} == {(0.0, 0.0)}
    host.settle()
    host.to_driving()


FROZEN_HOST = """
    import sys, time
    from drivers.transport.serial import create_transport
    from tests.firmware_protocol.other_end import LinkEnd
    from tests.firmware_protocol.protocol_host import ProtocolHost
    transport = create_transport(port=sys.argv[1])
    transport.open()
    host = ProtocolHost(LinkEnd(transport))
    host.settle()
    host.to_driving()
    print("driving", flush=True)
    host.run(600.0)
"""


@pytest.mark.parametrize("processor", ["m3", "m4f"])
def test_a_host_that_freezes_stops_the_wheels_within_the_watchdogs_time(tmp_path, processor):
    """Judged by the board's own clock on its test bench: the frozen process cannot tell, and no load matters."""
    with running_board(build_board(processor, tmp_path), processor) as board:
        command = [sys.executable, "-c", textwrap.dedent(FROZEN_HOST), board.port]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        host = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment)
        try:
            assert host.stdout.readline() == "driving\n"
            deadline = time.monotonic() + 20.0
            while board.bench.latest().fastest < 1.2:
                assert time.monotonic() < deadline
            host.send_signal(signal.SIGSTOP)
            while board.bench.latest().state == ARMED or board.bench.rows[-1].fastest > 0.0:
                assert time.monotonic() < deadline
            for _ in range(100):
                board.bench.latest()
            rows = board.bench.rows
        finally:
            host.kill()
            host.wait()
            host.stdout.close()
    last = max(row.accepted for row in rows)
    last_command_ms = next(row.ms for row in rows if row.accepted == last)
    first_zero_ms = next(row.ms for row in rows if row.ms > last_command_ms and row.setpoints == (0.0, 0.0))
    # 100 ms of the watchdog, 1.5 rad/s at 20 rad/s2, two lines of the bench and two cycles.
    assert first_zero_ms - last_command_ms <= 100 + 75 + 22
    after = [row for row in rows if row.ms >= first_zero_ms]
    assert {row.setpoints for row in after} == {(0.0, 0.0)}
    assert after[-1].speeds == (0.0, 0.0)


@pytest.mark.parametrize("processor", ["m3", "m4f"])
def test_it_drives_a_virtual_robot_over_its_plants_line(tmp_path, processor):
    image = build_board(processor, tmp_path, plant_line=True)
    with running_bare_board(image, processor) as (link, plant):
        sim = SimProcess(tmp_path, plant)
        transport = serial.create_transport(port=link)
        transport.open()
        host = ProtocolHost(LinkEnd(transport), first_session=3)
        try:
            host.settle()
            host.to_driving()
            before = host.latest["WHEEL_TICKS"]["left_ticks"]
            host.wait_for("turning wheels", lambda: host.latest["WHEEL_TICKS"]["left_ticks"] - before > 2000, 30.0)
            assert (host.state, host.fault) == ("ARMED", "NONE")
            row = sim.row()
            assert (row["state"], row["driver_enabled"]) == ("ARMED", "1")
            assert float(row["left_speed_rad_s"]) > 1.0
        finally:
            host.end.close()
            assert sim.end() == 0


@pytest.mark.parametrize("processor", ["m3", "m4f"])
def test_behind_slcan_it_sits_on_the_mock_bus_beside_other_nodes(tmp_path, processor):
    image = build_board(processor, tmp_path, slcan=True)
    with (
        running_board(image, processor, terminal=True) as board,
        HubProcess(tmp_path / "bus", board.port, "sleep_after_open=0"),
    ):
        drive_with_another_node(tmp_path / "bus")


@pytest.mark.parametrize("processor", ["m3", "m4f"])
def test_it_drives_on_while_the_counter_wraps(processor):
    wraps_s = 8.0
    with closing(BoardEnd(processor, first_us=2**32 - round(wraps_s * 1e6))) as end:
        host = ProtocolHost(end, first_session=1)
        host.settle()
        host.to_driving()
        rows = end.bench.rows
        assert rows[-1].ms > 4_000_000, "it wraps before the wheels turn: the computer is too slow for this test"
        host.run(wraps_s)
        assert rows[-1].ms < 100_000
        wrapped = next(i for i, (a, b) in enumerate(pairwise(rows)) if b.ms < a.ms)
        turning = rows[wrapped - 200 :]
        assert {row.state for row in turning} == {ARMED}
        assert min(row.fastest for row in turning) > 1.0
        assert (host.state, host.fault, host.latest["SESSION_STATE"]["clock_error_count"]) == ("ARMED", "NONE", 0)


@pytest.mark.timeout(1800)
def test_an_hour_of_its_own_time_with_a_wrap_of_the_counter_half_way(tmp_path):
    """As fast as the computer can: a minute or two on one that has nothing else to do, ten on one that has."""
    hour_s = 3600
    sent, rows = run_fast(build_board("m3", tmp_path), "m3", tmp_path, hour_s, first_us=2**32 - hour_s * 500_000)
    frames = FrameDecoder().feed(sent)
    samples, states, counters = [], set(), []
    for can_id, data in frames:
        if can_id in (0x110, 0x130, 0x133):
            values = CODEC.decode(can_id, data).values
            if can_id == 0x110:
                samples.append(values["sample_time"])
                counters.append(data[1] & 15)
            elif can_id == 0x130:
                name = CODEC.choice_name("SYSTEM_STATE", "state", values["state"])
                states.add((name, values["fault"], values["rejected_count"]))
            else:
                states.add(values["clock_error_count"])
    assert len(samples) >= 100 * hour_s - 1
    steps = [(b - a) % (65536 * 20) for a, b in pairwise(samples)]
    # A cycle early or late, and never drifting.
    assert 8_000 <= min(steps) <= max(steps) <= 12_000
    assert sum(steps) / len(steps) == pytest.approx(10_000, abs=1)
    assert {(b - a) % 16 for a, b in pairwise(counters)} == {1}
    assert states == {("STANDBY", 0, 0), 0}
    assert {row.start for row in rows} == {1}
    assert max(row.ms for row in rows) > 4_290_000
    assert rows[-1].ms == pytest.approx(hour_s * 500, abs=60_000)
