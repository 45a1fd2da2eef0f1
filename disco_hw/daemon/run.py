"""What `disco-hw run` does: makes the daemon in the order that real time needs, runs it, and undoes it all after."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from disco_hw.adaptation.adaptation import GeometryAdaptation
from disco_hw.adaptation.guard import check_adaptable, choose_adaptation
from disco_hw.adaptation.link import ProcessLink
from disco_hw.config import RobotConfig
from disco_hw.control.law import Law, LawController
from disco_hw.daemon import realtime
from disco_hw.daemon.async_printer import STANDARD_OUTPUT, AsyncPrinter
from disco_hw.daemon.client import SERVED, passed_over, recording_in_words, socket_path
from disco_hw.daemon.compiling import compiled_elsewhere, warm_up
from disco_hw.daemon.control_socket import ControlServer
from disco_hw.daemon.daemon import Daemon, Say
from disco_hw.daemon.loop import MonotonicClock
from disco_hw.daemon.page_feed import ViewerFeed, WatchedRecorder, feed_path, tick_feed_path
from disco_hw.daemon.signals import StopPath, StopSignals
from disco_hw.log.link import DBC, Attachment, version
from disco_hw.log.recorder import NullRecorder, ProcessRecorder, Recorder, RecordingSettings
from disco_hw.runtime.assembly import (
    assemble_core,
    driver_of,
    make_adaptation,
    make_audited_adaptation,
    make_fast_adaptation,
    make_link,
    make_pipeline,
    make_planner,
)
from disco_hw.runtime.pilot import FindsWiring, Pilot, TaskPilot
from disco_hw.runtime.pipeline import NoPlanner, Pipeline, Planner
from disco_hw.runtime.robot_setup import Setup, kept_files, link_key, load_setup, refuse_missing_effects, scene_of
from disco_hw.runtime.states import Ask, by_command
from drivers.types import Transport
from firmware_protocol.dbc import packaged_dbc

Adapt = Literal["off", "fast", "audited", "network"]
"""Who learns the geometry on the way: nobody, a filter in the tick, the same audited by a network in a process of its
own, or that network alone."""


@dataclass(frozen=True, slots=True)
class DaemonOptions:
    """What `disco-hw run` was asked; None leaves what robot.toml says."""

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
    those of `disco-hw run`. Returns after Ctrl-C, SIGTERM or `disco-hw ctl ROBOT.toml quit`, with the robot told to
    stop. Call it in the main thread, as it catches signals. Raises InputError.
    """
    realtime.spare_memory()
    options = DaemonOptions(
        Path(robot), None if model is None else Path(model), link, None if log is None else Path(log)
    )
    return run_daemon(options, law=law)


def run_daemon(
    options: DaemonOptions,
    make_pilot: Callable[[RobotConfig], Pilot] = lambda _config: TaskPilot(),
    law: Law | None = None,
) -> int:
    """Run until SIGTERM, SIGINT or a quit request; returns the exit code, with the robot told to stop.

    `make_pilot`: of who drives; the task alone, unless it is said. `law`: plans in DISCO's place.
    Raises InputError, before anything is opened, if a file or an option is wrong. An exception in the loop is reported,
    the robot stopped, and the exception passed on.
    """
    setup = load_setup(options.robot, options.model, options.link)
    if not options.accept_missing_effects:
        refuse_missing_effects(setup)
    adapt: Adapt = "network"
    if options.adapt:
        check_adaptable(setup.model, setup.config.control.uncertainty)
    else:
        adapt = choose_adaptation(setup.config.control, setup.config.pose, setup.model).kind
    with closing(AsyncPrinter(STANDARD_OUTPUT, in_json if options.as_json else in_text)) as say:
        return serve(
            setup,
            options.log_file,
            say,
            make_pilot(setup.config),
            lambda: make_planner(setup.config, setup.model) if law is None else _controller(law, setup),
            adapt,
            by_command(options.robot),
        )


def _controller(law: Law, setup: Setup) -> LawController:
    return LawController(law, setup.model, setup.config.task.planned(setup.config.control.mode))


def serve(
    setup: Setup,
    log_file: Path | None,
    say: Say,
    pilot: Pilot,
    new_planner: Callable[[], Planner] = NoPlanner,
    adapt: Adapt = "off",
    ask: Ask | None = None,
) -> int:
    """Run until SIGTERM, SIGINT, a quit request or the pilot's end, as `run_daemon`; returns the exit code.

    `say` is called in the loop, and so must not wait. `pilot` decides what the robot does while motion is allowed;
    `new_planner` is called twice, as one planner is used up in the warm-up. `adapt`: who learns the geometry on the
    way; nobody where a person drives. `ask`: how a person asks for what comes next; with it the daemon says what it
    waits for, what to do, and where the log is. Raises InputError.
    """
    key, transport = link_key(setup), make_link(setup)
    # Before the signals are caught: whoever has enough of a compilation may break it off, as nothing is open yet.
    planner = compiled_elsewhere(lambda: _warm_planner(setup, new_planner), _compiled(setup), _progress)
    pipeline = make_pipeline(setup.config, setup.model, planner)
    stop = StopPath()
    with StopSignals() as signals:
        try:
            return _start(setup, key, transport, pipeline, log_file, signals, stop, say, pilot, adapt, ask).run()
        finally:
            # Whatever is interrupted here, the wheels come first: they were added last.
            for outcome in stop.run():
                if not outcome.ok:
                    say("stop", f"{outcome.name}: {outcome.error}")


