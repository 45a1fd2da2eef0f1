"""Benchmark of the page: the loop that feeds it, its own process, the way from the robot to the page, and a replay."""

from __future__ import annotations

import math
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from msgspec.structs import replace
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from disco_hw.daemon.page_feed import FeedSubscriber, ViewerFeed, feed_path
from disco_hw.experiments import disco_hw_process
from disco_hw.log.reader import open_log
from disco_hw.log.records import Plan
from disco_hw.processes import stolen_ms
from disco_hw.viewer import TOKEN_VARIABLE, page_token
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.pages import LivePage, ReplayPage, run_live
from disco_hw.viewer.recording import Recording, Snapshot, stage_of_robot
from disco_hw.viewer.server import serving
from drivers.types import WheelSample
from tools.bench.step_times import process_cpu_s, summary
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
SEEKS = 300
BROWSER_SPAN_S = 20.0
PORT = 8139
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 3.0), "fov": 1.3, "near": 0.01,
    "far": 100.0, "image_height": 800, "image_width": 1280, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


def run() -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="disco-hw-bench-") as scratch:
        directory = Path(scratch)
        return {**_feed(directory), **_replay(directory), **_live(directory)}


def _feed(directory: Path) -> dict[str, float]:
    """CPU time of `put` in the loop's thread, with nobody looking and with one page."""
    feed = ViewerFeed(directory / "feed")
    unwatched = _put_all(feed, 0)
    subscriber = FeedSubscriber(directory / "feed")
    tick = 3000
    while not subscriber.receive(0.01):
        feed.put(*tick_records(tick))
        tick += 1
    watched = _put_all(feed, tick, subscriber)
    subscriber.close()
    feed.close()
    return {
        **summary("viewer.feed_unwatched_cpu_us", unwatched),
        **summary("viewer.feed_watched_cpu_us", watched),
    }


def _put_all(feed: ViewerFeed, first: int, subscriber: FeedSubscriber | None = None) -> np.ndarray:
    durations_us = []
    for now_ns, got in map(tick_records, range(first, first + 3000)):
        begin = time.thread_time()
        feed.put(now_ns, got)
        durations_us.append((time.thread_time() - begin) * 1e6)
        if subscriber is not None:
            subscriber.receive(0.0)
    return np.array(durations_us)


def _replay(directory: Path) -> dict[str, float]:
    """Opening a log of ten minutes, and going to places in it until they have been handed to the browser's link."""
    log = write_log(directory / "long.mcap", round(LONG_S * 1e9 / PERIOD_NS), _full_plan_tick)
    stolen_before_ms = stolen_ms()
    opens_s, opens_cpu_s = [], []
    for _ in range(OPENINGS):
        begin, begin_cpu = time.perf_counter(), time.process_time()
        with Recording(log) as opened_log, serving("bench", port=0) as page:
            ReplayPage(page.server, opened_log).step(0.0)
            opens_s.append(time.perf_counter() - begin)
            opens_cpu_s.append(time.process_time() - begin_cpu)
    with Recording(log) as opened_log, serving("bench", port=0) as page:
        replay = ReplayPage(page.server, opened_log)
        replay.step(0.0)
        seeks_s, seeks_cpu_s = [], []
        for place in np.random.default_rng(1).uniform(0.0, LONG_S, SEEKS):
            begin, begin_cpu = time.perf_counter(), time.thread_time()
            replay.go_to(float(place))
            replay.step(0.0)
            seeks_s.append(time.perf_counter() - begin)
            seeks_cpu_s.append(time.thread_time() - begin_cpu)
    return {
        **summary("viewer.open_ten_minutes_ms", 1e3 * np.array(opens_s)),
        **summary("viewer.open_ten_minutes_cpu_ms", 1e3 * np.array(opens_cpu_s)),
        **summary("viewer.seek_ms", 1e3 * np.array(seeks_s)),
        **summary("viewer.seek_cpu_ms", 1e3 * np.array(seeks_cpu_s)),
        "viewer.replay_stolen_ms": stolen_ms() - stolen_before_ms,
    }


def _full_plan_tick(tick: int) -> tuple[int, list[Any]]:
    """A tick with a plan as long as the shipped robot's: 50 steps, with all digits."""
    now_ns, got = tick_records(tick)
    path = [pose_at(tick + 5 * step) for step in range(51)]
    speeds = tuple(3.0 + 0.4 * math.sin(0.1 * tick + 0.2 * step) for step in range(50))
    x_m, y_m, yaw_rad = zip(*path, strict=True)
    long = {"left_rad_s": speeds, "right_rad_s": speeds, "path_x_m": x_m, "path_y_m": y_m, "path_yaw_rad": yaw_rad}
    return now_ns, [replace(each, **long) if isinstance(each, Plan) else each for each in got]


