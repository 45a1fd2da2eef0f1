"""Applies faults at run time, from a schedule or from text commands, to a virtual robot, its link and its processor."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Protocol

from drivers.types import Frame
from firmware_protocol.firmware_core import ResetCause
from sim import FaultyLink, LinkFaultError
from sim.fault_schedule import FaultSchedule, ScheduledFault, Site
from sim.injected_faults import FrameFaults
from sim.virtual_robot import Robot, truth_row

COMMANDS = """\
bus_off [host|robot]          controllers of all hosts (default), or the robot's, leave the bus
unplug SECONDS                break the line for so long
estop_button on|off           press or release the button on the robot
kidnap DX_M DY_M DYAW_RAD     carry the robot off
babble ID RATE_HZ             another node sends frames of zeros under this identifier; RATE_HZ 0 ends it
reboot [watchdog|brown_out]   restart the robot's controller
state                         answer with the true state, as a line of the truth table
"""
# Chosen: above what any bus carries; a larger number is a mistake in typing, as is a longer pull of the plug.
MAX_BABBLE_HZ = 100_000.0
MAX_UNPLUG_S = 3600.0
_BABBLE_DATA = bytes(8)
BUS_ONLY = ("bus_off", "babble")
# A child of a real-time process would be one itself.
_BUSY = "import os; os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"


class FaultTimeline:
    """Iterator over a schedule; `active` holds the faults in force."""

    def __init__(self, schedule: FaultSchedule) -> None:
        self.active: tuple[ScheduledFault, ...] = ()
        self._coming = list(reversed(schedule.faults))
        self._next_ns = self._find_next_ns()

    def step(self, now_ns: int) -> tuple[tuple[ScheduledFault, ...], tuple[ScheduledFault, ...]]:
        """Move on to `now_ns` of the schedule's time; return the faults that have begun and ended since the last step.

        A fault that lasts no time begins and ends in one step.
        """
        if self._next_ns is None or now_ns < self._next_ns:
            return (), ()
        begun: list[ScheduledFault] = []
        while self._coming and self._coming[-1].begin_ns <= now_ns:
            begun.append(self._coming.pop())
        running = (*self.active, *begun)
        ended = tuple(fault for fault in running if fault.end_ns <= now_ns)
        self.active = tuple(fault for fault in running if fault.end_ns > now_ns)
        self._next_ns = self._find_next_ns()
        return tuple(begun), ended

    def _find_next_ns(self) -> int | None:
        times = [fault.end_ns for fault in self.active]
        if self._coming:
            times.append(self._coming[-1].begin_ns)
        return min(times) if times else None


class FaultPlayer:
    """Plays `schedule` from `start_ns` on; `report` gets a line at each beginning and end.

    `frames.struck` counts the frames touched by each fault. Faults of processes go to `processes`; without it they are
    reported and nothing happens. Raises LinkFaultError at once if the link cannot have its frames changed.
    """

    def __init__(
        self,
        schedule: FaultSchedule,
        robot: Robot,
        link: FaultyLink,
        start_ns: int,
        report: Callable[[str], object] = lambda _line: None,
        processes: ProcessFaults | None = None,
    ) -> None:
        self.timeline = FaultTimeline(schedule)
        self.frames = FrameFaults(schedule.seed)
        self._robot = robot
        self._link = link
        self._injection = Injection(robot, link)
        self._start_ns = start_ns
        self._report = report
        self._processes = processes
        self._unplug_until_ns = 0
        link.set_bus_fault(self.frames)

    def step(self, now_ns: int) -> tuple[tuple[ScheduledFault, ...], tuple[ScheduledFault, ...]]:
        """Do what is due at `now_ns`; return the faults that have begun and ended."""
        begun, ended = self.timeline.step(now_ns - self._start_ns)
        if begun or ended:
            active = self.timeline.active
            self.frames.set_active(active)
            self._robot.faults.set_active(active, begun)
            for fault in begun:
                self._report(f"fault {fault.number} begins: {fault}")
                self._begin(fault, now_ns)
            for fault in ended:
                self._end(fault, now_ns)
                if fault.kind.lasts:
                    self._report(f"fault {fault.number} ends: {fault.kind.name}")
        if self.frames.broken:
            self.frames.broken = False
            self._link.unplug(max(self._unplug_until_ns, now_ns))
        self._injection.step(now_ns)
        return begun, ended

    def _begin(self, fault: ScheduledFault, now_ns: int) -> None:
        if fault.kind.site is Site.PROCESS and self._processes is not None:
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

    def _end(self, fault: ScheduledFault, now_ns: int) -> None:
        if fault.kind.site is Site.PROCESS and self._processes is not None:
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
        reply = self._injection.execute(command, now_ns)
        if reply != "ok":
            self._report(reply)


class Injection:
    """Executes `COMMANDS` on a robot and its link, and keeps up what goes on over time."""

    def __init__(self, robot: Robot, link: FaultyLink) -> None:
        self._robot = robot
        self._link = link
        self._babble: Frame | None = None
        self._babble_period_ns = 0.0
        self._babble_since_ns = 0
        self._babble_count = 0
        self._handlers: dict[str, Callable[[list[str], int], str]] = {
            "bus_off": self._bus_off,
            "unplug": self._unplug,
            "estop_button": self._estop_button,
            "kidnap": self._kidnap,
            "babble": self._start_babble,
            "reboot": self._reboot,
            "state": self._state,
        }

    def execute(self, text: str, now_ns: int) -> str:
        """Execute one command of the socket; return "ok", the requested value, or "error: " with the reason."""
        name, *arguments = text.split() or [""]
        try:
            handler = self._handlers.get(name)
            if handler is None:
                raise CommandError(f"{name!r} is not a command; write one of {', '.join(self._handlers)}")
            return handler(arguments, now_ns)
        except (CommandError, LinkFaultError) as error:
            return f"error: {error}"

    def step(self, now_ns: int) -> None:
        """Let the babbling node send what is due."""
        if self._babble is None:
            return
        due = int((now_ns - self._babble_since_ns) / self._babble_period_ns)
        for _ in range(due - self._babble_count):
            self._link.babble(self._babble)
        self._babble_count = max(due, self._babble_count)

    def _bus_off(self, arguments: list[str], _now_ns: int) -> str:
        _expect("bus_off", arguments, 0, 1)
        self._link.force_bus_off(arguments[0] if arguments else "host")
        return "ok"

    def _unplug(self, arguments: list[str], now_ns: int) -> str:
        _expect("unplug", arguments, 1, 1)
        self._link.unplug(now_ns + round(_number("unplug", arguments[0], 0.0, MAX_UNPLUG_S) * 1e9))
        return "ok"

    def _estop_button(self, arguments: list[str], _now_ns: int) -> str:
        _expect("estop_button", arguments, 1, 1)
        if arguments[0] not in ("on", "off"):
            raise CommandError(f"estop_button {arguments[0]}: write on or off")
        self._robot.estop_button = arguments[0] == "on"
        return "ok"

    def _kidnap(self, arguments: list[str], _now_ns: int) -> str:
        _expect("kidnap", arguments, 3, 3)
        dx_m, dy_m, dyaw_rad = (_number("kidnap", argument, -1000.0, 1000.0) for argument in arguments)
        self._robot.plant.kidnap(dx_m, dy_m, dyaw_rad)
        return "ok"

    def _start_babble(self, arguments: list[str], now_ns: int) -> str:
        _expect("babble", arguments, 2, 2)
        try:
            can_id = int(arguments[0], 0)
        except ValueError:
            raise CommandError(f"babble {arguments[0]}: not an identifier; write it as 0x100 or 256") from None
        if not 0 <= can_id <= 0x7FF:
            raise CommandError(f"babble {arguments[0]}: an identifier has 11 bits")
        rate_hz = _number("babble", arguments[1], 0.0, MAX_BABBLE_HZ)
        self._babble = None
        if rate_hz > 0.0:
            frame = Frame(can_id, _BABBLE_DATA)
            self._link.babble(frame)
            self._babble, self._babble_period_ns = frame, 1e9 / rate_hz
            self._babble_since_ns, self._babble_count = now_ns, 0
        return "ok"

    def _reboot(self, arguments: list[str], _now_ns: int) -> str:
        _expect("reboot", arguments, 0, 1)
        causes = {"power_on": ResetCause.POWER_ON, "watchdog": ResetCause.WATCHDOG, "brown_out": ResetCause.BROWN_OUT}
        cause = causes.get(arguments[0] if arguments else "power_on")
        if cause is None:
            raise CommandError(f"reboot {arguments[0]}: write one of {', '.join(causes)}")
        self._robot.reboot(cause)
        return "ok"

    def _state(self, arguments: list[str], now_ns: int) -> str:
        _expect("state", arguments, 0, 0)
        return truth_row(self._robot, now_ns)


class CommandError(Exception):
    """A command that cannot be obeyed; the message is one line."""


class ProcessFaults(Protocol):
    """Protocol of faults of processes; a harness can fault all of them, the simulator few."""

    def begin(self, fault: ScheduledFault) -> None:
        """Let the fault begin."""

    def end(self, fault: ScheduledFault) -> None:
        """Undo the effect of a fault."""


class CpuHogs:
    """Starts and ends busy processes at normal priority; satisfies `sim.fault_player.ProcessFaults` for `cpu_hog`."""

    def __init__(self) -> None:
        self._busy: dict[int, list[subprocess.Popen[bytes]]] = {}

    def __enter__(self) -> CpuHogs:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number in tuple(self._busy):
            self._stop(number)

    def begin(self, fault: ScheduledFault) -> None:
        """Start one process for each core."""
        if fault.kind.name == "cpu_hog":
            command = [sys.executable, "-S", "-c", _BUSY]
            self._busy[fault.number] = [subprocess.Popen(command) for _ in range(fault["cores"])]

    def end(self, fault: ScheduledFault) -> None:
        """Stop the fault's busy processes."""
        self._stop(fault.number)

    def _stop(self, number: int) -> None:
        for process in self._busy.pop(number, []):
            process.kill()
            process.wait()


def _expect(name: str, arguments: list[str], least: int, most: int) -> None:
    if not least <= len(arguments) <= most:
        usage = next(line.split("  ")[0] for line in COMMANDS.splitlines() if line.startswith(name))
        raise CommandError(f"{name}: {len(arguments)} arguments given; usage: {usage}")


def _number(name: str, text: str, least: float, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise CommandError(f"{name} {text}: not a number") from None
    if not least <= value <= most:
        raise CommandError(f"{name} {text}: not within {least:g} to {most:g}")
    return value
