"""What `disco-hw run` does: makes the daemon in the order that real time needs, runs it, and undoes it all after.

Kernels that no earlier start has kept are compiled first, in a process of its own that is gone afterwards: the compiler
leaves 200 MB behind, and the control loop's process locks all that it has.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

from numba.core import event

from disco_hw import processes
from disco_hw.adaptation.guard import AdaptationChoice, check_adaptable, choose_adaptation
from disco_hw.config import RobotConfig
from disco_hw.control.plan import PLANNER_VERSION, Law
from disco_hw.daemon import SERVED, describe_recording, passed_over, socket_path
from disco_hw.daemon.check import refuse_other_host
from disco_hw.daemon.control_socket import ControlServer, refuse_served
from disco_hw.daemon.daemon import Daemon, Report
from disco_hw.daemon.loop import MonotonicClock
from disco_hw.daemon.page_feed import ViewerFeed, WatchedRecorder, feed_path, tick_feed_path
from disco_hw.daemon.process import STANDARD_OUTPUT, AsyncPrinter, StopPath, StopSignals
from disco_hw.errors import InputError, LogError, WorkError
from disco_hw.files import check_log_file, file_name_of
from disco_hw.log import DBC, Attachment, version
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.recorder import NullRecorder, Recorder
from disco_hw.processes import end_with_parent
from disco_hw.runtime import AdviceStyle, by_command
from disco_hw.runtime.assembly import (
    assemble_core,
    create_fast_adaptation,
    create_link,
    create_pipeline,
    driver_of,
    planner_of,
)
from disco_hw.runtime.core import FindsWiring, Pilot, TaskPilot
from disco_hw.runtime.pipeline import FollowTask, NoPlanner, Off, Pipeline, Planner, Standstill
from disco_hw.runtime.robot_setup import Setup, kept_files, link_key, load_setup, refuse_missing_effects, scene_of
from drivers.kernel_cache import are_kernels_kept
from drivers.types import Driver, PoseSample, Readings, Transport, WheelSample
from firmware_protocol.codec import packaged_dbc


@dataclass(frozen=True, slots=True)
class DaemonOptions:
    """Options of `disco-hw run`; None leaves what robot.toml says."""

    robot: Path
    model: Path | None = None
    link: str | None = None
    log_file: Path | None = None
    as_json: bool = False
    accept_missing_effects: bool = False
    adapt: bool = False


def run_robot(
    robot: Path | str,
    law: Law,
    *,
    model: Path | str | None = None,
    link: str | None = None,
    log: Path | str | None = None,
) -> int:
    """Run the daemon of `disco-hw run` with a control law of your own in DISCO's place; returns the exit code.

    `law(state, task, model)` gives wheel speeds, left and right (rad/s), once a control period; the other arguments are
    those of `disco-hw run`. Returns after Ctrl-C, SIGTERM or `disco-hw ctl ROBOT.toml quit`, after a stop was
    sent to the robot. Call it in the main thread, as it catches signals. Raises InputError and WorkError.
    """
    processes.spare_memory()
    options = DaemonOptions(
        Path(robot), None if model is None else Path(model), link, None if log is None else Path(log)
    )
    return run_daemon(options, law=law)


def run_daemon(
    options: DaemonOptions,
    create_pilot: Callable[[RobotConfig], Pilot] = lambda _config: TaskPilot(),
    law: Law | None = None,
    page_messages: Callable[[], tuple[str, ...]] = lambda: (),
) -> int:
    """Run until SIGTERM, SIGINT or a quit request; returns the exit code, after a stop was sent to the robot.

    `create_pilot`: of who drives; the task alone, unless it is said. `law`: plans in DISCO's place. `page_messages`:
    what happened to the page, to be recorded.
    Raises InputError, before anything is opened, if a file or an option is wrong, and what `serve` raises. An exception
    in the loop is reported, the robot stopped, and the exception passed on.
    """
    check_log_file(options.log_file)
    setup = load_setup(options.robot, options.model, options.link)
    if not options.accept_missing_effects:
        refuse_missing_effects(setup)
    chosen = AdaptationChoice("fast", "--adapt")
    if options.adapt:
        check_adaptable(setup.model, setup.config.control.uncertainty)
    else:
        chosen = choose_adaptation(setup.config.control, setup.config.pose, setup.model)
    with closing(AsyncPrinter(STANDARD_OUTPUT, in_json if options.as_json else in_text)) as report:
        report("adapt", chosen.report)
        return serve(
            setup,
            options.log_file,
            report,
            create_pilot(setup.config),
            lambda: planner_of(setup, law),
            chosen.kind == "fast",
            by_command(options.robot),
            page_messages,
        )


def serve(
    setup: Setup,
    log_file: Path | None,
    report: Report,
    pilot: Pilot,
    new_planner: Callable[[], Planner] = NoPlanner,
    adapts: bool = False,
    advice_style: AdviceStyle | None = None,
    page_messages: Callable[[], tuple[str, ...]] = lambda: (),
) -> int:
    """Run until SIGTERM, SIGINT, a quit request or the pilot's end, as `run_daemon`; returns the exit code.

    `report` is called in the loop, and so must not wait. `pilot` decides what the robot does while motion is allowed;
    `new_planner` is called twice, as one planner is used up in the warm-up. `adapts`: whether the geometry is learnt
    while driving; not where an operator drives. `advice_style`: how the operator requests the next step; with it
    the daemon reports what it waits for, what to do, and where the log is. Raises InputError, and WorkError for what
    the system refuses now and may grant at another start: a port, an address, a log.
    """
    config, key, transport = setup.config, link_key(setup), create_link(setup)
    # Before seconds of compilation; who comes at the same time is refused when the socket is made.
    refuse_served(socket_path(config))
    # Before the signals are caught: whoever has enough of a compilation may break it off, as nothing is open yet.
    planner = compiled_elsewhere(lambda: warm_planner(setup, new_planner), describe_planner(setup), _progress)
    pipeline = create_pipeline(config, setup.model, planner)
    stop = StopPath()
    with StopSignals() as signals:
        try:
            # In the order that real time needs. The planner is compiled: whoever finds the socket gets an answer.
            server = ControlServer(socket_path(config), SERVED)
            stop.add("control socket", server.close)
            feed = ViewerFeed(feed_path(server.path))
            stop.add("page feed", feed.close)
            ticks = ViewerFeed(tick_feed_path(server.path), period_s=0.0)
            stop.add("tick feed", ticks.close)
            log = log_file or (new_log(config) if config.log.enabled else None)
            recorder = WatchedRecorder(_create_recorder(setup, log), feed, ticks)
            if log is not None:
                stop.add("log", lambda: _report_log(log, report if advice_style is not None else None))
            stop.add(_RECORDER, lambda: close_recorder(recorder, report))
            adaptation = create_fast_adaptation(setup, pipeline) if adapts else None
            for step in processes.enter_real_time(config.daemon.realtime_priority):
                report("real time", str(step))
            for line in passed_over(server.path):
                report("control socket", line)
            transport.open()
            stop.add("link", transport.close)
            _refuse_beside_a_host(transport, driver_of(config, key))
            driver = driver_of(config, key)
            core = assemble_core(config, transport, driver, pipeline, recorder, pilot.needs_pose, adaptation)
            core.announce = recorder.announce
            stop.add("pose source", core.pose_source.close)
            if core.obstacle_source is not None:
                stop.add("obstacle source", core.obstacle_source.close)
            if isinstance(pilot, FindsWiring):
                core.directions = None
            clock = MonotonicClock()
            daemon = Daemon(core, server, recorder, clock, signals, report, pilot, advice_style, page_messages)
            stop.add("wheels", daemon.stop_wheels)
            if config.daemon.realtime_priority:
                report("real time", str(processes.raise_loop_thread(config.daemon.realtime_priority)))
            report("daemon", f"{transport.name}, control socket {server.path}")
            if advice_style is not None:
                report("log", "nothing is recorded, as log.enabled is false" if log is None else f"recording to {log}")
                report("next", f"when the state is READY, {advice_style('arm')}, then {advice_style('start')}")
            code = daemon.run()
        finally:
            # Whatever is interrupted here, the wheels come first: they were added last.
            failed = stop.run()
            for name, error in failed.items():
                report("stop", f"{name}: {error}")
        return code or int(_RECORDER in failed)


def _progress(text: str) -> None:
    """Write a line to standard error at once; for the time before the loop, when waiting harms nobody."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def new_log(config: RobotConfig, what: str = "", directory: Path | None = None) -> Path:
    """Return the path of a new log: the directory of [log], the name of the robot, what is recorded, the time (UTC).

    Without a real-time clock the same second can come again after a power cut: then a number follows. `directory`: in
    place of that of [log].
    """
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    first = (directory or Path(config.log.directory)) / f"{file_name_of(config.robot.name)}-{what}{stamp}.mcap"
    later = (first.with_stem(f"{first.stem}-{number}") for number in count(2))
    return next(path for path in chain((first,), later) if not os.path.lexists(path))


