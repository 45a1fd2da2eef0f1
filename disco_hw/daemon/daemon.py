"""The on-robot daemon: the loop in real time around the core, and a stop before anything else ends."""

from __future__ import annotations

import contextlib
import gc
import json
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from disco_hw.adaptation.adaptation import GeometryAdaptation
from disco_hw.adaptation.guard import check_adaptable, choose_adaptation
from disco_hw.adaptation.link import ProcessLink
from disco_hw.config import RobotConfig
from disco_hw.control.law import Law, LawController
from disco_hw.daemon import realtime
from disco_hw.daemon.async_printer import STANDARD_OUTPUT, AsyncPrinter, Waiting
from disco_hw.daemon.client import (
    ADAPT_ACTIONS,
    PAGE_ACTIONS,
    SERVED,
    UNRECORDED_REMEDY,
    recording_in_words,
    socket_path,
)
from disco_hw.daemon.compiling import compiled_elsewhere, warm_up
from disco_hw.daemon.control_socket import ControlMessage, ControlServer
from disco_hw.daemon.loop import Clock, Loop, MonotonicClock
from disco_hw.daemon.page_feed import ViewerFeed, WatchedRecorder, feed_path, tick_feed_path
from disco_hw.daemon.signals import Notifier, StopPath, StopSignals
from disco_hw.daemon.socket_place import passed_over
from disco_hw.daemon.status import counters, loop_figures, status
from disco_hw.log import records
from disco_hw.log.link import Attachment
from disco_hw.log.provenance import DBC, version
from disco_hw.log.recorder import NullRecorder, ProcessRecorder, Recorder, RecordingSettings
from disco_hw.runtime import records_of_tick
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
from disco_hw.runtime.core import CoreTick, DaemonCore
from disco_hw.runtime.pilot import FindsWiring, Pilot, TaskPilot
from disco_hw.runtime.pipeline import NoPlanner, Pipeline, Planner
from disco_hw.runtime.robot_setup import Setup, kept_files, link_key, load_setup, refuse_missing_effects, scene_of
from disco_hw.runtime.states import Ask, State, advice, by_command, headline
from disco_hw.runtime.supervisor import Reply, UserRequest
from disco_hw.runtime.task_change import TaskRefused, changed_task
from drivers.types import Request, Transport
from firmware_protocol.dbc import packaged_dbc

_SECOND_NS = 1_000_000_000
_RECORDER_NS = _SECOND_NS // 10
_COLLECT_NS = 5 * _SECOND_NS
_STOP_LIMIT_NS = 1_500_000_000
_FAN_NS = _SECOND_NS
_WATCHED_FAN_NS = _SECOND_NS // 2
_FAN_PATHS = 16

Say = Callable[[str, str], None]
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


