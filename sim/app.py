"""The virtual robot as a process: real time, a link that others can open, faults at run time, the truth on record."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

import can
import serial

from drivers.private_files import SocketPathError
from drivers.types import ReceivedFrame
from firmware_protocol.firmware_core import FirmwareConfig
from sim import RobotLink
from sim.board import VERSION, BoardRobot, PlantLine
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError, hidden_effects
from sim.fault_player import BUS_ONLY, CpuHogs, FaultPlayer, Injection
from sim.fault_schedule import FaultSchedule, Site
from sim.hub import Hub
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.process import CommandSocket, PoseSender, StopSignal, TextRecord
from sim.python_can_link import PythonCanLink
from sim.serial_line import SerialLine, SerialPathError
from sim.virtual_robot import STEP_US, Controller, ControllerClock, Robot, TruthRecorder, VendorRobot, VirtualRobot

STEP_NS = STEP_US * 1000
# Every 10 ms, as often as WHEEL_SPEED is sent.
TRUTH_STEPS = 10
# Chosen: compiles and loads what a step needs, before real time begins.
WARM_UP_STEPS = 200
# Chosen: longer than a board takes to boot and to say what it is.
BOARD_S = 5.0
NOT_OF_BOARDS = ("clock_jump", "brown_out", "reboot")
MAX_STEPS_PER_CALL = 200
"""After a pause the backlog is worked off in pieces of so many steps, so that signals and sockets are still served."""


class OptionError(Exception):
    """An option that cannot be used; the message is one line for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualRobotOptions:
    """Options of the virtual robot.

    With kind "can" and interface "unixcan" the process serves a bus of its own at the socket `channel`, with frames
    taking their time on the wire; any other `interface` is joined through python-can. With kind "serial" it
    makes a pseudo-terminal, and a symbolic link to it at `port` unless that is None.

    `board`: serial port of the plant's line of a board whose firmware has one (docs/port.md); the board has a link of
    its own, and nothing here serves one.

    `firmware`: limits and identity of the reference controller; `controller` makes another one in its place, whose
    robot's poses go to `pose_address` in datagrams of `drivers.pose.udp`. `start`: pose of the tracked point at the
    start. `effects`:
    hidden effects by name (see `sim.effects`). `seed`: all disturbances and noise. `challenge_seed`: arming
    challenges that are the same in every run, for tests alone; None draws them from the system. `truth_file`: CSV of
    `sim.virtual_robot.TRUTH_COLUMNS` at 100 Hz. `bus_log`: every frame on the own bus or line, as candump does.
    `inject`: socket for the commands of `sim.fault_player`.
    `faults`: what goes wrong, from the ready line on; of the faults of processes only `cpu_hog`.
    `realtime_priority`: SCHED_FIFO priority where the system allows it; 0 for none.
    """

    kind: Literal["can", "serial"] = "can"
    interface: str = "unixcan"
    channel: str = "disco-robot.sock"
    bitrate: int = 500_000
    port: str | None = None
    baud: int = 921_600
    board: str | None = None
    start: BodyPose = field(default_factory=BodyPose)
    plant: PlantParameters = field(default_factory=PlantParameters)
    effects: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    seed: int = 0
    challenge_seed: int | None = None
    firmware: FirmwareConfig | None = None
    controller: Callable[[], Controller] | None = None
    pose_address: tuple[str, int] | None = None
    clock: ControllerClock = field(default_factory=ControllerClock)
    truth_file: Path | None = None
    bus_log: Path | None = None
    inject: Path | None = None
    faults: FaultSchedule | None = None
    realtime_priority: int = 40

    @property
    def firmware_config(self) -> FirmwareConfig:
        """`firmware`, or a configuration that fits the plant."""
        if self.firmware is not None:
            return self.firmware
        return FirmwareConfig(ticks_per_rev=self.plant.ticks_per_rev, max_wheel_speed_rad_s=8.0)


def run_virtual_robot(options: VirtualRobotOptions) -> int:
    """Run the virtual robot until SIGTERM or SIGINT; main thread only.

    Prints one line that begins with "ready" when a host can open the link. Returns 0 after a clean stop, 2 with one
    line on stderr if an option cannot be used, 1 if a record could not be written to its end, which stderr says then.
    """
    stop = StopSignal()
    records: list[TextRecord] = []
    with contextlib.ExitStack() as resources:
        try:
            process = _set_up(options, records, resources)
        except (OptionError, SocketPathError, SerialPathError, HiddenEffectError) as error:
            print(error, file=sys.stderr)
            return 2
        scheduling = _schedule(options.realtime_priority)
        print(f"ready {process.link.address} ({scheduling})", flush=True)
        process.start(options.faults, resources)
        while not stop.requested:
            select.select((*process.filenos(), stop.fileno()), (), (), process.timeout_s())
            process.work()
        print(f"stopped after {process.robot.plant.now_us / 1e6:.3f} s: {process.link.summary()}", file=sys.stderr)
    return 1 if any(record.error for record in records) else 0


