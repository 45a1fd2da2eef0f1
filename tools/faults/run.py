"""The whole stack in simulated time: robot, firmware core, CAN bus, driver and the daemon's core, under faults.

The same objects as in real time, without processes, threads or a clock; what the monitors find is in the outcome.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import PlannerState
from disco_hw.control.plan import LawController
from disco_hw.daemon.control_socket import counters
from disco_hw.daemon.loop import LoopStats
from disco_hw.log import records
from disco_hw.log.recorder import MemoryRecorder, RecorderStats
from disco_hw.runtime import State
from disco_hw.runtime.assembly import assemble_core, create_pipeline
from disco_hw.runtime.core import CoreTick, DaemonCore
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.robot_setup import Setup, load_setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.circle import circle_task
from drivers.motor.reference import ReferenceDriver
from drivers.types import RobotLinkHealth, RobotStatus
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import BodyPose
from sim.fault_player import FaultPlayer
from sim.fault_schedule import FaultSchedule, ScheduledFault
from sim.plant import Plant, TrueState
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import VirtualRobot
from tools.faults.in_process import SimulatedCan
from tools.faults.wheel_monitor import WheelMonitor

GEOMETRY = (0.061, 0.415, 0.238)
"""Wheel radius, axial distance and x_icr of the robot, m."""
LOOK_AHEAD_RAD = 0.35
SETTLED_S = 2.5
"""A fault's consequences are looked for until so long after its end."""
WRAP_SOON_TICKS = (1 << 24) - 20_000
WRONG_POSITION_M = 0.5
WRONG_HEADING_RAD = 0.5
WRONG_FOR_S = 1.5
"""Longest that the robot may move with an estimate that is wrong by more than the two above.

While its one pose sensor lies, the robot cannot know: poses that agree with each other and not with the wheels are what
a robot sees that was carried off. It waits, counts them, and then believes them.
"""
LIES = ("pose_jump", "pose_swapped", "pose_frozen")
_DONE_TO_PROCESSES = {("cpu_hog", None), ("sigstop", "daemon"), ("sigkill", "daemon"), ("sigkill", "robot")}
# Counters that rise while all is well.
_USUAL = frozenset(
    {
        *(f"transport.{n}" for n in ("frames_sent", "frames_received", "bytes_received")),
        *(f"driver.{n}" for n in ("frames_accepted", "commands_sent", "sessions")),
        *(f"fusion.{n}" for n in ("wheels_accepted", "poses_accepted", "poses_initialised")),
        *("loop.ticks", "entered.armed", "entered.ready", "entered.handshake"),
        *("robot.t_ns", "robot.tx_error_count", "robot.rx_error_count"),
    }
)
# And what rises once in a while: one pose in a thousand lies outside the gate by chance.
_BY_CHANCE = {"fusion.poses_gated": 1}


def circling_planner(setup: Setup) -> LawController:
    """Planner that goes round the task's circle in microseconds, where DISCO is not what is tried."""
    task = circle_task(setup.config.task, "the campaign")
    radius_m, axial_m, _ = GEOMETRY

    def law(state: PlannerState, _task: Any, _model: Any) -> tuple[float, float]:
        """Turn towards a point ahead on the circle."""
        bearing = math.atan2(state.y_m - task.center_y_m, state.x_m - task.center_x_m) + LOOK_AHEAD_RAD
        x_m = task.center_x_m + task.radius_m * math.cos(bearing)
        y_m = task.center_y_m + task.radius_m * math.sin(bearing)
        error = math.remainder(math.atan2(y_m - state.y_m, x_m - state.x_m) - state.yaw_rad, 2.0 * math.pi)
        turn = max(-1.5, min(1.5, 2.0 * error))
        speed = task.speed_m_s * max(0.2, math.cos(error))
        return (speed - 0.5 * axial_m * turn) / radius_m, (speed + 0.5 * axial_m * turn) / radius_m

    return LawController(law, setup.model, task)