def _live(directory: Path) -> dict[str, float]:
    """The whole stack driving: without a page, with a page that is read, with the page's process stopped; by turns."""
    view = ["view", "--live", "--port", str(PORT), "--robot"]
    spans: dict[str, list[tuple[int, int]]] = {"without_page": [], "with_page": [], "stopped_page": []}
    stolen: dict[str, list[int]] = {name: [] for name in spans}
    cpu_percent: list[float] = []
    ages_ms: list[float] = []
    figures: dict[str, float] = {}

    def record_span(name: str, begin_ns: int, stolen_before_ms: int) -> None:
        spans[name].append((begin_ns, time.monotonic_ns()))
        stolen[name].append(stolen_ms() - stolen_before_ms)

    os.environ[TOKEN_VARIABLE] = page_token()
    with running_stack(directory) as stack:
        stack.drive()
        for _ in range(TURNS):
            time.sleep(2.0)
            before_ms, begin_ns = stolen_ms(), time.monotonic_ns()
            time.sleep(SPAN_S)
            record_span("without_page", begin_ns, before_ms)
            with disco_hw_process("page", [*view, str(stack.robot_file)], directory / "page.txt") as page, _reader():
                time.sleep(3.0)
                cpu_s, before_ms, begin_ns = process_cpu_s(page.process.pid), stolen_ms(), time.monotonic_ns()
                ages_ms += _ages_ms(feed_path(directory / "control.sock"))
                record_span("with_page", begin_ns, before_ms)
                cpu_percent.append(100.0 * (process_cpu_s(page.process.pid) - cpu_s) / SPAN_S)
                os.kill(page.process.pid, signal.SIGSTOP)
                time.sleep(0.5)
                before_ms, begin_ns = stolen_ms(), time.monotonic_ns()
                time.sleep(SPAN_S)
                record_span("stopped_page", begin_ns, before_ms)
                os.kill(page.process.pid, signal.SIGCONT)
        try:
            with chromium() as browser:
                frame_ages_ms = _frame_ages_ms(browser, stack.robot_file, directory / "control.sock")
        except pytest.skip.Exception as reason:
            print(f"the browser's figures are left out: {reason}", file=sys.stderr)
        else:
            figures |= summary("viewer.bus_to_browser_ms", np.array(frame_ages_ms))
            figures["viewer.bus_to_browser_frames"] = len(frame_ages_ms)
        stack.operator.request("quit")
        stack.daemon.process.wait(10.0)
    figures["viewer.page_cpu_percent"] = float(np.median(cpu_percent))
    figures |= summary("viewer.sample_to_page_ms", np.array(ages_ms))
    with open_log(directory / "run.mcap") as log:
        for name, parts in spans.items():
            figures |= _lateness(name, [log.columns("/loop", *span) for span in parts], stolen[name])
    return figures


def _lateness(name: str, loops: list[dict[str, Any]], stolen: list[int]) -> dict[str, float]:
    """Figures of the loop over the spans of one kind together, the range of their medians, and what the host took."""
    lateness_us = [loop["lateness_ns"].astype(np.float64) * 1e-3 for loop in loops]
    medians = [float(np.median(each)) for each in lateness_us]
    every = np.concatenate(lateness_us)
    return {
        f"viewer.lateness_{name}_us_p50": float(np.quantile(every, 0.5)),
        f"viewer.lateness_{name}_us_p50_least": min(medians),
        f"viewer.lateness_{name}_us_p50_most": max(medians),
        f"viewer.lateness_{name}_us_p99": float(np.quantile(every, 0.99)),
        f"viewer.overruns_{name}": float(sum(np.ptp(loop["overruns"]) for loop in loops)),
        f"viewer.stolen_{name}_ms": float(sum(stolen)),
    }


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


def _ages_ms(feed: Path) -> list[float]:
    """Age of every wheel sample when it arrives in the page's process, from its time stamp on, over a span."""
    ages_ms: list[float] = []
    subscriber = FeedSubscriber(feed)
    end_s = time.monotonic() + SPAN_S
    while time.monotonic() < end_s:
        received = subscriber.receive(0.1)
        now_ns = time.monotonic_ns()
        ages_ms += [(now_ns - record.t_ns) * 1e-6 for _, record in received if isinstance(record, WheelSample)]
    subscriber.close()
    return ages_ms


@contextmanager
def _reader() -> Iterator[None]:
    """Connect to the page's process as a browser does, and read all that comes."""
    address = f"127.0.0.1:{PORT}"
    token = os.environ[TOKEN_VARIABLE]
    deadline_s = time.monotonic() + 120.0
    while True:
        try:
            client = connect(
                f"ws://{address}/?token={token}", origin=Origin(f"http://{address}"), max_size=None,
                subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            )  # fmt: skip
            break
        except (OSError, InvalidStatus):
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.1)
    client.send(msgspec.msgpack.encode(_CAMERA))
    reader = threading.Thread(target=_read_all, args=(client,))
    reader.start()
    try:
        yield
    finally:
        client.close()
        reader.join()


def _read_all(client: ClientConnection) -> None:
    for _ in client:
        pass
