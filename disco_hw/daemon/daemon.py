"""The loop of the daemon in real time around the core, and a stop before anything else ends."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Mapping
from typing import Any

from disco_hw import processes
from disco_hw.daemon import ADAPT_ACTIONS, FENCE, OBSTACLE, PAGE_ACTIONS, TASK, UNRECORDED_HINT
from disco_hw.daemon.control_socket import ControlMessage, ControlServer, counters, loop_figures, status
from disco_hw.daemon.loop import Clock, Loop, SuspendWatch
from disco_hw.daemon.page_feed import WatchedRecorder
from disco_hw.daemon.process import Notifier, StopSignals, Waiting
from disco_hw.fence.clearance import task_breach
from disco_hw.log import records
from disco_hw.runtime import IN_USE, AdviceStyle, State, advice, headline, records_of_tick
from disco_hw.runtime.core import CoreTick, DaemonCore, Pilot
from disco_hw.runtime.obstacles import ObstacleRefused
from disco_hw.runtime.robot_setup import TaskRefused, changed_task
from disco_hw.runtime.safe_area import FenceRefused
from disco_hw.runtime.supervisor import Output, Reply, UserRequest
from drivers.samples import RobotStatus
from drivers.types import Request

# Chosen: periods of what the loop does beside its ticks; shorter ones would take more of their time.
_SECOND_NS = 1_000_000_000
_RECORDER_NS = _SECOND_NS // 10
_COLLECT_NS = 5 * _SECOND_NS
# Chosen: for a stop beside its ramp, as for the brake after it; afterwards the e-stop, and the robot's own watchdog.
_STOP_LIMIT_S = 1.5
_FAN_NS = _SECOND_NS
_WATCHED_FAN_NS = _SECOND_NS // 2
# Chosen: enough to see where the plans go; each costs time of the tick and space in the log.
_FAN_PATHS = 16

_SUSPENDED = (
    "this computer was suspended for {:.3g} s: the robot is disarmed, and the link begins anew; from here on "
    "wall-clock times in the log are that much too early"
)

Report = Callable[[str, str], None]


def state_line(output: Output, robot: RobotStatus | None, pilot: Mapping[str, Any], advice_style: AdviceStyle) -> str:
    """Return the daemon's state and what the operator can do next, as one line; `pilot` is the pilot's status."""
    head, detail = headline(output.state.name, output.detail, output.running, output.estop)
    status = {
        **pilot,
        "state": output.state.name,
        "detail": output.detail,
        "running": output.running,
        "estop": output.estop,
        "robot_state": "UNKNOWN" if robot is None else robot.state,
        "fault": "UNKNOWN" if robot is None else robot.fault,
    }
    return " ".join((f"{head}: {detail}.", *advice(status, advice_style)))


class Daemon:
    """The loop around the core: requests from the control socket, once-a-second housekeeping, the service manager."""

    def __init__(
        self,
        core: DaemonCore,
        server: ControlServer,
        recorder: WatchedRecorder,
        clock: Clock,
        signals: StopSignals,
        report: Report,
        pilot: Pilot,
        advice_style: AdviceStyle | None = None,
        page_messages: Callable[[], tuple[str, ...]] = lambda: (),
    ) -> None:
        self._advice_style = advice_style
        self._page_messages = page_messages
        self._waiting = Waiting()
        self._core = core
        self._server = server
        self._recorder = recorder
        self._clock = clock
        self._report = report
        self._loop = Loop(clock, core.config.control.rate_hz)
        self._suspend_watch = SuspendWatch()
        self._loop_figures = loop_figures(self._loop.stats)
        self._recorder_stats = recorder.poll()
        self._notifier = Notifier()
        self._signals = signals
        self._pilot = pilot
        self._stolen_before_ms = processes.stolen_ms()
        self._stolen_ms = 0
        self._quit = False
        self._failed = False
        self._next_second_ns = 0
        self._next_recorder_ns = 0
        self._next_collect_ns = 0
        self._next_fan_ns = 0
        self._fan: tuple[records.Record, ...] = ()
        self._ready_reported = False

    def run(self) -> int:
        """Run the loop until requested to stop; returns the exit code. An exception is reported and ends it."""
        try:
            self._loop.run(self._tick, lambda: self._quit or self._signals.received is not None or self._pilot.done)
        except Exception as error:
            self._failed = True
            self._report("failed", f"{type(error).__name__}: {error}; stopping the robot")
            raise
        if self._signals.received is not None:
            self._report("daemon", f"{self._signals.received.name}: stopping")
        return 0

    def stop_wheels(self) -> None:
        """Bring the robot to a stand and disarm it; after a failure of the loop by its driver alone.

        What does not stand 1.5 s after the ramp from its top speed is over gets the e-stop. Whatever this achieves,
        the robot's own watchdog stops it when the frames cease.
        """
        self._notifier.stopping()
        if not self._failed:
            try:
                self._until_stopped(self._disarming_tick, lambda: self._core.state not in IN_USE)
            except Exception:
                # Even where the tick itself fails while stopping, the driver stops the robot before that is passed on.
                self._until_stopped(self._stop_by_driver)
                raise
            return
        self._until_stopped(self._stop_by_driver)

    def _until_stopped(self, tick: Callable[[int], None], is_over: Callable[[], bool] = lambda: True) -> None:
        """Call `tick` with the time once a period until the driver's stop `is_over`; send the e-stop if that fails."""
        core, limits = self._core, self._core.driver.limits
        ramp_s = 0.0
        if limits is not None:
            ramp_s = core.config.robot.max_wheel_speed_rad_s / limits.stop_deceleration_rad_s2.value
        deadline_ns = self._clock.now_ns() + round((_STOP_LIMIT_S + ramp_s) * 1e9)
        period_ns = round(1e9 / core.config.control.rate_hz)
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            if self._suspend_watch.suspended_s():
                # The ramp would go on from a speed that the robot had before, and has not any more.
                core.renew_link()
            tick(now_ns)
            if core.driver.is_stop_over and is_over():
                return
            self._clock.sleep_until_ns(now_ns + period_ns)
        self._send_estop()

    def _disarming_tick(self, now_ns: int) -> None:
        """Have the core stop the robot; an e-stop is still accepted."""
        messages = [message for message in self._server.poll() if message.action == UserRequest.ESTOP.value]
        tick = self._core.tick(now_ns, (UserRequest.DISARM, *map(_request, messages)))
        self._handle_messages(messages, tick.output.replies[1:])

    def _stop_by_driver(self, now_ns: int) -> None:
        """Have the driver alone stop the robot, as the rest of the loop has failed; by the e-stop if it cannot."""
        driver, transport = self._core.driver, self._core.transport
        try:
            self._core.follow_link(now_ns)
            driver.receive(now_ns, transport.receive())
            driver.request(Request.STANDBY)
            frames = driver.transmit(now_ns, None)
        except Exception:
            self._send_estop()
            raise
        for frame in frames:
            transport.send(frame, now_ns)

    def _send_estop(self) -> None:
        now_ns = self._clock.now_ns()
        for frame in self._core.driver.estop(now_ns):
            self._core.transport.send(frame, now_ns)

    def _tick(self, now_ns: int) -> None:
        mark = self._loop.stages.mark
        messages = self._server.poll()
        requests = tuple(_request(message) for message in messages if message.action in _REQUESTS)
        for message in messages:
            if message.action == "drive":
                self._steer(now_ns, message)
            elif message.action == TASK:
                self._change_task(message)
            elif message.action in {OBSTACLE, FENCE}:
                self._change_area(now_ns, message)
        desired = self._pilot.step(now_ns, self._core.last)
        events = tuple(records.Event(now_ns, "info", "drive", text) for text in desired.events)
        if suspended_s := self._suspend_watch.suspended_s():
            # No age shows it, and a driver would go on commanding what its controller has stopped since.
            self._core.renew_link()
            text = _SUSPENDED.format(suspended_s)
            self._report("link", text)
            events = (*events, records.Event(now_ns, "warning", "link", text))
        mark("control")
        tick = self._core.tick(
            now_ns,
            (*requests, *desired.requests),
            (self._timing(now_ns), *self._monitor_recorder(now_ns), *self._every_second(now_ns), *self._fan, *events),
            mark,
            desired.motion,
            desired.by_hand,
        )
        self._handle_messages(messages, tick.output.replies)
        self._fan = self._look_at_samples(now_ns) if tick.pipeline.plan is not None else ()
        self._pilot.learn(now_ns, tick, tick.output.replies[len(requests) :])
        for text in desired.events:
            self._report("drive", text)
        for text in tick.events:
            self._report("event", text)
        state = tick.output.state
        if not self._ready_reported:
            self._notifier.ready()
            self._ready_reported = True
        self._notifier.watchdog(now_ns)
        if state is not State.ARMED and now_ns >= self._next_collect_ns:
            # The collector is off; what cycles there are go while nobody depends on the loop.
            gc.collect()
            self._next_collect_ns = now_ns + _COLLECT_NS

    def _timing(self, now_ns: int) -> records.Record:
        stats = self._loop.stats
        return records.LoopTiming(
            t_ns=now_ns - stats.last_lateness_ns,
            tick=stats.ticks,
            woke_ns=now_ns,
            lateness_ns=stats.last_lateness_ns,
            stages_ns=self._loop.stages.last_ns,
            overruns=stats.overruns,
            skipped=stats.skipped_periods,
        )

    def _look_at_samples(self, now_ns: int) -> tuple[records.Record, ...]:
        """Return sampled rollouts of the plan for the next tick's record, once or twice a second.

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

    def _monitor_recorder(self, now_ns: int) -> tuple[records.Record, ...]:
        """Look after the recorder ten times a second; what happens to it and to the page becomes events."""
        if now_ns < self._next_recorder_ns:
            return ()
        self._next_recorder_ns = now_ns + _RECORDER_NS
        if self._core.state not in IN_USE:
            self._recorder.repair()
        self._recorder_stats = self._recorder.poll()
        self._core.recording_fault = self._recorder_stats.fault
        messages = self._recorder.new_messages()
        for sentence in messages:
            self._report("recording", sentence)
        # What becomes of the page is on standard error already.
        coded = [
            *(("recording", sentence) for sentence in messages),
            *(("page", text) for text in self._page_messages()),
        ]
        return tuple(records.Event(now_ns, "warning", code, sentence) for code, sentence in coded)

    def _every_second(self, now_ns: int) -> tuple[records.Record, ...]:
        if now_ns < self._next_second_ns:
            return ()
        self._next_second_ns = now_ns + _SECOND_NS
        self._loop_figures = loop_figures(self._loop.stats)
        last = self._core.last
        if last is not None:
            self._report_state(last)
        # Where no file can be opened any more the figure stays: the log must not end the drive.
        with contextlib.suppress(OSError):
            self._stolen_ms = processes.stolen_ms() - self._stolen_before_ms
        counted = counters(self._core, self._loop.stats, self._recorder_stats, now_ns, self._stolen_ms)
        restored = self._server.restore()
        if restored is None:
            return (counted,)
        self._recorder.restore_feeds()
        self._report("control socket", restored)
        return counted, records.Event(now_ns, "warning", "control socket", restored)

    def _report_state(self, last: CoreTick) -> None:
        """Say how things are and what to do, to the service manager and to whoever reads the output."""
        output = last.output
        head, detail = headline(output.state.name, output.detail, output.running, output.estop)
        self._notifier.status(f"{head}: {detail}")
        if self._advice_style is None:
            return
        text = state_line(output, self._core.robot_status, self._pilot.status(), self._advice_style)
        if self._waiting.should_report(output.state, text):
            self._report("state", text)

    def _steer(self, now_ns: int, message: ControlMessage) -> None:
        """Hand what a page wants to the pilot; the reply's stamp is what its next request must carry."""
        refusal = self._pilot.steer(now_ns, message.client, message.arguments)
        body: dict[str, Any] = {"ok": refusal is None, "stamp": str(now_ns)}
        self._server.reply(message, body if refusal is None else {**body, "error": refusal})

    def _change_area(self, now_ns: int, message: ControlMessage) -> None:
        """Add or remove an obstacle, change the fence, or let a person drive in spite of it."""
        area = self._core.area
        try:
            if message.action == OBSTACLE:
                text = area.handle_request(now_ns, message.arguments)
            elif set(message.arguments) == {"override"}:
                text = area.override(now_ns, message.arguments["override"] is True)
            else:
                text = area.change_fence(now_ns, message.arguments, self._core.state)
                fault = task_breach(area.fence, self._core.config.footprint_along_line, self._core.course)
                text += "" if fault is None else f"; the task does not fit into it: {fault}"
        except (ObstacleRefused, FenceRefused) as refused:
            self._server.reply(message, {"ok": False, "error": str(refused)})
            return
        self._report("fence", text)
        self._server.reply(message, {"ok": True, "text": text})

    def _change_task(self, message: ControlMessage) -> None:
        """Change the task, if this state and the robot's limits allow it."""
        try:
            task = changed_task(self._core.task, message.arguments, self._core.task_config, self._core.state)
            fault = task_breach(self._core.area.fence, self._core.config.footprint_along_line, task.course())
            if fault is not None:
                raise TaskRefused(f"fence: {fault}; keep the task inside")
        except TaskRefused as refused:
            self._server.reply(message, {"ok": False, "error": str(refused)})
            return
        self._core.set_task(task)
        text = task.describe()
        self._report("task", text)
        self._server.reply(message, {"ok": True, "text": text})

    def _handle_messages(self, messages: list[ControlMessage], replies: tuple[Reply, ...]) -> None:
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
                    body |= {"error": f"{reply.text}; {UNRECORDED_HINT}", "unrecorded": True}
            elif message.action in ADAPT_ACTIONS:
                obeyed, text = self._core.adaptation.handle_request(message.action)
                body = {"ok": obeyed, "text" if obeyed else "error": text}
            elif message.action == "quit":
                self._quit = True
                body = {"ok": True, "text": "stopping the robot and ending"}
            else:
                body = status(self._core, self._loop_figures, self._recorder_stats) | self._pilot.status()
            self._server.reply(message, body)


_REQUESTS = frozenset(request.value for request in UserRequest if request is not UserRequest.ARM_UNRECORDED)


def _request(message: ControlMessage) -> UserRequest:
    """Return the request to the supervisor that a message stands for."""
    if message.action == UserRequest.ARM.value and message.arguments.get("unrecorded") is True:
        return UserRequest.ARM_UNRECORDED
    return UserRequest(message.action)