class Attendant:
    """A person beside the robot: resets, arms and starts it again, never more than one request in 0.4 s."""

    def __init__(self) -> None:
        self._last_ns = 0

    def requests(self, now_ns: int, last: CoreTick | None) -> tuple[UserRequest, ...]:
        """Return the requests of the operator in this tick."""
        if last is None or now_ns - self._last_ns < 400_000_000:
            return ()
        match last.output.state:
            case State.FAULT:
                request = UserRequest.RESET
            case State.READY:
                request = UserRequest.ARM
            case State.ARMED if not last.output.running:
                request = UserRequest.START
            case _:
                return ()
        self._last_ns = now_ns
        return (request,)


class LogReader:
    """Keeps, of what is recorded, what shows trouble."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.events: list[tuple[int, str]] = []
        self.recorder = MemoryRecorder()
        self._robot: dict[str, int] = {}

    def read(self) -> None:
        """Keep what shows trouble of the ticks recorded since the last call; the recorder forgets them."""
        for now_ns, recorded in self.recorder.ticks:
            self._read_tick(now_ns, recorded)
        self.recorder.ticks.clear()

    def _read_tick(self, now_ns: int, recorded: Sequence[records.Record]) -> None:
        for record in recorded:
            if isinstance(record, records.Event):
                self.events.append((now_ns, record.text))
            elif isinstance(record, records.DaemonState):
                self.events.append((now_ns, f"{record.previous} -> {record.state}: {record.reason}"))
            elif isinstance(record, records.Counters):
                for group in ("transport", "driver", "fusion", "plausibility", "loop", "entered"):
                    for name, value in getattr(record, group).items():
                        self.counts[f"{group}.{name}"] = value
            elif isinstance(record, RobotLinkHealth):
                self._count_changes({name: getattr(record, name) for name in record.__struct_fields__})
            elif isinstance(record, RobotStatus):
                self._count_changes({"rejected_count": record.rejected_count})

    def _count_changes(self, values: dict[str, int]) -> None:
        for name, value in values.items():
            before = self._robot.get(name, value)
            self._robot[name] = value
            key = f"robot.{name}"
            # They wrap at 256 and begin anew when the robot restarts: any change is one.
            self.counts[key] = self.counts.get(key, 0) + (value != before)


@dataclass
class FaultOutcome:
    """The effect of one fault: `stopped_s` from its beginning to zero setpoints if the robot left ARMED."""

    fault: ScheduledFault
    armed_before: bool
    struck: bool = True
    stopped_s: float | None = None
    counters: tuple[str, ...] = ()
    events: tuple[str, ...] = ()


@dataclass
class FaultRunResult:
    """Result of one run with faults."""

    moving_s: float = 0.0
    commands_seen: int = 0
    commands_accepted: int = 0
    faults: list[FaultOutcome] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)


@dataclass
class _Open:
    outcome: FaultOutcome
    counts: dict[str, int]
    events: int
    left_armed: bool = False


class FaultRun:
    """One robot and one daemon. `run` moves time on; `outcome` is what the monitors saw so far.

    `cycle_us`: period of the robot's controller (1 ms on a board; 5 ms is what campaigns use, which makes its times
    coarser by as much). `planner`: DISCO, or `circling_planner` if None. Seeds decide plant, sessions and faults.
    """

    def __init__(
        self,
        schedule: FaultSchedule,
        *,
        seed: int = 0,
        cycle_us: int = 1000,
        planner: Planner | None = None,
    ) -> None:
        setup = load_setup(SHIPPED_ROBOT)
        self.config = setup.config
        self._setup = setup
        self._planner = planner
        self._chance = random.Random(seed)
        self._cycle_us = cycle_us
        self._period_us = round(1e6 / self.config.control.rate_hz)
        self.can = SimulatedCan()
        task = circle_task(self.config.task, "the campaign")
        start = BodyPose(task.center_x_m + task.radius_m, task.center_y_m, 0.5 * math.pi)
        radius_m, axial_m, x_icr_m = GEOMETRY
        parameters = PlantParameters(
            wheel_radius_m=radius_m,
            axial_distance_m=axial_m,
            x_icr_m=x_icr_m,
            encoder_start_left_ticks=WRAP_SOON_TICKS,
            encoder_start_right_ticks=WRAP_SOON_TICKS,
        )
        self.robot = VirtualRobot(
            Plant(parameters, None, seed, start),
            FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0, cycle_s=cycle_us * 1e-6),
            challenge_seed=seed,
        )
        self.log = LogReader()
        self.monitor = WheelMonitor()
        self.core: DaemonCore | None = None
        self._attendant = Attendant()
        self._loop = LoopStats()
        self._player = FaultPlayer(schedule, self.robot, self.can, 0, processes=self)
        self.now_us = 0
        self._next_tick_us = 0
        self._next_second_ns = 0
        self._frozen = False
        self._hogged = False
        self._open: list[_Open] = []
        self._closing: list[tuple[int, _Open]] = []
        self._wrong_since_us: int | None = None
        self._thawed_us = 0
        self.outcome = FaultRunResult(violations=self.monitor.violations)
        self._start_daemon()

    def run(self, duration_s: float) -> FaultRunResult:
        """Advance robot and daemon by a duration; return the result so far."""
        end_us = self.now_us + round(duration_s * 1e6)
        can, robot, player, monitor, cycle_us = self.can, self.robot, self._player, self.monitor, self._cycle_us
        wheels = (0.0, 0.0)
        while self.now_us < end_us:
            self.now_us += cycle_us
            now_us = self.now_us
            now_ns = now_us * 1000
            received = can.advance(now_ns)
            for frame in received:
                robot.receive(frame.t_ns // 1000, frame.frame)
            firmware = robot.firmware
            can.send(robot.step(now_us, can.error_counters))
            monitor.see(now_us, [r.frame for r in received], robot.outputs, wheels)
            armed = robot.outputs.state == "ARMED"
            begun, ended = player.step(now_ns)
            if begun or ended:
                self._note_faults(begun, ended, armed)
            if robot.firmware is not firmware:
                monitor.restarted()
            if now_us >= self._next_tick_us:
                truth = robot.plant.truth
                wheels = (truth.left_speed_rad_s, truth.right_speed_rad_s)
                self._loop.ticks += 1
                self._tick_if_able(now_ns)
                self._check_estimate(truth)
                self._check_telemetry(now_us)
                self._close_faults(now_us)
        self.outcome.commands_seen = monitor.commands_seen
        self.outcome.commands_accepted = monitor.commands_accepted
        return self.outcome

    def begin(self, fault: ScheduledFault) -> None:
        """Do to the daemon what befalls its process."""
        name, process = fault.kind.name, fault.values.get("process")
        if name == "cpu_hog":
            self._hogged = True
        elif process == "daemon" and name == "sigstop":
            self._frozen = True
        elif process == "daemon" and name == "sigkill":
            self.core = None
            self.can.host.close()
        elif process == "robot" and name == "sigkill":
            self.robot.reboot()

    def end(self, fault: ScheduledFault) -> None:
        """Let it go on, or start it again."""
        name, process = fault.kind.name, fault.values.get("process")
        if name == "cpu_hog":
            self._hogged = False
        elif process == "daemon" and name == "sigstop":
            self._frozen = False
            self._thawed_us = self.now_us + 2 * self._period_us
        elif process == "daemon" and name == "sigkill":
            self._start_daemon()

    def _start_daemon(self) -> None:
        setup, config = self._setup, self.config
        planner: Planner = self._planner or circling_planner(setup)
        driver = ReferenceDriver(Codec(), draw_session=lambda: self._chance.getrandbits(16))
        self.core = assemble_core(
            config, self.can.host, driver, create_pipeline(config, setup.model, planner), self.log.recorder
        )
        self.can.host.open()
        if self.now_us:
            self.log.events.append((self.now_us * 1000, "the daemon was started"))

    def _tick_if_able(self, now_ns: int) -> None:
        self._next_tick_us += self._period_us
        if self._hogged and self._chance.random() < 0.3:
            # Late by up to three periods: the loop skips what it has missed.
            self._next_tick_us += self._cycle_us * self._chance.randrange(1, 3 * self._period_us // self._cycle_us)
            self._loop.skipped_periods += 1
        core = self.core
        if core is None:
            return
        if self._frozen:
            self._loop.skipped_periods += 1
            return
        extra: tuple[records.Record, ...] = ()
        if now_ns >= self._next_second_ns:
            self._next_second_ns = now_ns + 1_000_000_000
            extra = (counters(core, self._loop, RecorderStats(), now_ns),)
        core.tick(now_ns, self._attendant.requests(now_ns, core.last), extra)
        self.log.read()

    def _note_faults(self, begun: Sequence[ScheduledFault], ended: Sequence[ScheduledFault], armed: bool) -> None:
        for fault in begun:
            self._open.append(_Open(FaultOutcome(fault, armed), dict(self.log.counts), len(self.log.events)))
        for fault in ended:
            opened = next(o for o in self._open if o.outcome.fault is fault)
            self._closing.append((self.now_us + round(SETTLED_S * 1e6), opened))

    def _check_estimate(self, truth: TrueState) -> None:
        """The robot may not go on for long with a wrong idea of where it is."""
        lied_to = any(o.outcome.fault.kind.name in LIES for o in self._open)
        moving = max(abs(truth.left_speed_rad_s), abs(truth.right_speed_rad_s)) > 0.05
        self.outcome.moving_s += moving * self._period_us * 1e-6
        last = None if self.core is None else self.core.last
        is_wrong = False
        if moving and not lied_to and last is not None and last.output.motion_allowed and not self._frozen:
            found = last.pipeline.estimate
            is_wrong = (
                math.hypot(found.x_m - truth.x_m, found.y_m - truth.y_m) > WRONG_POSITION_M
                or abs(math.remainder(found.yaw_rad - truth.yaw_rad, 2.0 * math.pi)) > WRONG_HEADING_RAD
            )
        if not is_wrong:
            self._wrong_since_us = None
        elif self._wrong_since_us is None:
            self._wrong_since_us = self.now_us
        elif self.now_us - self._wrong_since_us > WRONG_FOR_S * 1e6:
            struck = ", ".join(str(o.outcome.fault) for o in self._open) or "no fault"
            self.monitor.violations.append(f"{self.now_us * 1e-6:.2f} s: moving on a wrong estimate under {struck}")
            self._wrong_since_us = self.now_us + 10_000_000

    def _check_telemetry(self, now_us: int) -> None:
        """A daemon that no longer hears of the wheels takes the motion away."""
        core = self.core
        if core is None or core.newest_wheels is None or core.last is None or self._frozen or self._hogged:
            return
        if core.last.output.state is State.ARMED:
            age_s = now_us * 1e-6 - core.newest_wheels.t_ns * 1e-9
            blind = age_s > self.config.control.telemetry_disarm_s + 2.5e-6 * self._period_us
            if blind and now_us > self._thawed_us:
                self.monitor.violations.append(f"{now_us * 1e-6:.2f} s: armed on wheel samples {age_s:.2f} s old")
                self._thawed_us = now_us + 10_000_000

    def _close_faults(self, now_us: int) -> None:
        if not self._open:
            return
        outputs = self.robot.outputs
        is_stationary = outputs.left_setpoint_rad_s == outputs.right_setpoint_rad_s == 0.0
        for opened in self._open:
            opened.left_armed = opened.left_armed or outputs.state != "ARMED"
            if opened.left_armed and is_stationary and opened.outcome.stopped_s is None:
                opened.outcome.stopped_s = (now_us - opened.outcome.fault.begin_ns // 1000) * 1e-6
        while self._closing and self._closing[0][0] <= now_us:
            opened = self._closing.pop(0)[1]
            self._open.remove(opened)
            self._finish(opened)

    def _finish(self, opened: _Open) -> None:
        outcome, log = opened.outcome, self.log
        fault = outcome.fault
        if fault.kind.site.value == "frames" or fault.kind.name == "one_way":
            outcome.struck = self._player.frames.struck.get(fault.number, 0) > 0
        elif fault.kind.site.value == "process":
            outcome.struck = (fault.kind.name, fault.values.get("process")) in _DONE_TO_PROCESSES
        rises = {n: v - opened.counts.get(n, 0) for n, v in log.counts.items() if n not in _USUAL}
        changed = {n for n, rise in rises.items() if abs(rise) > _BY_CHANCE.get(n, 0)}
        outcome.counters = tuple(sorted(changed))
        outcome.events = tuple(text for _, text in log.events[opened.events :])
        self.outcome.faults.append(outcome)
