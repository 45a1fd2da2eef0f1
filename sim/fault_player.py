"""Carries a fault schedule out on a virtual robot and its link: the hands of `sim.faults`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from sim.fault_schedule import Fault, FaultSchedule, Room
from sim.faults import FaultTimeline, FrameFaults
from sim.injection import Injection
from sim.robot_faults import RobotFaults
from sim.robot_link import RobotLink
from sim.virtual_robot import VirtualRobot

BUS_ONLY = ("bus_off", "babble")


class ProcessFaults(Protocol):
    """Whoever can do something to processes; a harness has all of them in its hands, the simulator few."""

    def begin(self, fault: Fault) -> None:
        """Let the fault begin."""

    def end(self, fault: Fault) -> None:
        """Take it back."""


class FaultPlayer:
    """Plays `schedule` from `start_ns` on; `tell` gets a line at each beginning and end.

    `frames.struck` counts the frames touched by each fault. Faults of processes go to `processes`; without it they are
    told and nothing happens. Raises LinkFaultError at once if the link cannot have its frames changed.
    """

    def __init__(
        self,
        schedule: FaultSchedule,
        robot: VirtualRobot,
        link: RobotLink,
        start_ns: int,
        tell: Callable[[str], object] = lambda _line: None,
        processes: ProcessFaults | None = None,
    ) -> None:
        self.timeline = FaultTimeline(schedule)
        self.frames = FrameFaults(schedule.seed)
        self._robot = robot
        self._link = link
        self._injection = Injection(robot, link)
        self._start_ns = start_ns
        self._tell = tell
        self._processes = processes
        self._sensors = RobotFaults()
        self._unplug_until_ns = 0
        robot.faults = self._sensors
        link.tamper(self.frames)

    def step(self, now_ns: int) -> tuple[tuple[Fault, ...], tuple[Fault, ...]]:
        """Do what is due at `now_ns`; return the faults that have begun and ended."""
        begun, ended = self.timeline.step(now_ns - self._start_ns)
        if begun or ended:
            active = self.timeline.active
            self.frames.set_active(active)
            self._sensors.set_active(active, begun)
            for fault in begun:
                self._tell(f"fault {fault.number} begins: {fault}")
                self._begin(fault, now_ns)
            for fault in ended:
                self._end(fault, now_ns)
                if fault.kind.lasts:
                    self._tell(f"fault {fault.number} ends: {fault.kind.name}")
        if self.frames.broken:
            self.frames.broken = False
            self._link.unplug(max(self._unplug_until_ns, now_ns))
        self._injection.step(now_ns)
        return begun, ended

    def _begin(self, fault: Fault, now_ns: int) -> None:
        if fault.kind.room is Room.PROCESS and self._processes is not None:
            self._processes.begin(fault)
        match fault.kind.name:
            case "unplug":
                self._unplug_until_ns = max(self._unplug_until_ns, now_ns + fault.end_ns - fault.begin_ns)
                self._link.unplug(self._unplug_until_ns)
            case "unplug_mid_frame":
                self._unplug_until_ns = max(self._unplug_until_ns, now_ns + fault.end_ns - fault.begin_ns)
                self.frames.break_next = True
            case "bus_off":
                self._do(f"bus_off {fault['who']}", now_ns)
            case "babble":
                self._do(f"babble {fault['id']} {fault['rate_hz']}", now_ns)
            case "brown_out":
                self._do("reboot brown_out", now_ns)
            case "reboot":
                self._do(f"reboot {fault['cause']}", now_ns)
            case "clock_jump":
                self._robot.jump_clock(round(fault["step_s"] * 1e6))
            case "estop_button":
                self._do("estop_button on", now_ns)

    def _end(self, fault: Fault, now_ns: int) -> None:
        if fault.kind.room is Room.PROCESS and self._processes is not None:
            self._processes.end(fault)
        # Of two faults of a kind at once, the end of one is not that of the other.
        others = [other for other in self.timeline.active if other.kind is fault.kind]
        match fault.kind.name:
            case "babble" if others:
                self._do(f"babble {others[-1]['id']} {others[-1]['rate_hz']}", now_ns)
            case "babble":
                self._do("babble 0 0", now_ns)
            case "estop_button" if not others:
                self._do("estop_button off", now_ns)
            case "unplug_mid_frame":
                self.frames.break_next = False

    def _do(self, command: str, now_ns: int) -> None:
        answer = self._injection.execute(command, now_ns)
        if answer != "ok":
            self._tell(answer)