def _create_recorder(setup: Setup, log: Path | None) -> Recorder:
    if log is None:
        return NullRecorder()
    attachments = [*kept_files(setup), Attachment(DBC, "text/plain", packaged_dbc().encode())]
    name = setup.config.robot.name
    scene = scene_of(setup.config)
    recording = RecordingSettings(log, name, version(), PLANNER_VERSION, attachments=tuple(attachments), scene=scene)
    try:
        return ProcessRecorder(recording)
    except LogError as error:
        # No wrong file or option: a disk that is full now may have room at the next start.
        raise WorkError(str(error)) from None


def _refuse_beside_a_host(transport: Transport, driver: Driver) -> None:
    """Raise InputError if another host speaks on the link; with its exit code a service does not try again."""
    try:
        refuse_other_host(transport, driver)
    except WorkError as refused:
        raise InputError(str(refused)) from None


def _report_log(log: Path, report: Report | None) -> None:
    """Say how to look at a log; remove one without any record, as a start that fails again and again leaves them."""
    from disco_hw.log.reader import open_log  # noqa: PLC0415

    with contextlib.suppress(InputError):
        with open_log(log) as opened:
            is_empty = not opened.counts
        if is_empty:
            log.unlink()
            return
    if report is not None:
        name = shlex.quote(str(log))
        report("log", f"look at it: disco-hw view {name}, or disco-hw log info {name}")


