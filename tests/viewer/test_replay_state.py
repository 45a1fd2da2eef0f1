"""A replay says of each instant what the live page said then, and opens where the task starts."""

import re
from pathlib import Path

import pytest

from disco_hw.daemon.control_socket import loop_figures, status
from disco_hw.daemon.loop import LoopStats
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.viewer import operator_controls
from disco_hw.viewer.operator_controls import shown
from disco_hw.viewer.pages import ReplayPage
from disco_hw.viewer.panel import escaped, replay_text
from disco_hw.viewer.recording import Recording
from disco_hw.viewer.server import serving
from tests.runtime.simulated import simulated_stack, write_run


def read_of_the_task():
    """What the desk's script reads of a status's task."""
    page = Path(operator_controls.__file__).with_suffix(".html").read_text("utf-8")
    (names,) = re.findall(r"const {([\w, ]+)} = status\.task;", page)
    return set(names.split(", "))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A log, and by the time of each tick what the live page says: waiting, driving, standing, e-stop, reset."""
    stack = simulated_stack()
    loop, live = loop_figures(LoopStats()), {}

    def let_pass(duration_s, *requests):
        for tick in stack.ticks(duration_s, *requests):
            display = shown(status(stack.core, loop, RecorderStats()), "")
            assert read_of_the_task() <= display["task"].keys()
            live[tick.pipeline.t_ns] = (display["head"], display["detail"])

    let_pass(1.5)
    let_pass(0.5, UserRequest.ARM)
    let_pass(0.8, UserRequest.START)
    let_pass(0.5, UserRequest.STOP)
    let_pass(0.5, UserRequest.ESTOP)
    let_pass(0.5, UserRequest.RESET)
    with Recording(write_run(stack, tmp_path_factory.mktemp("drive") / "run.mcap")) as recording:
        yield recording, live


def test_every_instant_says_what_the_live_page_said(drive):
    recording, live = drive
    assert {head for head, _ in live.values()} >= {"READY", "ARMED", "ARMED · running", "E-STOP"}
    for t_ns, (head, detail) in live.items():
        snapshot = recording.at((t_ns - recording.first_ns) * 1e-9)
        assert snapshot.t_ns == t_ns
        lines = replay_text(snapshot, recording.first_ns, recording.stage.task).splitlines()
        assert (lines[0], lines[2]) == (f"### {head}", escaped(detail))


def test_it_opens_where_the_task_starts(drive):
    recording, _ = drive
    with serving("test", port=0) as served:
        page = ReplayPage(served.server, recording)
        page.step(0.0)
        assert page._column.state.content.startswith("### ARMED · running\n\nrunning the task\n")
        assert page._slider.value == pytest.approx(page.t_s, abs=1e-3)
    snapshot = recording.at(page.t_s)
    assert snapshot.source == Source.PLAN.value
    assert snapshot.plan is not None
    before = recording.at(recording.seconds_of(recording.tick_at(page.t_s) - 1))
    assert before.source == Source.HOLD.value
