"""Pages of the viewer: live, the daemon's feed drawn some times a second beside the desk with its buttons; and replay.

The replay shows one instant of a log at a time: by slider, by tick, by mark, or running.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import viser

from disco_hw.daemon.page_feed import FeedSubscriber, feed_path
from disco_hw.fence import Fence
from disco_hw.log.records import BeliefChange, Record
from disco_hw.runtime.robot_setup import record_of, task_in_status
from disco_hw.runtime.safe_area import record_of_fence
from disco_hw.viewer.area import FenceEditor, fence_in_force
from disco_hw.viewer.curves import Plots
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.panel import coverage_text, events_text, live_details, live_summary, replay_details, replay_text
from disco_hw.viewer.recording import Recording, ShownRobot, Snapshot, snapshot_at
from disco_hw.viewer.scene import DARK, Scene
from disco_hw.viewer.timeline import KINDS, Excited, Mark, Timeline, marks_of
from disco_hw.viewer.views import ScrubBar, TaskEditor, Views, add_layers

# Chosen: how late an end is noticed.
WAIT_S = 0.05
# Chosen: for what changes slowly; the robot itself moves with each batch.
LIVE_REDRAW_S = 0.5
# Chosen: longer takes more memory of a page that stays open; a log holds all.
KEEP_S = 300.0
# Chosen: a record that is younger is believed before the daemon's status.
_STATUS_OLDER_NS = 2_000_000_000


@dataclass(slots=True)
class _Due:
    """Timer of something to do every `period_s`."""

    period_s: float
    next_s: float = 0.0

    def __call__(self, now_s: float) -> bool:
        if now_s < self.next_s:
            return False
        self.next_s = now_s + self.period_s
        return True


class _Column:
    """Column beside the scene on both pages: state, motions driven by hand, plots, events, and all other figures."""

    def __init__(self, gui: viser.GuiApi, stage: ShownRobot) -> None:
        self._stage = stage
        self.state = gui.add_markdown("")
        with gui.add_folder("Motions driven so far", visible=False) as self.motions:
            self.coverage = gui.add_markdown("")
        self._plots = Plots(gui, stage)
        with gui.add_folder("Events"):
            self.events = gui.add_markdown("nothing yet")
        with gui.add_folder("All figures", expand_by_default=False):
            self.details = gui.add_markdown("")

    def show(
        self, state: str, details: str, motions: Sequence[Mapping[str, Any]] | None, timeline: Timeline,
        snapshot: Snapshot | None, first_ns: int | None,
    ) -> None:  # fmt: skip
        """Show texts, coverage of the motions (None: nobody drives by hand), plots, and events up to the snapshot."""
        _set(self.state, state)
        _set(self.details, details)
        if self.motions.visible != (motions is not None):
            self.motions.visible = motions is not None
        if motions is not None:
            _set(self.coverage, coverage_text(motions))
        _set(self.events, events_text(snapshot, first_ns))
        if snapshot is not None:
            self._plots.show(timeline, snapshot.t_ns, self._stage.task_at(snapshot.task), snapshot.belief)


class LivePage:
    """Everything on the live page; `step` waits for the feed and draws what has come."""

    def __init__(self, server: viser.ViserServer, stage: ShownRobot, socket: Path, desk: Desk) -> None:
        self.timeline = Timeline()
        self._server = server
        self._stage = stage
        self._desk = desk
        self._subscriber = FeedSubscriber(feed_path(socket))
        self._redraw = _Due(LIVE_REDRAW_S)
        gui = server.gui
        gui.main_panel.dock_right()
        self._column = _Column(gui, stage)
        self.scene = Scene(server, stage)
        self._views = Views(server, stage.task)
        self.editor = TaskEditor(server, desk.drag)
        self.fence_editor = FenceEditor(gui, desk.request, stage.fence, stage.footprint)
        add_layers(server, self.scene, self._shade)

    def step(self) -> None:
        """Wait at most a twentieth of a second for records, then draw: each batch of the feed moves the robot."""
        self.ingest(self._subscriber.receive(WAIT_S))
        if self._server.get_clients():
            self.draw(self._redraw(time.monotonic()))

    def ingest(self, received: list[tuple[int, Record]]) -> None:
        """Take in records of the feed."""
        for now_ns, record in received:
            self.timeline.add(now_ns, record)
        if received:
            self.timeline.drop_before(received[-1][0] - round(KEEP_S * 1e9))

    def draw(self, everything: bool) -> None:
        """Draw the newest instant; the panel and long lines only if `everything`."""
        status = self._desk.status
        self._learn_task(status)
        self._learn_belief(status)
        self._learn_fence(status)
        snapshot = self._snapshot()
        if snapshot is not None:
            self.scene.show(snapshot, everything)
            self._views.follow(snapshot.pose)
            self.fence_editor.show(snapshot.pose if snapshot.pose_healthy else None)
        self.editor.show(self._stage.task_at(None if snapshot is None else snapshot.task), self._desk.draft)
        if everything:
            behind_ms = None if snapshot is None else (time.monotonic_ns() - snapshot.t_ns) * 1e-6
            summary = live_summary(status, snapshot, self.scene.knows_task)
            details = live_details(status, snapshot, self._subscriber.missed, behind_ms)
            drive = (status or {}).get("drive")
            motions = None if drive is None else drive["coverage"]["items"]
            self._column.show(summary, details, motions, self.timeline, snapshot, self.timeline.first_ns)

    def _shade(self) -> None:
        self._desk.dark = self.scene.background == DARK

    def close(self) -> None:
        """Close the subscription to the daemon's feed."""
        self._subscriber.close()

    def _snapshot(self) -> Snapshot | None:
        newest = self.timeline.last_ns
        return None if newest is None else snapshot_at(self.timeline, newest, self.timeline.plans.last(newest))

    def _learn_task(self, status: dict[str, Any] | None) -> None:
        """Take over the daemon's task: it may have been changed before this page was opened."""
        newest = self.timeline.last_ns
        if newest is None or status is None or not status.get("ok"):
            return
        requested = task_in_status(status["task"]["asked"], self._stage.task)
        self.scene.knows_task = requested is not None
        if requested is None:
            return
        record = self.timeline.tasks.last(newest)
        if record is not None and newest - record.t_ns < _STATUS_OLDER_NS:
            return
        if self._stage.task_at(record) != requested:
            self.timeline.add(newest, record_of(newest, requested))

    def _learn_fence(self, status: dict[str, Any] | None) -> None:
        """Take over the daemon's fence: it may have been changed before this page was opened."""
        newest = self.timeline.last_ns
        area = None if status is None or not status.get("ok") else status.get("area")
        if newest is None or area is None:
            return
        record = self.timeline.fences.last(newest)
        if record is not None and newest - record.t_ns < _STATUS_OLDER_NS:
            return
        fence = msgspec.convert(area["fence"], Fence)
        if fence_in_force(self._stage.fence, record) != fence:
            self.timeline.add(newest, record_of_fence(newest, fence))

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
            self.timeline.adaptations.clear()
        in_force = _belief_in_force(newest, adaptation)
        if _geometry(record) != _geometry(in_force):
            self.timeline.add(newest, in_force)