def close_recorder(recorder: Recorder, report: Report) -> None:
    """End the log and report where its ticks are; raises LogError if some are in no file."""
    stats = recorder.close()
    for sentence in recorder.new_messages():
        report("recording", sentence)
    if stats.path:
        # No fault: of those `drive` makes a drive that is not whole.
        report("log", describe_recording(asdict(stats)))
    if stats.missing_ticks:
        raise LogError("the log is not complete; keep its file, and free space on its disk before the next drive")


_RECORDER = "recorder"


def in_text(topic: str, text: str) -> str:
    """Return a sentence of the daemon for the operator."""
    return f"{topic}: {text}"


def in_json(topic: str, text: str) -> str:
    """Return a sentence of the daemon for machines."""
    return json.dumps({"topic": topic, "text": text})


T = TypeVar("T")

_COMPILE = "numba:compile"
# Chosen: a line a second shows that compiling goes on.
_EVERY_S = 1.0


class _Compilation(event.Listener):
    """Counts the functions that are compiled, and says so again and again from a thread that begins with the first."""

    def __init__(self, what: str, report: Callable[[str], None], every_s: float) -> None:
        self._what, self._report, self._every_s = what, report, every_s
        self._count = 0
        self._began_ns = 0
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def on_start(self, event: Any) -> None:
        if self._thread is None:
            self._report(f"compiling {self._what}: this takes some seconds, only once; the result is kept")
            self._began_ns = time.monotonic_ns()
            self._thread = threading.Thread(target=self._report_progress, name="compile progress", daemon=True)
            self._thread.start()

    def on_end(self, event: Any) -> None:
        self._count += 1

    def finish(self) -> None:
        """End the thread, and say how long it took if anything was compiled."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._report(f"compiled {self._so_far()}")

    def _report_progress(self) -> None:
        while not self._ended.wait(self._every_s):
            self._report(f"compiling: {self._so_far()}")

    def _so_far(self) -> str:
        return f"{self._count} functions, {(time.monotonic_ns() - self._began_ns) * 1e-9:.0f} s"


@contextmanager
def compile_progress(what: str, report: Callable[[str], None], every_s: float = _EVERY_S) -> Iterator[None]:
    """Within the block, report what numba compiles and how far it is; nothing if its cache has it all.

    `what`: for the operator, as "the planner for a circle". `report` is called from a thread that ends with the block.
    """
    compilation = _Compilation(what, report, every_s)
    try:
        with event.install_listener(_COMPILE, compilation):
            yield
    finally:
        compilation.finish()


class _NothingKeptError(Exception):
    """Error for a function that would have been compiled."""


class _Refusal(event.Listener):
    """Ends the first compilation before it begins."""

    def on_start(self, event: Any) -> None:
        raise _NothingKeptError

    def on_end(self, event: Any) -> None:
        pass


def compiled_elsewhere(build: Callable[[], T], what: str, report: Callable[[str], None]) -> T:
    """Return `build()`, after another process has compiled and kept on disk all that it needs.

    `build` is called up to three times, once in a fork of this process; so it must open nothing, and no thread may run
    yet. Where nothing can be kept, or the other process fails, this process compiles by itself. `what` and `report` as
    for `compile_progress`.
    """
    if are_kernels_kept():
        try:
            with event.install_listener(_COMPILE, _Refusal()):
                return build()
        except _NothingKeptError:
            _build_in_fork(build, what, report)
    with compile_progress(what, report):
        return build()


def _build_in_fork(build: Callable[[], object], what: str, report: Callable[[str], None]) -> None:
    parent = os.getpid()

    def compile_all() -> None:
        end_with_parent(parent, signal.SIGKILL)
        # Whatever is wrong is found, and said, by the caller's own attempt.
        with suppress(Exception), compile_progress(what, report):
            build()

    process = multiprocessing.get_context("fork").Process(target=compile_all, daemon=True)
    process.start()
    try:
        process.join()
    finally:
        process.kill()


def compile_beforehand(robot: Path, model: Path | None, report: Callable[[str], None]) -> None:
    """Compile and keep what `run` will need for these files, so that no start waits for it.

    Nothing is done where it is kept already, where nothing can be kept, and for files that `run` would refuse.
    """
    if not are_kernels_kept():
        return
    try:
        setup = load_setup(robot, model)
        refuse_missing_effects(setup)
    except InputError:
        return
    with compile_progress(describe_planner(setup), report):
        warm_planner(setup, lambda: planner_of(setup, None))


def describe_planner(setup: Setup) -> str:
    """Describe the planner that is compiled for a setup, with the model's effects."""
    effects = ", ".join(effect.name for effect in setup.model.effects)
    return f"the planner for this task{f' and a model with {effects}' if effects else ''}"


