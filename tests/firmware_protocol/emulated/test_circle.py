"""The paper's circle, driven by the real daemon through an emulated board, as closely as through the virtual robot."""

import csv
import math
import statistics
from collections import defaultdict

import numpy as np
import pytest

from disco_hw.experiments import Operator, disco_hw_process
from disco_hw.log.reader import open_log
from disco_hw.processes import can_use_fifo
from tests.firmware_protocol.emulated.board_end import EMULATED
from tests.watched_processors import build_watcher, watched_processors
from tools.check.emulated_board import build_board, running_board
from tools.stack import write_robot_file

pytestmark = [*EMULATED, pytest.mark.timeout(700)]
RADIUS_M = 0.75
LAPS = 3.25
LAP_S = 2 * math.pi * RADIUS_M / 0.2
START = ("0.75", "0.0", "1.5707963")
PERIOD_NS = 20_000_000
LEAST_PAUSE_US = 500


def overruns_without_pauses(deadlines_ns, ends_ns, pauses):
    """How many ticks would have ended after the next deadline without these pauses, too.

    What several processors were paused at once counts once.
    """
    count = 0
    for deadline, end in zip(deadlines_ns, ends_ns, strict=True):
        paused_ns, until = 0, deadline
        for paused, resumed in pauses:
            since, to = max(paused, until), min(resumed, end)
            if to > since:
                paused_ns, until = paused_ns + to - since, to
        count += end - paused_ns > deadline + PERIOD_NS
    return count


def overran(loop):
    """Deadlines and ends, ns, of the ticks that the daemon counted as overruns: ended after the next deadline."""
    (indices,) = np.nonzero(np.diff(loop["overruns"]))
    stages = sum(values for name, values in loop.items() if name.startswith("stages_ns."))
    ends = loop["woke_ns"][indices] + stages[indices + 1]
    # What comes after the last stage is not timed; the next tick is the latest that it can have ended.
    ends = np.where(ends > loop["t_ns"][indices] + PERIOD_NS, ends, loop["woke_ns"][indices + 1])
    return loop["t_ns"][indices].tolist(), ends.tolist()


def drive(directory, robot_file, others=()):
    """Drive the circle with a daemon on this robot.

    Returns how many overruns were the daemon's own, or the emulator's; and what its log says of its loop, in words.
    """
    with watched_processors(build_watcher(directory), directory, 1000, LEAST_PAUSE_US) as paused:
        parts = run(directory, robot_file, others)
        pauses = paused()
    loop = joined([part.columns("/loop") for part in parts])
    assert np.all(np.diff(loop["tick"]) == 1), "the log lacks ticks"
    stolen_ms = parts[-1].columns("/counters")["loop.stolen_ms"][-1]
    unexplained = overruns_without_pauses(*overran(loop), pauses)
    within = [to - since for since, to in pauses if to > loop["t_ns"][0] and since < loop["t_ns"][-1]]
    return unexplained, (
        f"{loop['overruns'][-1]} overruns, {unexplained} of them without a pause of the computer, "
        f"{loop['skipped'][-1]} skipped in {len(loop['tick'])} ticks, latest {loop['lateness_ns'].max() * 1e-6:.1f} ms "
        f"late; the computer ran nobody on a processor {len(within)} times, {max(within, default=0) * 1e-6:.1f} ms at "
        f"most; its host took {stolen_ms} ms"
    )


def run(directory, robot_file, others):
    """The drive itself; returns its log: more than one where a computer was too busy to write, and it began anew."""
    log = directory / "run.mcap"
    with disco_hw_process("daemon", ["run", str(robot_file), "--log", str(log)], directory / "daemon.txt") as daemon:
        operator = Operator(directory / "control.sock", (daemon, *others))
        # An emulator that is held up while it starts has a clock that leaps: the daemon then meets it anew.
        operator.arm()
        operator.request("start")
        far = lambda status: status["state"] != "ARMED" or status["task"]["laps"] >= LAPS  # noqa: E731
        status = operator.wait_until(f"{LAPS} laps", far, 4 * LAPS * LAP_S)
        assert status["state"] == "ARMED", status["detail"]
        operator.request("stop")
        operator.wait_for_standstill(5.0)
        operator.request("disarm")
        operator.wait_for("READY", 5.0)
        operator.request("quit")
        assert daemon.process.wait(20.0) == 0, daemon.last_line()
    return [open_log(part) for part in (log, *sorted(directory.glob("run.part*.mcap")))]