def _belief_in_force(now_ns: int, adaptation: Mapping[str, Any] | None) -> BeliefChange:
    """Return the belief of a status."""
    if adaptation is None or adaptation["belief"] != "adapted":
        return BeliefChange(now_ns, "model")
    mean = adaptation["mean"]
    return BeliefChange(now_ns, "adapted", tuple(mean), tuple(mean.values()), tuple(adaptation["covariance"]))


def _geometry(change: BeliefChange | None) -> tuple[tuple[float, ...], ...]:
    """Return a key that distinguishes two beliefs; empty for the model file's."""
    return () if change is None or change.source == "model" else (change.mean, change.covariance)


def run_live(page: LivePage, should_stop: Callable[[], bool]) -> None:
    """Draw until requested to stop."""
    try:
        while not should_stop():
            page.step()
    finally:
        page.close()


def _set(element: viser.GuiMarkdownHandle, text: str) -> None:
    """Send a text only when it has changed."""
    if element.content != text:
        element.content = text


SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0, "8": 8.0}
# Chosen: 20 pictures a second.
STEP_S = 0.05
# Chosen: for what costs more to draw than to look at.
REPLAY_REDRAW_S = 0.4
# Chosen: more could not be told apart on the slider, or be found in the list.
_SLIDER_MARKS = 40
_LISTED_MARKS = 200
_NO_MARK = "go to ..."


