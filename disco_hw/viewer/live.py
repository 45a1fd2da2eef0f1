"""The live page: the daemon's feed drawn some times a second, and buttons that go through its control socket."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import viser

from disco_hw.daemon.control_client import send_request
from disco_hw.errors import WorkError
from disco_hw.log.records import Record
from disco_hw.viewer import controls
from disco_hw.viewer.feed import feed_path
from disco_hw.viewer.layers import add_layers
from disco_hw.viewer.panel import escaped, events_text, live_details, live_head
from disco_hw.viewer.plots import Plots
from disco_hw.viewer.scene import Scene
from disco_hw.viewer.snapshot import Snapshot, snapshot_at
from disco_hw.viewer.stage import Stage
from disco_hw.viewer.subscriber import FeedSubscriber
from disco_hw.viewer.timeline import Timeline

MOVE_S = 0.1
REDRAW_S = 0.5
STATUS_S = 0.5
KEEP_S = 300.0
_STATUS_TIMEOUT_S = 0.3


@dataclass(slots=True)
class _Due:
    """Something to do every `period_s`."""

    period_s: float
    next_s: float = 0.0

    def __call__(self, now_s: float) -> bool:
        if now_s < self.next_s:
            return False
        self.next_s = now_s + self.period_s
        return True


class LivePage:
    """Everything on the live page; `step` waits for the feed and draws what has come."""

    def __init__(self, server: viser.ViserServer, stage: Stage, socket: Path, robot_file: Path) -> None:
        self.timeline = Timeline()
        self._server = server
        self._socket = socket
        self._subscriber = FeedSubscriber(feed_path(socket))
        self._status: dict[str, Any] | None = None
        self._error = ""
        self._move, self._redraw, self._ask = _Due(MOVE_S), _Due(REDRAW_S), _Due(STATUS_S)
        gui = server.gui
        gui.main_panel.dock_right()
        top = gui.add_panel()
        with top.add_tab("Robot"):
            controls.add_estop(gui, controls.estop_asking(socket, robot_file), self._answered)
            controls.add_buttons(gui, controls.asking(socket), self._answered)
            self._head = gui.add_markdown("### connecting")
            self._answer = gui.add_markdown("")
        # Of its own, so that the e-stop does not scroll away; and not in the corner where the page puts its notices.
        top.dock_above(gui.main_panel)
        self._details = gui.add_markdown("")
        self._plots = Plots(gui, stage)
        with gui.add_folder("Events"):
            self._events = gui.add_markdown("nothing yet")
        self.scene = Scene(server, stage)
        add_layers(gui, self.scene, lambda: None)

    def step(self) -> None:
        """Wait at most a tenth of a second for records, then draw what is due."""
        self.take(self._subscriber.receive(MOVE_S))
        now_s = time.monotonic()
        if not self._server.get_clients():
            return
        if self._ask(now_s):
            self._ask_status()
        if self._move(now_s):
            self.draw(self._redraw(now_s))

    def take(self, received: list[tuple[int, Record]]) -> None:
        """Take in records of the feed."""
        for now_ns, record in received:
            self.timeline.add(now_ns, record)
        if received:
            self.timeline.forget_before(received[-1][0] - round(KEEP_S * 1e9))

    def draw(self, everything: bool) -> None:
        """Draw the newest instant; the panel and long lines only if `everything`."""
        snapshot = self._snapshot()
        if snapshot is not None:
            self.scene.show(snapshot, everything)
        if everything:
            _set(self._head, live_head(self._status, self._error))
            behind_ms = None if snapshot is None else (time.monotonic_ns() - snapshot.t_ns) * 1e-6
            _set(self._details, live_details(self._status, snapshot, self._subscriber.missed, behind_ms))
            _set(self._events, events_text(snapshot, self.timeline.first_ns))
            if snapshot is not None:
                self._plots.show(self.timeline, snapshot.t_ns)

    def close(self) -> None:
        """Leave the feed."""
        self._subscriber.close()

    def _snapshot(self) -> Snapshot | None:
        newest = self.timeline.last_ns
        return None if newest is None else snapshot_at(self.timeline, newest, self.timeline.plans.last(newest))

    def _ask_status(self) -> None:
        try:
            self._status, self._error = send_request(self._socket, {"do": "status"}, _STATUS_TIMEOUT_S), ""
        except WorkError as error:
            self._status, self._error = None, str(error)

    def _answered(self, text: str) -> None:
        self._answer.content = f"*{escaped(text)}*"


def run_live(page: LivePage, should_stop: Callable[[], bool]) -> None:
    """Draw until told to stop."""
    try:
        while not should_stop():
            page.step()
    finally:
        page.close()


def _set(element: viser.GuiMarkdownHandle, text: str) -> None:
    """Send a text only when it has changed."""
    if element.content != text:
        element.content = text