def warm_planner(setup: Setup, new_planner: Callable[[], Planner]) -> Planner:
    """Return a new planner, after all that it will need was run once, by another one."""
    planner = new_planner()
    warm_up(create_pipeline(setup.config, setup.model, new_planner()))
    return planner


# Chosen: a usual drive at 50 Hz, long enough to stand, start, drive and lose poses once.
_PERIOD_NS = 20_000_000
_POSE_DELAY_NS = 30_000_000
_TICKS = 60
_WHEEL_RAD_S = 2.0
_ON_THE_WAY = 20


def warm_up(pipeline: Pipeline) -> None:
    """Drive a pipeline that is thrown away afterwards through standing, driving, late and absurd poses."""
    pipeline.step(0, Readings(), Off())
    for tick in range(1, _TICKS):
        now_ns = tick * _PERIOD_NS
        pipeline.step(now_ns, _readings(now_ns, tick), FollowTask() if tick > _ON_THE_WAY else Standstill())
        pipeline.rollouts(1)


def _readings(now_ns: int, tick: int) -> Readings:
    speed = _WHEEL_RAD_S if tick > _ON_THE_WAY else 0.0
    angle = _WHEEL_RAD_S * max(0, tick - _ON_THE_WAY) * _PERIOD_NS * 1e-9
    wheels = WheelSample(now_ns, now_ns, angle, 1.5 * angle, speed, 1.5 * speed)
    far_off = math.nan if tick == _TICKS - 2 else 1.0 if tick == _TICKS - 3 else 0.0
    pose = PoseSample(now_ns - _POSE_DELAY_NS, now_ns, far_off, 0.06 * angle, 0.5 * math.pi, 0.005, 0.01)
    return Readings(wheels=(wheels,), poses=(pose,) if tick > 1 else ())