class ReplayPage:
    """Everything on the replay page, which opens where the task starts; `t_s`: where it is, from the first tick.

    The buttons' callbacks run in threads of the page's server and only note what is asked; `step` acts on it.
    """

    def __init__(self, server: viser.ViserServer, recording: Recording) -> None:
        self.t_s = recording.task_start_s
        self.playing = False
        self._recording = recording
        self._speed = 1.0
        self._lock = threading.Lock()
        self._changed = True
        self._next_redraw_s = 0.0
        self._marks = marks_of(recording.timeline)
        gui = server.gui
        gui.main_panel.dock_right()
        shown = tuple(round(self._seconds(mark), 3) for mark in _spread(self._marks, _SLIDER_MARKS))
        duration_s = max(recording.duration_s, 0.001)
        self._slider = gui.add_slider("Time (s)", 0.0, duration_s, 0.001, round(self.t_s, 3), marks=shown)
        self._play_button = gui.add_button("Play")
        self._add_controls(gui)
        self._bar = ScrubBar(server, duration_s, shown, self.stay_at)
        stage = recording.stage
        self._column = _Column(gui, stage)
        self._excited = Excited(recording.timeline, stage.drive_top_rad_s)
        self.scene = Scene(server, stage)
        self._views = Views(server, stage.task)
        add_layers(server, self.scene, self._redraw)

    def go_to(self, t_s: float) -> None:
        """Go to a time, within the log."""
        with self._lock:
            self.t_s = min(max(t_s, 0.0), self._recording.duration_s)
            self._changed = True

    def stay_at(self, t_s: float) -> None:
        """Go to a time, within the log, and stay there."""
        self._play(False)
        self.go_to(t_s)

    def step_ticks(self, count: int) -> None:
        """Go this many ticks forward or back, and stay there."""
        self.stay_at(self._recording.seconds_of(self._recording.tick_at(self.t_s) + count))

    def step(self, passed_s: float) -> None:
        """Advance by this much real time if playing, and draw if anything has changed."""
        if self.playing:
            self.go_to(self.t_s + passed_s * self._speed)
            if self.t_s >= self._recording.duration_s:
                self._play(False)
        with self._lock:
            changed, self._changed, t_s = self._changed, False, self.t_s
        if changed:
            self._draw(t_s)

    def _draw(self, t_s: float) -> None:
        now_s = time.monotonic()
        snapshot = self._recording.at(t_s)
        everything = not self.playing or now_s >= self._next_redraw_s
        self.scene.show(snapshot, everything)
        self._views.follow(snapshot.pose)
        self._bar.show(t_s)
        self._slider.value = round(t_s, 3)  # type: ignore[misc]
        if everything:
            self._next_redraw_s = now_s + REPLAY_REDRAW_S
            first_ns, timeline = self._recording.first_ns, self._recording.timeline
            state = replay_text(snapshot, first_ns, self._recording.stage.task_at(snapshot.task))
            motions = self._excited.items(snapshot.t_ns) if self._excited.driven else None
            self._column.show(state, replay_details(snapshot), motions, timeline, snapshot, first_ns)

    def _redraw(self) -> None:
        with self._lock:
            self._changed = True

    def _play(self, playing: bool) -> None:
        self.playing = playing
        self._play_button.label = "Pause" if playing else "Play"

    def _add_controls(self, gui: viser.GuiApi) -> None:
        steps = gui.add_button_group("Step", ("-10", "-1", "+1", "+10"))
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1")
        listed = {self._line(mark): mark for mark in _spread(self._marks, _LISTED_MARKS)}
        marks = gui.add_dropdown("Marks", (_NO_MARK, *listed), initial_value=_NO_MARK)

        @self._slider.on_update
        def _(event: Any) -> None:
            # Without a client it was moved from here.
            if event.client is not None:
                self.stay_at(float(event.target.value))

        @self._play_button.on_click
        def _(_: Any) -> None:
            if not self.playing and self.t_s >= self._recording.duration_s:
                self.go_to(0.0)
            self._play(not self.playing)
            self._redraw()

        @steps.on_click
        def _(event: Any) -> None:
            self.step_ticks(int(event.target.value))

        @speed.on_update
        def _(event: Any) -> None:
            self._speed = SPEEDS[event.target.value]

        @marks.on_update
        def _(event: Any) -> None:
            mark = listed.get(event.target.value)
            if mark is not None:
                self.stay_at(self._seconds(mark))

    def _seconds(self, mark: Mark) -> float:
        return (mark.t_ns - self._recording.first_ns) * 1e-9

    def _line(self, mark: Mark) -> str:
        return f"{self._seconds(mark):.2f} s {mark.kind}: {mark.text}"


def _spread(marks: tuple[Mark, ...], count: int) -> list[Mark]:
    """At most `count` marks: the graver kinds first, then evenly picked; in order of time."""
    kept: list[Mark] = []
    for kind in KINDS:
        of_kind = [mark for mark in marks if mark.kind == kind]
        room = count - len(kept)
        if room > 0 and of_kind:
            picks = np.unique(np.linspace(0, len(of_kind) - 1, min(room, len(of_kind))).astype(int))
            kept += [of_kind[pick] for pick in picks]
    return sorted(kept, key=lambda mark: mark.t_ns)


def run_replay(page: ReplayPage, should_stop: Callable[[], bool]) -> None:
    """Draw until requested to stop."""
    before_s = time.monotonic()
    while not should_stop():
        now_s = time.monotonic()
        page.step(now_s - before_s)
        before_s = now_s
        time.sleep(STEP_S)