class _Process:
    """Keeps the robot's time on the monotonic clock and carries frames between it and the link."""

    def __init__(
        self,
        robot: Robot,
        link: RobotLink,
        commands: CommandSocket | None,
        recorder: TruthRecorder | None,
    ) -> None:
        self.robot = robot
        self.link = link
        self._injection = Injection(robot, link)
        self._commands = commands
        self._recorder = recorder
        self._player: FaultPlayer | None = None
        self._start_ns = 0
        self._steps = 0

    def start(self, faults: FaultSchedule | None, resources: contextlib.ExitStack) -> None:
        """Let robot time 0, and that of the faults, be now; `resources` ends what faults leave behind."""
        self._start_ns = time.monotonic_ns()
        if faults is not None:
            hogs = resources.enter_context(CpuHogs())
            self._player = FaultPlayer(faults, self.robot, self.link, self._start_ns, _report, hogs)

    def filenos(self) -> list[int]:
        return [*self.link.filenos(), *([] if self._commands is None else [self._commands.fileno()])]

    def timeout_s(self) -> float:
        """Return the time until the next event is due, in s."""
        due_ns = self._start_ns + (self._steps + 1) * STEP_NS
        link_ns = self.link.next_event_ns()
        if link_ns is not None:
            due_ns = min(due_ns, link_ns)
        return max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)

    def work(self) -> None:
        """Do what is due: all steps of the robot up to now, the link, commands."""
        now_ns = time.monotonic_ns()
        link, robot = self.link, self.robot
        behind = (now_ns - self._start_ns) // STEP_NS - self._steps
        due = min(behind, MAX_STEPS_PER_CALL)
        waiting = link.collect(now_ns)
        for step in range(due):
            self._steps += 1
            t_ns = self._start_ns + self._steps * STEP_NS
            # After a pause, frames that came during it are let in as if they had come evenly over it.
            self._receive(link.advance(t_ns, waiting * (step + 1) // behind - waiting * step // behind))
            link.send(robot.step(self._steps * STEP_US, link.error_counters))
            self._injection.step(t_ns)
            if self._player is not None:
                self._player.step(t_ns)
            if self._recorder is not None and self._steps % TRUTH_STEPS == 0:
                self._recorder.record(robot, t_ns)
        if due == behind:
            self._receive(link.advance(now_ns))
        if self._commands is not None:
            self._commands.serve(lambda text: self._injection.execute(text, now_ns))

    def _receive(self, frames: list[ReceivedFrame]) -> None:
        for received in frames:
            self.robot.receive((received.t_ns - self._start_ns) // 1000, received.frame)


def _set_up(options: VirtualRobotOptions, records: list[TextRecord], resources: contextlib.ExitStack) -> _Process:
    if options.faults is not None:
        _check_faults(options.faults, options)
    robot = _create_robot(options)
    if isinstance(robot, VendorRobot) and options.pose_address is not None:
        sender = PoseSender(options.pose_address)
        resources.callback(sender.close)
        robot.pose_sink = sender.send
    truth, bus = (_open_record(path, records, resources) for path in (options.truth_file, options.bus_log))
    recorder = None if truth is None else TruthRecorder(truth)
    log = None if bus is None else bus.line
    link = _open_link(options, log)
    resources.callback(link.close)
    if isinstance(robot, BoardRobot):
        _synchronise(robot, link, options)
    commands = None if options.inject is None else CommandSocket(options.inject)
    if commands is not None:
        resources.callback(commands.close)
    _rehearse(options)
    # Nothing made so far will go away: the collector need not look at it again.
    gc.freeze()
    return _Process(robot, link, commands, recorder)


def _open_record(path: Path | None, records: list[TextRecord], resources: contextlib.ExitStack) -> TextRecord | None:
    if path is None:
        return None
    try:
        record = TextRecord(path, _report)
    except OSError as error:
        raise OptionError(f"{error.filename}: {error.strerror}; choose another file") from None
    resources.callback(record.close)
    records.append(record)
    return record


def _check_faults(schedule: FaultSchedule, options: VirtualRobotOptions) -> None:
    """Refuse what this process, or this kind of link, cannot do."""
    kind, interface, has_board = options.kind, options.interface, options.board is not None
    if kind == "can" and interface != "unixcan" and not has_board:
        raise OptionError(f"faults: not on {interface}; only on the simulator's own bus (unixcan) or a serial line")
    for fault in schedule.faults:
        name, site, why = fault.kind.name, fault.kind.site, ""
        if name == "cpu_hog":
            continue
        if has_board and (site in (Site.FRAMES, Site.LINK, Site.PROCESS) or name in NOT_OF_BOARDS):
            why = "cannot be used with --board, whose link and clock are its own; leave it out"
        elif site is Site.PROCESS:
            why = "other processes are not the simulator's; use tests/hil"
        elif kind == "serial" and not has_board and name in BUS_ONLY:
            why = "a serial line has no such fault; remove it, or use a CAN bus"
        if why:
            raise OptionError(f"fault {fault.number}: {name}: {why}")


def _synchronise(robot: BoardRobot, link: RobotLink, options: VirtualRobotOptions) -> None:
    """Wait until the board has said what it is."""
    deadline = time.monotonic() + BOARD_S
    while robot.about is None:
        left_s = deadline - time.monotonic()
        if left_s <= 0.0:
            raise OptionError(
                f"--board {options.board}: no answer on the plant's line; name the board's second serial line, and "
                "build its firmware with -DDISCO_PLANT_LINE (docs/port.md)"
            )
        select.select(link.filenos(), (), (), left_s)
        now_ns = time.monotonic_ns()
        link.collect(now_ns)
        for received in link.advance(now_ns):
            robot.receive(0, received.frame)
    version, ticks = robot.about
    if version != VERSION:
        raise OptionError(
            f"--board {options.board}: its plant's line has version {version}, this computer {VERSION}; flash the "
            "board again"
        )
    if ticks != options.plant.ticks_per_rev:
        raise OptionError(
            f"--board {options.board}: it counts {ticks} ticks a turn, and robot.ticks_per_rev is "
            f"{options.plant.ticks_per_rev}; correct one of them"
        )


def _create_robot(options: VirtualRobotOptions) -> Robot:
    plant = Plant(options.plant, hidden_effects(options.effects), options.seed, options.start)
    if options.board is not None:
        return BoardRobot(plant)
    if options.controller is not None:
        return VendorRobot(plant, options.controller())
    try:
        return VirtualRobot(plant, options.firmware_config, options.clock, options.challenge_seed)
    except OverflowError as error:
        raise OptionError(f"{_given(options.firmware_config)}: {error}; give a smaller value") from None


def _rehearse(options: VirtualRobotOptions) -> None:
    """Load or compile the machine code, which must not happen while a host waits; see that the firmware starts."""
    robot = _create_robot(options)
    for step in range(1, WARM_UP_STEPS + 1):
        robot.step(step * STEP_US)
    if options.controller is None and robot.outputs.state == "FAULT":
        raise OptionError(f"{_given(options.firmware_config)}: out of the firmware's range; correct the value")


def _given(config: FirmwareConfig) -> str:
    """Return the fields of a configuration that someone has chosen."""
    chosen = [
        f"{field.name}={getattr(config, field.name)}"
        for field in fields(config)
        if field.repr and getattr(config, field.name) != field.default
    ]
    return f"firmware {', '.join(chosen)}"


def _open_link(options: VirtualRobotOptions, log: Callable[[str], object] | None) -> RobotLink:
    now_ns = time.monotonic_ns()
    if options.board is not None:
        try:
            return PlantLine(options.board)
        except (OSError, serial.SerialException) as error:
            raise OptionError(f"--board {options.board}: cannot be opened ({error}); check the port") from None
    if options.kind == "serial":
        if options.baud <= 0:
            raise OptionError(f"baud {options.baud}: not positive; give the line's rate in bit/s")
        path = None if options.port is None else Path(options.port)
        framed = options.controller is None
        return SerialLine(path, now_ns, baud=options.baud, log=log, framed=framed)
    if options.bitrate <= 0:
        raise OptionError(f"bitrate {options.bitrate}: not positive; give the bus's rate in bit/s")
    if options.interface == "unixcan":
        return Hub(Path(options.channel), now_ns, bitrate=options.bitrate, log=log)
    try:
        return PythonCanLink(options.interface, options.channel, now_ns, bitrate=options.bitrate)
    except (can.CanError, OSError, ValueError, NotImplementedError) as error:
        name = f"{options.interface} {options.channel}"
        raise OptionError(f"{name}: cannot be opened ({error}); check interface and channel") from None


def _schedule(priority: int) -> str:
    """Request SCHED_FIFO and return what was granted.

    Late steps would look to a host like a robot that misses commands.
    """
    if priority <= 0:
        return "no real-time priority asked for"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return "no real-time priority allowed"
    return f"SCHED_FIFO {priority}"


def _report(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
