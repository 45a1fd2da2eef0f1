"""Benchmark of the page: the loop that feeds it, the way from the bus to the browser, and the opening of a replay."""

from __future__ import annotations

import math
import os
import re
import signal
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from disco_hw.experiments import disco_hw_process
from disco_hw.log.reader import open_log
from disco_hw.log.records import Plan
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.pages import LivePage, ReplayPage, run_live
from disco_hw.viewer.recording import Recording, Snapshot, stage_of_robot
from disco_hw.viewer.server import serving
from tools.bench.step_times import percentiles, summary
from tools.browser import chromium, opened
from tools.stack import running_stack
from tools.viewer_run import PERIOD_NS, pose_at, tick_records, write_log

_HAS_STAMP = "[...document.querySelectorAll('input')].some(input => /^[0-9]{6,}$/.test(input.value))"
_WATCH_STAMP = """
window.seen = [];
const shown = [...document.querySelectorAll("input")].find(input => /^[0-9]{6,}$/.test(input.value));
let last = shown.value;
const look = () => {
  if (shown.value !== last) {
    last = shown.value;
    window.seen.push([last, performance.timeOrigin + performance.now()]);
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""
LONG_S = 600.0
SPAN_S = 10.0
TURNS = 5
OPENINGS = 5
BROWSER_SPAN_S = 20.0
PORT = 8139


def run() -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="disco-hw-bench-") as scratch:
        directory = Path(scratch)
        return {**_replay(directory), **_live(directory)}


def _replay(directory: Path) -> dict[str, float]:
    """Opening a log of ten minutes."""
    log = write_log(directory / "long.mcap", round(LONG_S * 1e9 / PERIOD_NS), _full_plan_tick)
    opens_s = []
    for _ in range(OPENINGS):
        begin = time.perf_counter()
        with Recording(log) as opened_log, serving("bench", port=0) as page:
            ReplayPage(page.server, opened_log).step(0.0)
            opens_s.append(time.perf_counter() - begin)
    return summary("viewer.open_ten_minutes_ms", 1e3 * np.array(opens_s))


def _full_plan_tick(tick: int) -> tuple[int, list[Any]]:
    """A tick with a plan as long as the shipped robot's: 50 steps, with all digits."""
    now_ns, got = tick_records(tick)
    path = [pose_at(tick + 5 * step) for step in range(51)]
    speeds = tuple(3.0 + 0.4 * math.sin(0.1 * tick + 0.2 * step) for step in range(50))
    x_m, y_m, yaw_rad = zip(*path, strict=True)
    long = {"left_rad_s": speeds, "right_rad_s": speeds, "path_x_m": x_m, "path_y_m": y_m, "path_yaw_rad": yaw_rad}
    return now_ns, [replace(each, **long) if isinstance(each, Plan) else each for each in got]


def _live(directory: Path) -> dict[str, float]:
    """The whole stack driving: without a page, with a page in a browser, with the page's process stopped; by turns."""
    spans: dict[str, list[tuple[int, int]]] = {"without_page": [], "with_page": [], "stopped_page": []}

    def record_span(name: str) -> None:
        begin_ns = time.monotonic_ns()
        time.sleep(SPAN_S)
        spans[name].append((begin_ns, time.monotonic_ns()))

    with ExitStack() as running:
        try:
            browser = running.enter_context(chromium())
        except pytest.skip.Exception as reason:
            print(f"the browser's figures are left out: {reason}", file=sys.stderr)
            return {}
        stack = running.enter_context(running_stack(directory))
        view = ["view", "--live", "--port", str(PORT), "--robot", str(stack.robot_file)]
        stack.drive()
        for _ in range(TURNS):
            time.sleep(2.0)
            record_span("without_page")
            with disco_hw_process("page", view, directory / "page.txt") as page:
                while not (address := re.search(r"http://\S+", page.output_lines())):
                    assert page.process.poll() is None, page.last_line()
                    time.sleep(0.1)
                with opened(browser, address[0]):
                    time.sleep(3.0)
                    record_span("with_page")
                    os.kill(page.process.pid, signal.SIGSTOP)
                    time.sleep(0.5)
                    record_span("stopped_page")
                    os.kill(page.process.pid, signal.SIGCONT)
        frame_ages_ms = _frame_ages_ms(browser, stack.robot_file, directory / "control.sock")
        stack.operator.request("quit")
        stack.daemon.process.wait(10.0)
    figures = summary("viewer.bus_to_browser_ms", np.array(frame_ages_ms))
    figures["viewer.bus_to_browser_frames"] = len(frame_ages_ms)
    with open_log(directory / "run.mcap") as log:
        for name, parts in spans.items():
            loops = [log.columns("/loop", *span) for span in parts]
            lateness_us = np.concatenate([loop["lateness_ns"] for loop in loops]) * 1e-3
            figures |= percentiles(f"viewer.lateness_{name}_us", lateness_us)
            figures[f"viewer.overruns_{name}"] = float(sum(np.ptp(loop["overruns"]) for loop in loops))
    return figures


def _frame_ages_ms(browser: Any, robot_file: Path, socket: Path) -> list[float]:
    """Age of the newest wheel sample when a real browser has it on the page, from its time stamp on.

    The live page runs in this process and shows, beside everything else, the stamp of what it has just drawn; the
    browser notes when a frame that has a new one is due.
    """
    desk = Desk(socket, robot_file)
    ending = threading.Event()
    with serving("bench", port=0) as page:
        live = LivePage(page.server, stage_of_robot(robot_file), socket, desk)
        stamp = page.server.gui.add_text("stamp", "")
        show = live.scene.show

        def show_with_stamp(snapshot: Snapshot, everything: bool = True) -> None:
            show(snapshot, everything)
            newest = live.timeline.wheels.last(snapshot.t_ns)
            stamp.value = "" if newest is None else str(newest[0])

        live.scene.show = show_with_stamp  # type: ignore[method-assign]
        thread = threading.Thread(target=run_live, args=(live, ending.is_set))
        thread.start()
        try:
            with opened(browser, page.url, 480, 320) as tab:
                tab.wait_for_function(_HAS_STAMP)
                tab.wait_for_timeout(10_000)
                tab.evaluate(_WATCH_STAMP)
                tab.wait_for_timeout(BROWSER_SPAN_S * 1e3)
                seen = tab.evaluate("window.seen")
        finally:
            ending.set()
            thread.join()
            desk.close()
    # A browser has the wall clock alone.
    ahead_ms = time.time() * 1e3 - time.monotonic_ns() * 1e-6  # noqa: TID251
    return [at_ms - ahead_ms - int(stamp_ns) * 1e-6 for stamp_ns, at_ms in seen if stamp_ns][1:]
