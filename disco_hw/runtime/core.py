"""The daemon without clock, thread or process: one tick from received frames to sent frames.

The real-time shell and the harness in simulated time run this same object. Where the robot goes while motion is allowed
a pilot says: the task's planner, or somebody in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import msgspec

from disco_hw.adaptation import GeometryAdaptation
from disco_hw.config import RobotConfig
from disco_hw.log import records
from disco_hw.log.recorder import Recorder
from disco_hw.runtime import records_of_tick
from disco_hw.runtime.directions import Directions
from disco_hw.runtime.obstacles import TOO_MANY, ObstacleRefused, UdpObstacles
from disco_hw.runtime.pipeline import FollowTask, Motion, Off, Pipeline, Source, Standstill, Tick, untimed
from disco_hw.runtime.plausibility import FOLLOWS, Headway, PlannerEvents, Plausibility, PlausibilityStats, PoseJumps
from disco_hw.runtime.robot_setup import config_for_tasks, record_of
from disco_hw.runtime.safe_area import SafeArea
from disco_hw.runtime.supervisor import Inputs, Output, Reply, Supervisor, UserRequest
from disco_hw.runtime.wheel_faults import WheelFaults
from disco_hw.tasks import RobotTask
from drivers.motor import find_driver
from drivers.types import (
    Driver,
    DriverState,
    Identity,
    Limits,
    LinkState,
    MessageSource,
    PoseSource,
    Readings,
    RobotStatus,
    Transport,
    WheelCommand,
    WheelSample,
)

STATUS_HOLDS_NS = 500_000_000
"""What the robot said of its state is not known any more after so long: five of its reports have failed to come."""
_FOLLOW_TASK = FollowTask()


class CoreTick(msgspec.Struct, frozen=True, gc=False):
    """Result of one tick: the supervisor's verdict, the pipeline's work, the command sent (None if none was).

    `readings`: what it worked from.
    """

    output: Output
    pipeline: Tick
    command: WheelCommand | None
    events: tuple[str, ...]
    readings: Readings = Readings()


class DaemonCore:
    """Transport, driver, supervisor, pipeline and recorder in one tick.

    `preflight(driver)` is called once for each handshake; the sentences it returns keep the robot from being armed.
    """

    def __init__(
        self,
        config: RobotConfig,
        transport: Transport,
        driver: Driver,
        supervisor: Supervisor,
        pipeline: Pipeline,
        recorder: Recorder,
        preflight: Callable[[Driver], tuple[str, ...]],
        adaptation: GeometryAdaptation,
        pose_source: PoseSource,
        obstacle_source: UdpObstacles | None,
    ) -> None:
        self.config = config
        self.task_config = config_for_tasks(config, pipeline.fusion.parameters.x_icr_m)
        """What another task is judged by."""
        self.transport = transport
        self.driver = driver
        self.pose_source = pose_source
        self.obstacle_source = obstacle_source
        self.pipeline = pipeline
        self.area = SafeArea(pipeline.guard, config.fence, config.robot.footprint)
        self.recorder = recorder
        self.adaptation = adaptation
        self._plausibility = Plausibility()
        kind = find_driver(config.link.driver)
        card = kind.safety_card(config.link.settings())
        self._wheel_faults = WheelFaults(kind.takes_body_speeds, card.stops_by_own_ramp)
        robot = config.robot
        self.directions: Directions | None = Directions(robot.wheel_radius_m, robot.axial_distance_m, config.wheels)
        """None where somebody finds out how the wheels are wired, and looks at them: no fault of one stops it then."""
        self.task, self.course = config.task, config.task.course()
        self.progress = config.task.progress()
        self._headway = Headway(config.task.reference_speed_m_s)
        self.newest_wheels: WheelSample | None = None
        self.robot_status: RobotStatus | None = None
        self.last: CoreTick | None = None
        self.recording_fault = ""
        """Why nothing is recorded although it should be, kept up to date by whoever looks after the recorder."""
        self.announce: Callable[[int, Sequence[WheelSample]], None] = lambda _now_ns, _wheels: None
        """Hears the wheels of a tick before it is planned, for whoever cannot wait for its record; must not block."""
        self._jumps = PoseJumps()
        self._jump = ""
        self._supervisor = supervisor
        self._preflight = preflight
        self._preflight_errors: tuple[str, ...] = ()
        self._miswired: tuple[str, ...] = ()
        self._controller: tuple[Identity, Limits] | None = None
        self._controller_changed = False
        self._generation = 0
        self._link_up = self._link_renewed = False
        self._planner_events = PlannerEvents(config.control.fallback)
        self.state = supervisor.state
        self._last_reported: tuple[str, bool, bool] | None = None
        self.entered: dict[str, int] = {}
        self._task_changed = False

    @property
    def plausibility(self) -> PlausibilityStats:
        """A snapshot of what was counted of wheels, supply and poses."""
        counted = self._plausibility
        return PlausibilityStats(self._wheel_faults.not_following, counted.supply_dips, counted.poses_frozen)

    def set_task(self, task: RobotTask) -> None:
        """Follow another task of the same kind from the next tick on, in which it is recorded."""
        self.task, self.course, self.progress = task, task.course(), task.progress()
        self._headway = Headway(task.reference_speed_m_s)
        self.pipeline.set_task(task.planned(self.config.control.mode), self.course.outline_m())
        self._task_changed = True

    def tick(
        self,
        now_ns: int,
        requests: Sequence[UserRequest] = (),
        extra_records: Sequence[records.Record] = (),
        mark: Callable[[str], None] = untimed,
        motion: Motion = _FOLLOW_TASK,
        by_hand: bool = False,
    ) -> CoreTick:
        """Advance by one tick: receive, decide, estimate, plan, command, record.

        `extra_records` are recorded with the tick; `mark(stage)` is called at the end of each stage; `motion` is what
        the robot does if the supervisor allows motion, `by_hand` with a person who sees it. Never raises on
        what the robot sent.
        """
        self.follow_link(now_ns)
        frames = self.transport.receive()
        readings = self.driver.receive(now_ns, frames)
        poses = self.pose_source.receive(now_ns, readings.poses)
        readings = msgspec.structs.replace(readings, poses=tuple(poses))
        self._store(now_ns, readings)
        believed = self.pipeline.screen(readings)
        if readings.wheels:
            self.announce(now_ns, readings.wheels)
        self._watch_wheels(now_ns, believed)
        output = self._supervisor.step(now_ns, self._inputs(now_ns, requests, by_hand))
        mark("receive")
        estimated = self.adaptation.step(now_ns)
        overridden = self._begin_fence(now_ns, by_hand)
        result = self.pipeline.step(now_ns, believed, _motion(output, motion), mark, overridden)
        self._jump = self._jumps.step(result.estimate, result.pose_updates)
        fence_events, fence_records = self.area.end(now_ns, result.fence, overridden)
        command = self._command(output, result)
        sent = self._send(now_ns, output, command, silent=result.source is Source.SILENT)
        mark("send")
        doubts = self._plausibility.step(readings.wheels, readings.poses, readings.power)
        self._watch_wiring(now_ns, believed, command)
        events = (
            *readings.events,
            *self._pose_events(),
            *output.events,
            *estimated.events,
            *self._planner_events.step(result.source, result.plan, result.planner_failure),
            *self._wheel_faults.events,
            *doubts,
            *fence_events,
            *self._stays(now_ns, output, result),
        )
        self._follow_progress(output, result, motion)
        self.recorder.put(
            now_ns,
            [
                *records_of_tick.frames_in(frames),
                *self._controller_change(now_ns),
                *records_of_tick.samples(readings),
                *records_of_tick.tick(result, command, self.config.control.command_valid_for_s),
                *sent,
                *self._state_change(now_ns, output),
                *self._task_change(now_ns),
                *estimated.records,
                *fence_records,
                *(records.Event(now_ns, "info", "daemon", text) for text in events),
                *extra_records,
            ],
        )
        self.adaptation.feed(now_ns, self._to_learn_from(believed))
        mark("record")
        self.last = CoreTick(output, result, command, events, readings)
        return self.last

    def _watch_wheels(self, now_ns: int, readings: Readings) -> None:
        """Stop a robot of which a wheel does not obey: by its driver, without torque, as a ramp would need encoders."""
        geometry = self.pipeline.fusion.parameters
        directions = self.directions
        is_wiring_known = directions is not None and directions.is_evaluated
        fault = self._wheel_faults.step(now_ns, readings.wheels, readings.poses, geometry, is_wiring_known)
        if fault is not None and directions is not None and self.driver.state is DriverState.ARMED:
            self.driver.release(fault.status_text)

    def _watch_wiring(self, now_ns: int, readings: Readings, command: WheelCommand | None) -> None:
        """Stop a robot that is wired otherwise than declared, until the daemon has read what was mended."""
        wheels = self._wheel_faults
        wheels.commanded(now_ns, command)
        if self.directions is None:
            return
        miswired = self.directions.step(
            now_ns, readings.wheels, readings.poses, command, wheels.has_followed, wheels.is_suspect
        )
        if miswired is not None:
            self._miswired = (miswired,)
            self.driver.release(miswired)

    def _begin_fence(self, now_ns: int, by_hand: bool) -> bool:
        """Take in what is reported of obstacles; returns whether a person drives in spite of the fence."""
        if self.driver.limits is not None:
            stops = self.driver.limits.stop_deceleration_rad_s2.value
            self.area.guard.set_deceleration(min(stops, self.config.robot.max_wheel_acceleration_rad_s2))
        if self.obstacle_source is not None:
            for report in self.obstacle_source.receive(now_ns):
                try:
                    self.area.report(now_ns, report)
                except ObstacleRefused:
                    self.obstacle_source.refused.add(now_ns, f"obstacle {report.name}", TOO_MANY)
            self.area.notify(self.obstacle_source.refused.new_messages())
        return self.area.begin(now_ns, by_hand)

    def renew_link(self) -> None:
        """Have the driver begin anew with its robot in the next tick, as after a loss of the link."""
        self._link_renewed = True

    def follow_link(self, now_ns: int) -> None:
        """Notify the driver when the link comes and goes; a link renewed between two ticks is both."""
        up = self.transport.state is LinkState.UP
        renewed = self.transport.generation != self._generation or self._link_renewed
        self._link_renewed = False
        if self._link_up and (not up or renewed):
            self.driver.link_down(now_ns)
            self._link_up = False
        if up and not self._link_up:
            self._generation = self.transport.generation
            self.driver.link_up(now_ns)
            self._link_up = True

    def _store(self, now_ns: int, readings: Readings) -> None:
        if readings.wheels:
            self.newest_wheels = readings.wheels[-1]
        if readings.status:
            self.robot_status = readings.status[-1]
        elif self.robot_status is not None and now_ns - self.robot_status.t_ns > STATUS_HOLDS_NS:
            # Whoever asks whether the robot is in e-stop must not hear of one that has fallen silent since.
            self.robot_status = None
        # A controller can be exchanged or written anew while the link, to an adapter that stays, is up.
        identity, limits = self.driver.identity, self.driver.limits
        controller = None if identity is None or limits is None else (identity, limits)
        if controller != self._controller:
            self._controller, self._controller_changed = controller, controller is not None
            self._preflight_errors = () if controller is None else self._preflight(self.driver)

    def _controller_change(self, now_ns: int) -> tuple[records.Record, ...]:
        changed, self._controller_changed = self._controller_changed, False
        return (records_of_tick.controller(now_ns, *self._controller),) if changed and self._controller else ()

    def _inputs(self, now_ns: int, requests: Sequence[UserRequest], by_hand: bool) -> Inputs:
        estimate = None if self.last is None else self.last.pipeline.estimate
        wheels = self.newest_wheels
        speed = 0.0 if wheels is None else max(abs(wheels.left_speed_rad_s), abs(wheels.right_speed_rad_s))
        finished, off_end_m = self.progress.finished, 0.0
        if finished and estimate is not None:
            off_end_m = math.dist((estimate.x_m, estimate.y_m), self.course.outline_m()[-1])
        return Inputs(
            link_state=self.transport.state,
            link_generation=self.transport.generation,
            link_error=self.transport.last_error,
            driver_state=self.driver.state,
            driver_detail=self.driver.detail,
            telemetry_age_s=None if wheels is None else (now_ns - wheels.t_ns) * 1e-9,
            wheel_speed_rad_s=speed,
            pose_ok=estimate is not None and estimate.pose_ok,
            preflight_errors=self._miswired or self._preflight_errors,
            task_finished=finished,
            off_end_m=off_end_m,
            requests=tuple(requests),
            recording_fault=self.recording_fault,
            heading_missing=estimate is not None and estimate.initialised and not estimate.heading_known,
            measures_no_heading=self.pipeline.headings.measures_none,
            pose_refusal=self.pipeline.fusion.sources.refusal(now_ns),
            by_hand=by_hand,
            poses_contradict=self.pipeline.fusion.sources.contradiction,
            pose_jump=self._jump,
            fence_fault=self.area.task_fault,
        )

    def _to_learn_from(self, readings: Readings) -> Readings:
        """Keep only poses of the first source, while it is believed: a switch of source must not look like motion."""
        sources = self.pipeline.fusion.sources
        if len(sources.all) == 1:
            return readings
        first = tuple(pose for pose in readings.poses if pose.source == 0 and sources.is_good(0))
        return msgspec.structs.replace(readings, poses=first)

    def _command(self, output: Output, result: Tick) -> WheelCommand | None:
        """Return the command to send; while the robot is arming the driver sends the zeros that this takes."""
        may_command = output.motion_allowed or output.zero_only
        if not may_command or result.source is Source.SILENT or self.driver.state is not DriverState.ARMED:
            return None
        governed = result.command
        return WheelCommand(governed.left_rad_s, governed.right_rad_s, self.config.control.command_valid_for_s)

    def _send(self, now_ns: int, output: Output, command: WheelCommand | None, silent: bool) -> list[records.Record]:
        """Hand this tick's frames to the link; the e-stop goes before everything else, and even where all is silent."""
        if output.driver_request is not None:
            self.driver.request(output.driver_request)
        outgoing = () if silent else self.driver.transmit(now_ns, command)
        if output.send_estop:
            outgoing = (*self.driver.estop(now_ns), *outgoing)
        return [records_of_tick.frame_out(now_ns, frame, self.transport.send(frame, now_ns)) for frame in outgoing]

    def _pose_events(self) -> list[str]:
        """Return the news of pose sources, their headings and the estimate, each as an event."""
        source, pipeline = self.pose_source, self.pipeline
        messages = [
            *(source.new_messages() if isinstance(source, MessageSource) else ()),
            *pipeline.headings.new_messages(),
        ]
        messages += [*pipeline.fusion.sources.new_messages(), *self._jumps.new_messages()]
        return [f"poses: {text}" for text in messages]

    def _stays(self, now_ns: int, output: Output, result: Tick) -> tuple[str, ...]:
        """Say when the task that runs does not get on."""
        place, command = (result.estimate.x_m, result.estimate.y_m), result.command
        follows = output.running and result.source in FOLLOWS
        return self._headway.step(
            now_ns, follows, place, (command.left_rad_s, command.right_rad_s), self.newest_wheels,
            result.planner_failure, self.progress.laps >= 1.0,
        )  # fmt: skip

    def _state_change(self, now_ns: int, output: Output) -> list[records.Record]:
        """Return the record of a change of state or of what is said of it, in the tick in which it happens."""
        before, self.state = self.state, output.state
        last, self._last_reported = self._last_reported, (output.detail, output.running, output.estop)
        if output.state is before and self._last_reported == last:
            return []
        if output.state is not before:
            self.entered[output.state.value] = self.entered.get(output.state.value, 0) + 1
        return [records.DaemonState(now_ns, output.state.name, before.name, *self._last_reported)]

    def _task_change(self, now_ns: int) -> list[records.Record]:
        """Return the record of another task, in the first tick that it holds for."""
        changed, self._task_changed = self._task_changed, False
        return [record_of(now_ns, self.task)] if changed else []

    def _follow_progress(self, output: Output, result: Tick, motion: Motion) -> None:
        """Follow the task's progress while it is the task that drives, and no pilot in its place."""
        if output.running and not self._jump and isinstance(motion, FollowTask):
            pose = result.estimate
            # A path that crosses itself is begun on the branch that the robot drives along.
            self.progress.add(result.t_ns, pose.x_m, pose.y_m, pose.yaw_rad + self.config.turned_rad)
        else:
            self.progress.pause()


