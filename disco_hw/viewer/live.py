"""The live page's scene: the daemon's feed drawn some times a second, beside the desk that has the buttons."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import viser

from disco_hw.daemon.page_feed import FeedSubscriber, feed_path
from disco_hw.log.records import BeliefChange, Record
from disco_hw.runtime.task_change import record_of, task_in_status
from disco_hw.viewer.curves import Plots
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.panel import coverage_text, events_text, live_details, live_summary
from disco_hw.viewer.recording import ShownRobot, Snapshot, snapshot_at
from disco_hw.viewer.scene import DARK, Scene
from disco_hw.viewer.timeline import Items, Timeline
from disco_hw.viewer.views import TaskEditor, Views, add_layers

WAIT_S = 0.05
REDRAW_S = 0.5
KEEP_S = 300.0
_STATUS_OLDER_NS = 2_000_000_000


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

    def __init__(self, server: viser.ViserServer, stage: ShownRobot, socket: Path, desk: Desk) -> None:
        self.timeline = Timeline()
        self._server = server
        self._stage = stage
        self._desk = desk
        self._subscriber = FeedSubscriber(feed_path(socket))
        self._redraw = _Due(REDRAW_S)
        gui = server.gui
        gui.main_panel.dock_right()
        self._summary = gui.add_markdown("")
        with gui.add_folder("Motions driven so far", visible=False) as self._excited:
            self._coverage = gui.add_markdown("")
        self._plots = Plots(gui, stage)
        with gui.add_folder("Events"):
            self._events = gui.add_markdown("nothing yet")
        with gui.add_folder("All figures", expand_by_default=False):
            self._details = gui.add_markdown("")
        self.scene = Scene(server, stage)
        self._views = Views(server, stage.task)
        self.editor = TaskEditor(server, desk.drag)
        add_layers(server, self.scene, self._shade)

    def step(self) -> None:
        """Wait at most a twentieth of a second for records, then draw: each batch of the feed moves the robot."""
        self.take(self._subscriber.receive(WAIT_S))
        if self._server.get_clients():
            self.draw(self._redraw(time.monotonic()))

    def take(self, received: list[tuple[int, Record]]) -> None:
        """Take in records of the feed."""
        for now_ns, record in received:
            self.timeline.add(now_ns, record)
        if received:
            self.timeline.forget_before(received[-1][0] - round(KEEP_S * 1e9))

    def draw(self, everything: bool) -> None:
        """Draw the newest instant; the panel and long lines only if `everything`."""
        status = self._desk.status
        self._learn_task(status)
        self._learn_belief(status)
        snapshot = self._snapshot()
        if snapshot is not None:
            self.scene.show(snapshot, everything)
            self._views.follow(snapshot.pose)
        self.editor.show(self._stage.task_at(None if snapshot is None else snapshot.task), self._desk.draft)
        if everything:
            behind_ms = None if snapshot is None else (time.monotonic_ns() - snapshot.t_ns) * 1e-6
            _set(self._summary, live_summary(status, snapshot, self.scene.knows_task))
            _set(self._details, live_details(status, snapshot, self._subscriber.missed, behind_ms))
            self._show_coverage(status)
            _set(self._events, events_text(snapshot, self.timeline.first_ns))
            if snapshot is not None:
                task = self._stage.task_at(snapshot.task)
                self._plots.show(self.timeline, snapshot.t_ns, task, snapshot.belief)

    def _shade(self) -> None:
        self._desk.dark = self.scene.background == DARK

    def close(self) -> None:
        """Leave the feed."""
        self._subscriber.close()

    def _snapshot(self) -> Snapshot | None:
        newest = self.timeline.last_ns
        return None if newest is None else snapshot_at(self.timeline, newest, self.timeline.plans.last(newest))

    def _show_coverage(self, status: dict[str, Any] | None) -> None:
        drive = (status or {}).get("drive")
        if self._excited.visible != (drive is not None):
            self._excited.visible = drive is not None
        if drive is not None:
            _set(self._coverage, coverage_text(drive["coverage"]["items"]))

    def _learn_task(self, status: dict[str, Any] | None) -> None:
        """Take over the daemon's task: it may have been changed before this page was opened."""
        newest = self.timeline.last_ns
        if newest is None or status is None or not status.get("ok"):
            return
        asked = task_in_status(status["task"]["asked"], self._stage.task)
        self.scene.knows_task = asked is not None
        if asked is None:
            return
        record = self.timeline.tasks.last(newest)
        if record is not None and newest - record.t_ns < _STATUS_OLDER_NS:
            return
        if self._stage.task_at(record) != asked:
            self.timeline.add(newest, record_of(newest, asked))

    def _learn_belief(self, status: dict[str, Any] | None) -> None:
        """Take over the belief in force: it may be from before this page was opened, or of a daemon that has gone."""
        newest = self.timeline.last_ns
        if newest is None or status is None or not status.get("ok"):
            return
        record = self.timeline.beliefs.last(newest)
        if record is not None and newest - record.t_ns < _STATUS_OLDER_NS:
            return
        adaptation = status.get("adaptation")
        if adaptation is None:
            self.timeline.adaptations = Items()
        in_force = _belief_in_force(newest, adaptation)
        if _geometry(record) != _geometry(in_force):
            self.timeline.add(newest, in_force)


def _belief_in_force(now_ns: int, adaptation: Mapping[str, Any] | None) -> BeliefChange:
    """The belief of a status."""
    if adaptation is None or adaptation["belief"] != "adapted":
        return BeliefChange(now_ns, "model")
    mean = adaptation["mean"]
    return BeliefChange(now_ns, "adapted", tuple(mean), tuple(mean.values()), tuple(adaptation["covariance"]))


def _geometry(change: BeliefChange | None) -> tuple[tuple[float, ...], ...]:
    """What distinguishes two beliefs; the model file's is empty."""
    return () if change is None or change.source == "model" else (change.mean, change.covariance)


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
