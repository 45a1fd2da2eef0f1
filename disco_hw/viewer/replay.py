"""The replay page: one instant of a log at a time, by slider, by tick, by mark, or running."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from disco_hw.viewer.curves import Plots
from disco_hw.viewer.panel import coverage_text, events_text, replay_details, replay_text
from disco_hw.viewer.recording import Recording
from disco_hw.viewer.scene import Scene
from disco_hw.viewer.timeline import KINDS, Excited, Mark, marks_of
from disco_hw.viewer.views import ScrubBar, Views, add_layers

SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0, "8": 8.0}
STEP_S = 0.05
REDRAW_S = 0.4
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
        self._add_controls(gui)
        self._bar = self._scrub_bar(server)
        self._state = gui.add_markdown("")
        stage = recording.stage
        self._excited = Excited(recording.timeline, stage.drive_top_rad_s)
        if self._excited.driven:
            with gui.add_folder("Motions driven so far"):
                self._coverage = gui.add_markdown("")
        self._plots = Plots(gui, stage)
        with gui.add_folder("Events"):
            self._events = gui.add_markdown("")
        with gui.add_folder("All figures", expand_by_default=False):
            self._details = gui.add_markdown("")
        self.scene = Scene(server, recording.stage)
        self._views = Views(server, stage.task)
        add_layers(server, self.scene, self._redraw)

    def go_to(self, t_s: float) -> None:
        """Go to a time, within the log."""
        with self._lock:
            self.t_s = min(max(t_s, 0.0), self._recording.duration_s)
            self._changed = True

    def step_ticks(self, count: int) -> None:
        """Go this many ticks forward or back, and stay there."""
        self._play(False)
        self.go_to(self._recording.seconds_of(self._recording.tick_at(self.t_s) + count))

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
            self._next_redraw_s = now_s + REDRAW_S
            first_ns = self._recording.first_ns
            task = self._recording.stage.task_at(snapshot.task)
            self._state.content = replay_text(snapshot, first_ns, task)
            self._details.content = replay_details(snapshot)
            if self._excited.driven:
                self._coverage.content = coverage_text(self._excited.items(snapshot.t_ns))
            self._events.content = events_text(snapshot, first_ns)
            self._plots.show(self._recording.timeline, snapshot.t_ns, task, snapshot.belief)

    def _redraw(self) -> None:
        with self._lock:
            self._changed = True

    def _play(self, playing: bool) -> None:
        self.playing = playing
        self._play_button.label = "Pause" if playing else "Play"

    def _add_controls(self, gui: viser.GuiApi) -> None:
        duration_s = max(self._recording.duration_s, 0.001)
        shown = [round(self._seconds(mark), 3) for mark in _spread(self._marks, _SLIDER_MARKS)]
        self._slider = gui.add_slider("Time (s)", 0.0, duration_s, 0.001, round(self.t_s, 3), marks=tuple(shown))
        self._play_button = gui.add_button("Play")
        steps = gui.add_button_group("Step", ("-10", "-1", "+1", "+10"))
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1")
        listed = {self._line(mark): mark for mark in _spread(self._marks, _LISTED_MARKS)}
        marks = gui.add_dropdown("Marks", (_NO_MARK, *listed), initial_value=_NO_MARK)

        @self._slider.on_update
        def _(event: Any) -> None:
            # Without a client it was moved from here.
            if event.client is not None:
                self._play(False)
                self.go_to(float(event.target.value))

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
                self._play(False)
                self.go_to(self._seconds(mark))

    def _scrub_bar(self, server: viser.ViserServer) -> ScrubBar:
        def go_to(t_s: float) -> None:
            self._play(False)
            self.go_to(t_s)

        shown = [round(self._seconds(mark), 3) for mark in _spread(self._marks, _SLIDER_MARKS)]
        return ScrubBar(server, max(self._recording.duration_s, 0.001), shown, go_to)

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
    """Draw until told to stop."""
    before_s = time.monotonic()
    while not should_stop():
        now_s = time.monotonic()
        page.step(now_s - before_s)
        before_s = now_s
        time.sleep(STEP_S)