def _motion(output: Output, steering: Motion) -> Motion:
    if output.motion_allowed:
        return steering
    return Standstill() if output.zero_only else Off()


@dataclass(frozen=True, slots=True)
class PilotTick:
    """Wishes of a pilot for one tick: requests as an operator makes them, the motion, and events to record.

    `by_hand`: a person holds a deadman and sees where the robot goes, which needs no pose.
    """

    requests: tuple[UserRequest, ...] = ()
    motion: Motion = FollowTask()  # noqa: RUF009 - it is frozen and empty
    events: tuple[str, ...] = ()
    by_hand: bool = False


class Pilot(Protocol):
    """Called once before and once after each tick; it never waits and never raises on what a person does."""

    @property
    def needs_pose(self) -> bool:
        """Whether motion needs a pose where robot.toml requires one."""

    @property
    def done(self) -> bool:
        """Whether nothing more is wanted: the daemon then stops the robot and ends."""

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Return what is wanted of the tick at `now_ns`; `last` is the tick before."""

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Take in the result: the replies to its own requests."""

    def steer(self, now_ns: int, page: int, steering: Mapping[str, Any]) -> str | None:
        """Take in how a page, known by a number, wants to drive; returns why that does not count, in words."""

    def status(self) -> dict[str, Any]:
        """Return the pilot's own entries of the daemon's status."""


@runtime_checkable
class FindsWiring(Protocol):
    """A pilot that finds out how the wheels are wired and what poses mean, and is not stopped for what it looks for."""

    @property
    def finds_wiring(self) -> bool:
        """Always True, which marks a pilot that finds the wiring."""


class TaskPilot:
    """Leaves everything to the task, which has no end of its own, and to the requests on the control socket."""

    needs_pose, done = True, False

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Return a tick that follows the task and requests nothing."""
        return PilotTick()

    def learn(self, now_ns: int, tick: CoreTick, replies: Sequence[Reply]) -> None:
        """Do nothing: the task needs no result of a tick."""

    def steer(self, now_ns: int, page: int, steering: Mapping[str, Any]) -> str | None:
        """Refuse a page's steering, because a task is followed."""
        return "this daemon follows its task; stop it and start `disco-hw drive ROBOT.toml --page`"

    def status(self) -> dict[str, Any]:
        """Return an empty dict: the status gets no more entries."""
        return {}