class Daemon:
    """The loop around the core: requests from the control socket, once-a-second housekeeping, the service manager."""

    def __init__(
        self,
        core: DaemonCore,
        server: ControlServer,
        recorder: WatchedRecorder,
        clock: Clock,
        signals: StopSignals,
        say: Say,
        pilot: Pilot,
        ask: Ask | None = None,
    ) -> None:
        self._ask = ask
        self._waiting = Waiting()
        self._core = core
        self._server = server
        self._recorder = recorder
        self._clock = clock
        self._say = say
        self._loop = Loop(clock, core.config.control.rate_hz)
        self._loop_figures = loop_figures(self._loop.stats)
        self._recorder_stats = recorder.poll()
        self._notifier = Notifier()
        self._signals = signals
        self._pilot = pilot
        self._stolen_before_ms = realtime.stolen_ms()
        self._quit = False
        self._failed = False
        self._next_second_ns = 0
        self._next_recorder_ns = 0
        self._next_collect_ns = 0
        self._next_fan_ns = 0
        self._fan: tuple[records.Record, ...] = ()
        self._told_ready = False

    def run(self) -> int:
        """Run the loop until told to stop; returns the exit code. An exception is reported and ends it."""
        try:
            self._loop.run(self._tick, lambda: self._quit or self._signals.received is not None or self._pilot.done)
        except Exception as error:
            self._failed = True
            self._say("failed", f"{type(error).__name__}: {error}; stopping the robot")
            raise
        if self._signals.received is not None:
            self._say("daemon", f"{self._signals.received.name}: stopping")
        return 0

    def stop_wheels(self) -> None:
        """Bring the robot to a stand and disarm it, within 1.5 s; after a failure by the shortest way there is.

        Whatever this achieves, the robot's own watchdog stops it when the frames cease.
        """
        self._notifier.stopping()
        if self._failed:
            self._send_stop()
            return
        deadline_ns = self._clock.now_ns() + _STOP_LIMIT_NS
        period_ns = round(1e9 / self._core.config.control.rate_hz)
        requests: tuple[UserRequest, ...] = (UserRequest.DISARM,)
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            try:
                tick = self._core.tick(now_ns, requests)
            except Exception:
                # Even where the tick itself fails while stopping, the robot is told to stop before that is passed on.
                self._send_stop()
                raise
            requests = ()
            if tick.output.state not in {State.ARMED, State.STOPPING}:
                return
            self._clock.sleep_until_ns(now_ns + period_ns)
        self._send_stop()

    def _send_stop(self) -> None:
        """Ask for standby by the driver alone, and by the e-stop if the driver cannot."""
        core, now_ns = self._core, self._clock.now_ns()
        try:
            core.driver.request(Request.STANDBY)
            frames = core.driver.transmit(now_ns, None)
        except Exception:
            # A driver that cannot even ask for standby has one frame left that needs no state.
            for frame in core.driver.estop(now_ns):
                core.transport.send(frame, now_ns)
            raise
        for frame in frames:
            core.transport.send(frame, now_ns)

    def _tick(self, now_ns: int) -> None:
        mark = self._loop.stages.mark
        messages = self._server.poll()
        requests = tuple(_request(message) for message in messages if message.action in _REQUESTS)
        for message in messages:
            if message.action == "drive":
                self._steer(now_ns, message)
            elif message.action == "task":
                self._change_task(message)
        wanted = self._pilot.step(now_ns, self._core.last)
        events = tuple(records.Event(now_ns, "info", "drive", text) for text in wanted.events)
        mark("control")
        tick = self._core.tick(
            now_ns,
            (*requests, *wanted.requests),
            (self._timing(now_ns), *self._mind_recorder(now_ns), *self._every_second(now_ns), *self._fan, *events),
            mark,
            wanted.motion,
            wanted.by_hand,
        )
        self._answer(messages, tick.replies)
        self._fan = self._look_at_samples(now_ns) if tick.pipeline.plan is not None else ()
        self._pilot.learn(now_ns, tick, tick.replies[len(requests) :])
        for text in wanted.events:
            self._say("drive", text)
        for text in tick.events:
            self._say("event", text)
        state = tick.output.state
        if not self._told_ready:
            self._notifier.ready()
            self._told_ready = True
        self._notifier.watchdog(now_ns)
        if state is not State.ARMED and now_ns >= self._next_collect_ns:
            # The collector is off; what cycles there are go while nobody depends on the loop.
            gc.collect()
            self._core.adaptation.tend()
            self._next_collect_ns = now_ns + _COLLECT_NS

    def _timing(self, now_ns: int) -> records.Record:
        stats = self._loop.stats
        return records.LoopTiming(
            t_ns=now_ns - stats.last_lateness_ns,
            tick=stats.ticks,
            woke_ns=now_ns,
            lateness_ns=stats.last_lateness_ns,
            stages_ns=self._loop.stages.last_ns(),
            overruns=stats.overruns,
            skipped=stats.skipped_periods,
        )

    def _look_at_samples(self, now_ns: int) -> tuple[records.Record, ...]:
        """What the plan was weighed from, once or twice a second, for the next tick's record.

        After the command has gone out, and only if most of the period is left: it can never make a command late.
        """
        period_ns = round(1e9 / self._core.config.control.rate_hz)
        if now_ns < self._next_fan_ns or self._clock.now_ns() - now_ns > period_ns // 2:
            return ()
        rollouts = self._core.pipeline.rollouts(_FAN_PATHS)
        if rollouts is None or not len(rollouts.weights):
            return ()
        self._next_fan_ns = now_ns + (_WATCHED_FAN_NS if self._recorder.watched else _FAN_NS)
        return (records_of_tick.fan(now_ns, rollouts),)

    def _mind_recorder(self, now_ns: int) -> tuple[records.Record, ...]:
        """Look after the recorder ten times a second; what happens to it goes to the terminal, the log and the page."""
        if now_ns < self._next_recorder_ns:
            return ()
        self._next_recorder_ns = now_ns + _RECORDER_NS
        last = self._core.last
        if last is None or last.output.state not in {State.ARMED, State.STOPPING}:
            self._recorder.tend()
        self._recorder_stats = self._recorder.poll()
        self._core.recording_fault = self._recorder_stats.fault
        news = self._recorder.news()
        for sentence in news:
            self._say("recording", sentence)
        return tuple(records.Event(now_ns, "warning", "recording", sentence) for sentence in news)

    def _every_second(self, now_ns: int) -> tuple[records.Record, ...]:
        if now_ns < self._next_second_ns:
            return ()
        self._next_second_ns = now_ns + _SECOND_NS
        self._loop_figures = loop_figures(self._loop.stats)
        last = self._core.last
        if last is not None:
            self._tell_state(last)
        stolen_ms = realtime.stolen_ms() - self._stolen_before_ms
        return (counters(self._core, self._loop.stats, self._recorder_stats, now_ns, stolen_ms),)

    def _tell_state(self, last: CoreTick) -> None:
        """Say how things are and what to do, to the service manager and to whoever reads the output."""
        output, robot = last.output, self._core.robot_status
        head, detail = headline(output.state.name, output.detail, output.running, output.estop)
        self._notifier.status(f"{head}: {detail}")
        if self._ask is None:
            return
        known = {
            **self._pilot.status(),
            "state": output.state.name,
            "running": output.running,
            "estop": output.estop,
            "robot_state": "UNKNOWN" if robot is None else robot.state,
            "fault": "UNKNOWN" if robot is None else robot.fault,
        }
        words = " ".join((f"{head}: {detail}.", *advice(known, self._ask)))
        if self._waiting.is_worth_saying(output.state, words):
            self._say("state", words)

    def _steer(self, now_ns: int, message: ControlMessage) -> None:
        """Hand what a page wants to the pilot; the reply's stamp is what its next request must carry."""
        refusal = self._pilot.steer(now_ns, message.client, message.arguments)
        body: dict[str, Any] = {"ok": refusal is None, "stamp": str(now_ns)}
        self._server.reply(message, body if refusal is None else {**body, "error": refusal})

    def _change_task(self, message: ControlMessage) -> None:
        """Change the task, if this state and the robot's limits allow it."""
        last = self._core.last
        state = State.DISCONNECTED if last is None else last.output.state
        try:
            task = changed_task(self._core.task, message.arguments, self._core.config.robot, state)
        except TaskRefused as refused:
            self._server.reply(message, {"ok": False, "error": str(refused)})
            return
        self._core.set_task(task)
        text = task.in_words()
        self._say("task", text)
        self._server.reply(message, {"ok": True, "text": text})

    def _answer(self, messages: list[ControlMessage], replies: tuple[Reply, ...]) -> None:
        """Answer what is not answered yet: requests to the supervisor with its words, the others here."""
        remaining = list(replies)
        for message in messages:
            if message.action in PAGE_ACTIONS:
                continue
            if message.action in _REQUESTS:
                reply = remaining.pop(0)
                body: dict[str, Any] = {"ok": reply.accepted}
                body["text" if reply.accepted else "error"] = reply.text
                if reply.request is UserRequest.ARM and not reply.accepted and reply.text == self._core.recording_fault:
                    body |= {"error": f"{reply.text}; {UNRECORDED_REMEDY}", "unrecorded": True}
            elif message.action in ADAPT_ACTIONS:
                obeyed, text = self._core.adaptation.ask(message.action)
                body = {"ok": obeyed, "text" if obeyed else "error": text}
            elif message.action == "quit":
                self._quit = True
                body = {"ok": True, "text": "stopping the robot and ending"}
            else:
                body = status(self._core, self._loop_figures, self._recorder_stats) | self._pilot.status()
            self._server.reply(message, body)


_REQUESTS = frozenset(request.value for request in UserRequest if request is not UserRequest.ARM_UNRECORDED)


def _request(message: ControlMessage) -> UserRequest:
    """What a message asks of the supervisor."""
    if message.action == UserRequest.ARM.value and message.arguments.get("unrecorded") is True:
        return UserRequest.ARM_UNRECORDED
    return UserRequest(message.action)


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