def _start(
    setup: Setup,
    key: bytes | None,
    transport: Transport,
    pipeline: Pipeline,
    log_file: Path | None,
    signals: StopSignals,
    stop: StopPath,
    say: Say,
    pilot: Pilot,
    adapt: Adapt,
    ask: Ask | None,
) -> Daemon:
    """Make everything, in the order that real time needs, and add to the stop path what must be undone."""
    config = setup.config
    # The planner was compiled before: whoever finds the socket gets an answer.
    server = ControlServer(socket_path(config), SERVED)
    stop.add("control socket", server.close)
    feed = ViewerFeed(feed_path(server.path))
    stop.add("page feed", feed.close)
    ticks = ViewerFeed(tick_feed_path(server.path), period_s=0.0)
    stop.add("tick feed", ticks.close)
    log = _log_path(config, log_file)
    recorder = WatchedRecorder(_make_recorder(setup, log), feed, ticks)
    if ask is not None and log is not None:
        stop.add("log", lambda: say("log", f"look at it: disco-hw view {log}, or disco-hw log info {log}"))
    stop.add("recorder", lambda: _close_recorder(recorder, say))
    adaptation: GeometryAdaptation | None = None
    match adapt:
        case "network":
            adaptation = make_adaptation(setup, pipeline, ProcessLink())
        case "fast":
            adaptation = make_fast_adaptation(setup, pipeline)
        case "audited":
            adaptation = make_audited_adaptation(setup, pipeline, ProcessLink())
    if adaptation is not None:
        stop.add("adapter", adaptation.close)
    for step in realtime.enter(config.daemon.realtime_priority):
        say("real time", str(step))
    for line in passed_over(server.path):
        say("control socket", line)
    transport.open()
    stop.add("link", transport.close)
    driver = driver_of(config, key)
    core = assemble_core(config, transport, driver, pipeline, recorder, pilot.needs_pose, adaptation)
    core.announce = recorder.announce
    stop.add("pose source", core.pose_source.close)
    if isinstance(pilot, FindsWiring):
        core.directions = None
    daemon = Daemon(core, server, recorder, MonotonicClock(), signals, say, pilot, ask)
    stop.add("wheels", daemon.stop_wheels)
    if config.daemon.realtime_priority:
        say("real time", str(realtime.raise_loop_thread(config.daemon.realtime_priority)))
    say("daemon", f"{transport.name}, control socket {server.path}")
    if ask is not None:
        say("log", f"recording to {log}" if log is not None else "nothing is recorded, as log.enabled is false")
        say("next", f"once it says READY, {ask('arm')}, then {ask('start')}")
    return daemon


def _warm_planner(setup: Setup, new_planner: Callable[[], Planner]) -> Planner:
    """A new planner, after all that it will need was run once."""
    planner = new_planner()
    warm_up(make_pipeline(setup.config, setup.model, new_planner()))
    return planner


def _compiled(setup: Setup) -> str:
    """What the planner is compiled for, in words."""
    effects = ", ".join(effect.name for effect in setup.model.effects)
    return f"the planner for this task{f' and a model with {effects}' if effects else ''}"


def _progress(text: str) -> None:
    """Write a line to standard error at once; for the time before the loop, when waiting harms nobody."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def _log_path(config: RobotConfig, log_file: Path | None) -> Path | None:
    """Where is recorded to; None if nothing is."""
    if log_file is not None or not config.log.enabled:
        return log_file
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    return Path(config.log.directory) / f"{config.robot.name}-{stamp}.mcap"


def _make_recorder(setup: Setup, log: Path | None) -> Recorder:
    if log is None:
        return NullRecorder()
    attachments = [*kept_files(setup), Attachment(DBC, "text/plain", packaged_dbc().encode())]
    name = setup.config.robot.name
    scene = scene_of(setup.config)
    return ProcessRecorder(RecordingSettings(log, name, version=version(), attachments=tuple(attachments), scene=scene))


def _close_recorder(recorder: Recorder, say: Say) -> None:
    stats = recorder.close()
    for sentence in recorder.news():
        say("recording", sentence)
    if stats.path:
        # No fault: of those `drive` makes a drive that is not whole.
        say("log", recording_in_words(asdict(stats)))


def in_text(topic: str, text: str) -> str:
    """A sentence of the daemon for a person."""
    return f"{topic}: {text}"


def in_json(topic: str, text: str) -> str:
    """A sentence of the daemon for machines."""
    return json.dumps({"topic": topic, "text": text})
