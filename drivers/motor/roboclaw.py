"""The driver of RoboClaw boards on packet serial, one or two.

A board knows no armed state: the first speed that it is sent moves it, and every packet, a question too, feeds its
serial timeout. So nothing is asked of a board before it has taken a stop, and nothing is asked while it is armed
without a command. Armed is what this driver says it is: each board has its timeout, no error, and took zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from drivers.motor import roboclaw_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.roboclaw_protocol import (
    EXAMPLE,
    QUESTIONS,
    RoboclawExchange,
    RoboclawSettings,
    cyclic_frames,
    question,
    recognise,
    safety_card,
    setting,
    stands,
    stop_confirmation,
    stop_frames,
)
from drivers.motor.vendor_parts import Stage
from drivers.types import (
    DriverState,
    DriverStats,
    Frame,
    Identity,
    Limit,
    Limits,
    MotorDriver,
    OutgoingFrame,
    Readings,
    ReceivedFrame,
    Request,
    RobotStatus,
    WheelCommand,
    WheelSample,
)

ZEROS_TO_ARM = 5
SILENT_NS = 100_000_000
GONE_NS = 500_000_000
ARMING_TIMEOUT_NS = 1_500_000_000
BRAKING_NS = 3_000_000_000
_PACE_NS = 18_000_000
_REPEAT_NS = 100_000_000
_QUESTION_LIFE_NS = 20_000_000
_QUESTION_RANK = 2
_LONGEST_LIFE_NS = 60_000_000
_TIMEOUT_EVERY = 8
"""Of the slow questions every so many is for the serial timeout, the others for the errors."""
_ESTOP, _ERRORS = 0x1, 0xFFFF
_WORDS = {
    0x2: "it is too hot",
    0x4: "it is too hot",
    0x8: "the main supply's voltage is too high",
    0x10: "the logic supply's voltage is too high",
    0x20: "the logic supply's voltage is too low",
    0x40: "the power stage of motor 1 failed",
    0x80: "the power stage of motor 2 failed",
    0x100: "motor 1 does not keep its speed",
    0x200: "motor 2 does not keep its speed",
    0x1000: "motor 1 takes too much current",
    0x2000: "motor 2 takes too much current",
    0x4000: "the main supply's voltage is too low",
    0x8000: "the main supply's voltage is too high",
}
_SETTER_NAMES = {layout.command: name for name, layout in protocol.SETTERS.items()}
_TO_KNOW = ("version", "velocity_pid_m1", "velocity_pid_m2", "status", "serial_timeout", "speeds", "encoders")


@dataclass(slots=True)
class _Board:
    """What is known of one board, by question; `counts` are cumulative and do not wrap.

    `stopped`: it has taken a stop since the last command. `waits_ns`: since when it has not answered, `refuses_ns`
    since when it has taken no command.
    """

    address: int
    known: dict[str, Mapping[str, protocol.Value]] = field(default_factory=dict)
    counts: list[float] = field(default_factory=lambda: [0.0, 0.0])
    counts_ns: int = 0
    is_new: bool = False
    stopped: bool = False
    zeros: int = 0
    waits_ns: int | None = None
    refuses_ns: int | None = None

    @property
    def errors(self) -> int:
        """The bits of its status that are no warnings."""
        return int(self.known["status"]["status_u32"]) & _ERRORS if "status" in self.known else 0

    @property
    def timeout_ds(self) -> int | None:
        """Its serial timeout as read last, in steps of 0.1 s."""
        return int(self.known["serial_timeout"]["timeout_ds"]) if "serial_timeout" in self.known else None

    @property
    def fastest_counts_s(self) -> float:
        """What both motors can do at full duty."""
        return float(min(int(self.known[f"velocity_pid_m{motor}"]["qpps"]) for motor in (1, 2)))

    @property
    def speeds(self) -> tuple[float, float]:
        """As measured, in counts/s."""
        read = self.known["speeds"]
        return float(read["speed_m1"]), float(read["speed_m2"])

    @property
    def is_known(self) -> bool:
        """Whether it has answered all that must be known of it."""
        return all(name in self.known for name in _TO_KNOW)


class RoboclawDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: RoboclawSettings) -> None:
        self._settings = settings
        self._boards = {address: _Board(address) for address in settings.addresses}
        self._attention = parts.Attention()
        self.stats = DriverStats()
        self._link_is_up = False
        self._stage = Stage.BRAKING
        self._stage_ns: int | None = None
        self._wanted, self._note = Request.STANDBY, "it stands by"
        self._fault: str | None = None
        self._estopped = False
        self._speeds = (0.0, 0.0)
        self._last_sent_ns = self._velocity_ns = self._asked_ns = self._repeat_ns = 0
        self._slow = 0
        self._events: list[str] = []

    @property
    def state(self) -> DriverState:
        """Where the driver is with its boards."""
        if not self._link_is_up:
            return DriverState.DISCONNECTED
        if self._estopped or any(board.errors & _ESTOP for board in self._all):
            return DriverState.ESTOP
        if not self._is_known and self._fault is None:
            return DriverState.HANDSHAKE
        if self._fault is not None or any(board.errors for board in self._all):
            return DriverState.FAULT
        if self._stage is Stage.ARMED:
            return DriverState.ARMED
        if self._stage in (Stage.STOPPING, Stage.BRAKING):
            return DriverState.STOPPING
        rest = {Request.ARM: DriverState.ARMING, Request.READY: DriverState.READY}
        return rest.get(self._wanted, DriverState.STANDBY)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        match self.state:
            case DriverState.DISCONNECTED:
                return "the link is down"
            case DriverState.HANDSHAKE:
                silent = ", ".join(str(board.address) for board in self._all if not board.is_known)
                return f"board {silent} does not answer; is it switched on, in packet serial, at this baud and address?"
            case DriverState.ESTOP:
                pressed = any(board.errors & _ESTOP for board in self._all)
                return "its e-stop input is pressed" if pressed else "emergency stop; remove its cause, then reset"
            case DriverState.FAULT:
                said = [_error(board) for board in self._all if board.errors]
                return f"{self._fault or '; '.join(said)}; remove the cause, then reset"
            case DriverState.ARMED:
                return "armed"
        return self._note

    @property
    def identity(self) -> Identity | None:
        """What the first board says of itself."""
        if not self._is_known:
            return None
        return Identity("RoboClaw", str(self._all[0].known["version"]["version"]).strip(), "device")

    @property
    def limits(self) -> Limits | None:
        """The slowest board's fastest speed, the serial time-out that was read back, and what robot.toml declares."""
        if self.identity is None:
            return None
        settings = self._settings
        return Limits(
            max_wheel_speed_rad_s=Limit(self._fastest_rad_s, "device"),
            command_timeout_s=Limit(settings.watchdog_s, "device"),
            stop_deceleration_rad_s2=Limit(settings.stop_deceleration_rad_s2, "robot.toml"),
        )

    def link_up(self, now_ns: int) -> None:
        """The medium has come up (again): whatever was agreed is void."""
        self._restart("the link was lost")
        self._fault = None
        self._link_is_up = True

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._restart("the link was lost")
        self._fault = None
        self._link_is_up = False

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the motors are stopped."""
        if request is self._wanted:
            return
        if request is Request.ARM:
            if self.state not in (DriverState.STANDBY, DriverState.READY):
                self._note = f"not arming: {self.detail}"
                return
            self.stats = replace(self.stats, sessions=self.stats.sessions + 1)
            self._note, self._stage, self._stage_ns, self._repeat_ns = "arming", Stage.ARMING, None, 0
            self._speeds = (0.0, 0.0)
            for board in self._all:
                board.zeros, board.stopped = 0, False
                # A board that has restarted since has forgotten it.
                del board.known["serial_timeout"]
        elif self._wanted is Request.ARM and self._stage in (Stage.ARMING, Stage.ARMED):
            self._note, self._stage, self._stage_ns = "stopping as asked", Stage.STOPPING, None
        self._wanted = request

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in replies and return what they meant; those that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._link_is_up else ():
            address, command = divmod(received.frame.can_id, 256)
            board = self._boards.get(address)
            if board is None or received.frame.extended:
                self._count("unknown_id")
                continue
            name = protocol.getter_name(command)
            if name is None:
                self._take_acknowledgement(board, received.frame, received.t_ns)
                continue
            read = protocol.reply(address, name, received.frame.data)
            if read is None:
                self._count("rejected_crc")
                continue
            self._heard(board)
            if name == "encoders":
                self._take_counts(board, read[0], received.t_ns)
            board.known[name] = read[0]
            if name == "encoders" and self._is_known:
                status.append(self._status(received.t_ns))
                if all(each.is_new for each in self._all):
                    wheels.append(self._sample(received.t_ns))
        if self._link_is_up:
            self._check(now_ns)
        events, self._events = tuple(self._events), []
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Packets due now: the command, or what stops; and the questions, which feed the serial timeout.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._link_is_up:
            return ()
        late = now_ns - self._last_sent_ns > self._settings.watchdog_s * 1e9
        if late and (self._stage is Stage.ARMED or (self._stage is Stage.STOPPING and any(self._speeds))):
            # They have no armed state to fall out of: the next speed would move them again.
            self._lose("no command for longer than the boards' serial timeout")
            return self._brake(now_ns)
        match self._stage:
            case Stage.REST:
                return (*self._reset(now_ns), *self._paced_questions(now_ns))
            case Stage.ARMING:
                return self._arm(now_ns)
            case Stage.STOPPING:
                return self._ramp(now_ns)
            case Stage.BRAKING:
                return self._brake(now_ns)
        if command is None:
            return ()
        self._speeds, self._last_sent_ns = (command.left_rad_s, command.right_rad_s), now_ns
        self._count("commands_sent")
        # Half of its validity may pass on the way.
        sent = parts.outgoing(now_ns, *self._velocity(now_ns), life_ns=round(0.5e9 * command.valid_for_s))
        return (*sent, *self._questions(now_ns, self._all))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Packets that stop every motor in any state; the driver goes on with that until they are taken."""
        self._wanted, self._estopped = Request.STANDBY, True
        self._begin_braking("emergency stop sent")
        return parts.estop_frames(now_ns, self._stops(self._all))

    @property
    def _all(self) -> Sequence[_Board]:
        return tuple(self._boards.values())

    @property
    def _is_known(self) -> bool:
        return all(board.is_known or (self._stage is Stage.ARMING and "encoders" in board.known) for board in self._all)

    @property
    def _stands(self) -> bool:
        return all(stands(self._settings, *board.speeds) for board in self._all)

    @property
    def _fastest_rad_s(self) -> float:
        return min(board.fastest_counts_s for board in self._all) / self._settings.counts_per_rad

    def _stops(self, boards: Sequence[_Board]) -> tuple[Frame, ...]:
        return tuple(setting(board.address, "duty_m1m2", duty_m1=0, duty_m2=0) for board in boards)

    def _paced_questions(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if now_ns - self._asked_ns < _PACE_NS:
            return ()
        return self._questions(now_ns, [board for board in self._all if board.stopped])

    def _questions(self, now_ns: int, boards: Sequence[_Board]) -> tuple[OutgoingFrame, ...]:
        """What is still unknown of a board, one question at a time; of a known one speeds and counts.

        And of one board in turn its errors or its serial timeout.
        """
        self._asked_ns = now_ns
        frames = []
        self._slow += 1
        turn, number = divmod(self._slow, len(self._all))
        for board in boards:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
            unknown = [name for name in _TO_KNOW if name not in board.known]
            names = unknown[:1] or ["speeds", "encoders"]
            if not unknown and board is self._all[number]:
                names.append("serial_timeout" if turn % _TIMEOUT_EVERY == 0 else "status")
            frames += [question(board.address, name) for name in names]
        return tuple(OutgoingFrame(frame, now_ns + _QUESTION_LIFE_NS, _QUESTION_RANK) for frame in frames)

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """The serial timeout, set and read back, and zeros for as long as the motors stand."""
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        if not self._stands:
            self._begin_braking("not armed: a motor turns; wait until it stands")
            return self._brake(now_ns)
        wanted = self._settings.timeout_ds
        without = [board for board in self._all if board.timeout_ds != wanted]
        if without and now_ns - self._stage_ns > ARMING_TIMEOUT_NS:
            self._begin_braking(f"not armed: board {without[0].address} does not take its serial timeout")
            return self._brake(now_ns)
        self._last_sent_ns = now_ns
        if without:
            if now_ns - self._repeat_ns < _REPEAT_NS:
                return ()
            self._repeat_ns = now_ns
            asked = [
                frame
                for board in without
                for frame in (
                    setting(board.address, "set_serial_timeout", timeout_ds=wanted),
                    question(board.address, "serial_timeout"),
                )
            ]
            return parts.outgoing(now_ns, *asked)
        if all(board.zeros >= ZEROS_TO_ARM for board in self._all):
            self._stage, self._note = Stage.ARMED, "armed"
        sent = parts.outgoing(now_ns, *self._velocity(now_ns))
        return (*sent, *self._questions(now_ns, self._all))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then stop, then only ask."""
        elapsed_ns, self._last_sent_ns = now_ns - self._last_sent_ns, now_ns
        self._speeds = parts.slowed(self._speeds, self._settings.stop_deceleration_rad_s2, elapsed_ns)
        if any(self._speeds):
            return (*parts.outgoing(now_ns, *self._velocity(now_ns)), *self._questions(now_ns, self._all))
        self._begin_braking(self._note)
        return self._brake(now_ns)

    def _brake(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Zero duty for each board until it takes it, and before that no question, which would feed its timeout."""
        self._stage_ns = now_ns if self._stage_ns is None else self._stage_ns
        waiting = [board for board in self._all if not board.stopped]
        stood = self._is_known and (self._stands or now_ns - self._stage_ns > BRAKING_NS)
        if not waiting and stood:
            self._stage = Stage.REST
        if now_ns - self._asked_ns < _PACE_NS:
            return ()
        for board in waiting:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
        return (*parts.outgoing(now_ns, *self._stops(waiting)), *self._paced_questions(now_ns))

    def _reset(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Clear what is latched here and an e-stop that a board has latched; it ends its other errors by itself."""
        if self._wanted is not Request.RESET:
            return ()
        if not any(board.errors for board in self._all):
            self._fault, self._estopped, self._wanted, self._note = None, False, Request.STANDBY, "it stands by"
        elif now_ns - self._repeat_ns >= _REPEAT_NS:
            self._repeat_ns = now_ns
            latched = [board.address for board in self._all if board.errors & _ESTOP]
            return parts.outgoing(now_ns, *(setting(address, "reset_estop") for address in latched))
        return ()

    def _velocity(self, now_ns: int) -> list[Frame]:
        settings, self._velocity_ns = self._settings, now_ns
        per_board = {address: [0.0, 0.0] for address in self._boards}
        fastest = self._fastest_rad_s
        for side, direction, speed in zip(settings.sides, settings.direction, self._speeds, strict=True):
            for address, motor in side:
                per_board[address][motor] = direction * min(max(speed, -fastest), fastest) * settings.counts_per_rad
        frames = []
        for board in self._all:
            board.refuses_ns = now_ns if board.refuses_ns is None else board.refuses_ns
            board.stopped = False
            first, second = map(round, per_board[board.address])
            accel = max(1, round(settings.acceleration_rad_s2 * settings.counts_per_rad))
            speeds = {"speed_m1_counts_s": first, "speed_m2_counts_s": second}
            frames.append(setting(board.address, "speed_accel_m1m2", accel_counts_s2=accel, **speeds))
        return frames

    def _heard(self, board: _Board) -> None:
        board.waits_ns = None
        self._count("frames_accepted")

    def _take_acknowledgement(self, board: _Board, frame: Frame, t_ns: int) -> None:
        name = _SETTER_NAMES.get(frame.can_id & 0xFF)
        if name is None or frame.data != protocol.ACKNOWLEDGE:
            self._count("unknown_id")
            return
        self._heard(board)
        if name == "duty_m1m2" and self._stage is Stage.BRAKING:
            # A speed that waited behind the stop is sent after it: what is taken before that is gone is no stop yet.
            board.stopped = t_ns - self._velocity_ns > _LONGEST_LIFE_NS
        elif name == "speed_accel_m1m2":
            board.refuses_ns = None
            board.zeros += 1

    def _take_counts(self, board: _Board, read: Mapping[str, protocol.Value], t_ns: int) -> None:
        before = board.known.get("encoders")
        if before is not None and board.is_known:
            fastest = 1.5 * board.fastest_counts_s * (t_ns - board.counts_ns) * 1e-9 + 100.0
            moved = [
                (int(read[name]) - int(before[name]) + 2**31) % 2**32 - 2**31 for name in ("encoder_m1", "encoder_m2")
            ]
            if max(map(abs, moved)) <= fastest:
                board.counts = [count + more for count, more in zip(board.counts, moved, strict=True)]
            else:
                self._count("implausible_ticks")
                if self._stage in (Stage.ARMING, Stage.ARMED):
                    self._lose(f"board {board.address} has restarted: its counts jumped")
        board.counts_ns, board.is_new = t_ns, True

    def _sample(self, t_ns: int) -> WheelSample:
        per_count = 1.0 / self._settings.counts_per_rad
        angles, speeds = [], []
        for side, direction in zip(self._settings.sides, self._settings.direction, strict=True):
            boards = [(self._boards[address], motor) for address, motor in side]
            # What was counted earlier is carried on to the newest.
            counts = [b.counts[m] + b.speeds[m] * (t_ns - b.counts_ns) * 1e-9 for b, m in boards]
            angles.append(direction * per_count * sum(counts) / len(side))
            speeds.append(direction * per_count * sum(board.speeds[motor] for board, motor in boards) / len(side))
        for board in self._all:
            board.is_new = False
        return WheelSample(t_ns, t_ns, angles[0], angles[1], speeds[0], speeds[1])

    def _check(self, now_ns: int) -> None:
        """Errors, silence, commands not taken and a timeout that is not the one set stop all."""
        self._attention.look(now_ns)
        for board in self._all:
            silent_ns = 0 if board.waits_ns is None else self._attention.silent_ns(board.waits_ns)
            if self._stage in (Stage.ARMING, Stage.ARMED, Stage.STOPPING):
                refused_ns = 0 if board.refuses_ns is None else self._attention.silent_ns(board.refuses_ns)
                timeout_ds = board.timeout_ds
                if board.errors:
                    self._lose(_error(board))
                elif silent_ns > SILENT_NS:
                    self._lose(f"board {board.address} fell silent")
                elif refused_ns > SILENT_NS:
                    self._lose(f"board {board.address} does not take its commands")
                elif self._stage is Stage.ARMED and timeout_ds != self._settings.timeout_ds:
                    self._lose(f"board {board.address} has restarted: its serial timeout is not the one that was set")
            elif silent_ns > GONE_NS and board.known:
                self._restart(f"board {board.address} fell silent")
                self._events.append(f"board {board.address} fell silent: asking anew")

    def _status(self, t_ns: int) -> RobotStatus:
        at_rest = self._stands and all(board.stopped for board in self._all)
        return parts.status(t_ns, self.state, at_rest)

    def _begin_braking(self, note: str) -> None:
        self._wanted, self._note = Request.STANDBY, note
        self._stage, self._stage_ns, self._asked_ns = Stage.BRAKING, None, 0
        for board in self._all:
            board.stopped, board.refuses_ns = False, None

    def _lose(self, why: str) -> None:
        """One board is lost: all stop, latched."""
        self._begin_braking(f"disarmed: {why}")
        self._fault = why
        self._events.append(f"disarmed: {why}")

    def _restart(self, why: str) -> None:
        note = f"disarmed: {why}" if self._wanted is Request.ARM else self._note
        self._begin_braking(note)
        for board in self._all:
            board.known, board.is_new, board.waits_ns = {}, False, None

    def _count(self, name: str) -> None:
        self.stats = replace(self.stats, **{name: getattr(self.stats, name) + 1})


def _error(board: _Board) -> str:
    if board.errors & _ESTOP:
        return f"board {board.address}: its e-stop input is pressed"
    bit = board.errors & -board.errors
    return f"board {board.address}: {_WORDS.get(bit, f'error {board.errors:#06x}')}"


DRIVER = MotorDriver(
    "roboclaw",
    lambda settings, _key: RoboclawDriver(settings),
    settings=RoboclawSettings,
    example=EXAMPLE,
    kinds=("serial",),
    exchange=lambda _settings: RoboclawExchange(),
    recognise=recognise,
    questions=QUESTIONS,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=stop_confirmation,
    cyclic_frames=cyclic_frames,
    safety_card=safety_card,
)