def joined(parts):
    """Columns of several logs, one after the other; a stage that one of them has not is 0 there."""
    names = {name for part in parts for name in part}
    return {name: np.concatenate([part.get(name, np.zeros(len(part["tick"]))) for part in parts]) for name in names}


def mean_square_m2(poses):
    """Of the distance from the circle behind the first quarter of a lap, and how far off that may be by chance.

    The noise of wheels, ground and sensor makes even laps of one robot differ, by about a fifth: its standard error
    comes from twelfths of a lap, which know little of one another.
    """
    turned, before, pieces = 0.0, None, defaultdict(list)
    for x, y in poses:
        angle = math.atan2(y, x)
        if before is not None:
            turned += math.remainder(angle - before, 2 * math.pi)
        before = angle
        laps = turned / (2 * math.pi)
        if 0.25 <= laps < LAPS - 0.05:
            pieces[int(12 * laps)].append((math.hypot(x, y) - RADIUS_M) ** 2)
    assert laps >= LAPS - 0.05
    means = [statistics.mean(piece) for piece in pieces.values()]
    return statistics.mean(means), statistics.stdev(means) / math.sqrt(len(means))


@pytest.fixture(scope="module")
def virtual_m2(tmp_path_factory):
    directory = tmp_path_factory.mktemp("virtual")
    # Over the mock bus, and not a terminal, whose bytes are late beside other work.
    robot_file, truth = write_robot_file(directory, "can"), directory / "truth.csv"
    arguments = ["sim", str(robot_file), "--truth", str(truth), "--start", *START]
    with disco_hw_process("virtual robot", arguments, directory / "sim.txt") as robot:
        drive(directory, robot_file, [robot])
    with truth.open(newline="", encoding="utf-8") as file:
        return mean_square_m2([(float(row["x_m"]), float(row["y_m"])) for row in csv.DictReader(file)])


def test_only_what_a_pause_took_is_the_computers():
    ms = 1_000_000
    pauses = [(5 * ms, 15 * ms), (6 * ms, 16 * ms), (100 * ms, 103 * ms)]
    assert overruns_without_pauses([0], [25 * ms], pauses) == 0
    assert overruns_without_pauses([0], [32 * ms], pauses) == 1, "two processors at once"
    assert overruns_without_pauses([90 * ms], [112 * ms], pauses) == 0
    assert overruns_without_pauses([90 * ms], [114 * ms], pauses) == 1
    assert overruns_without_pauses([200 * ms], [221 * ms], pauses) == 1


@pytest.mark.parametrize("processor", ["m3", "m4f"])
def test_the_daemon_drives_the_circle_through_the_board_as_through_the_virtual_robot(
    tmp_path, processor, virtual_m2, capsys
):
    with running_board(build_board(processor, tmp_path), processor) as running:
        robot_file = write_robot_file(tmp_path, "serial")
        text = robot_file.read_text("utf-8")
        robot_file.write_text(text.replace(str(tmp_path / "tty"), running.port), "utf-8")
        unexplained, loop = drive(tmp_path, robot_file)
        rows = list(running.bench.rows)
    assert {row.start for row in rows} == {1}
    board, board_error = mean_square_m2([row.pose[:2] for row in rows])
    virtual, virtual_error = virtual_m2
    with capsys.disabled():
        of = f"{1e3 * math.sqrt(board):.1f} mm rms, virtual robot {1e3 * math.sqrt(virtual):.1f} mm"
        print(f"\ncircle: {processor} {of}; {loop}")
    if can_use_fifo():
        assert unexplained == 0, loop
    # Within 20 %, and twice what chance adds to the difference.
    assert board <= 1.2**2 * virtual + 2 * math.hypot(board_error, 1.2**2 * virtual_error)
