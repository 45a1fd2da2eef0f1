"""The driver of RoboClaw boards on packet serial, one or two.

A board knows no armed state: the first speed that it is sent moves it, and every packet, a question too, feeds its
serial timeout. So nothing is asked of a board before it has taken a stop, and nothing is asked while it is armed
without a command. Armed is what this driver says it is: each board has its timeout, no error, and took zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from drivers.motor import roboclaw_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.permit import Controllers, MotionPermit, Stage
from drivers.motor.roboclaw_protocol import RoboclawExchange, RoboclawSettings, question, setting, stands, stop_frames
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
TO_KNOW = ("version", "velocity_pid_m1", "velocity_pid_m2", "status", "serial_timeout", "speeds", "encoders")


@dataclass(slots=True)
class Board:
    """What is known of one board, by question; `turned` of both motors.

    `stopped`: it has taken a stop since the last command. `waits_ns`: since when it has not answered, `refuses_ns`
    since when it has taken no command.
    """

    address: int
    known: dict[str, Mapping[str, protocol.Value]] = field(default_factory=dict)
    turned: tuple[parts.Odometer, parts.Odometer] = field(default_factory=lambda: (parts.Odometer(), parts.Odometer()))
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
        return all(name in self.known for name in TO_KNOW)

    @property
    def is_pressed(self) -> bool:
        """Whether its e-stop input is, or was and is latched."""
        return bool(self.errors & _ESTOP)

    @property
    def error_words(self) -> str:
        """Its first error, for a person."""
        if self.is_pressed:
            return f"board {self.address}: its e-stop input is pressed"
        bit = self.errors & -self.errors
        return f"board {self.address}: {_WORDS.get(bit, f'error {self.errors:#06x}')}"

    def take_counts(self, read: Mapping[str, protocol.Value], t_ns: int, looked_ns: int) -> bool:
        """Whether its motors can have turned so far since they were counted last."""
        if not {"velocity_pid_m1", "velocity_pid_m2"} <= self.known.keys():
            return True
        first, second = self.turned
        fastest = 1.5 * self.fastest_counts_s
        is_first_plausible = first.take_wrapping(int(read["encoder_m1"]), t_ns, looked_ns, fastest, 100.0)
        return second.take_wrapping(int(read["encoder_m2"]), t_ns, looked_ns, fastest, 100.0) and is_first_plausible

    def meet_anew(self) -> None:
        """Nothing is known of it but what its motors have turned."""
        self.known, self.waits_ns = {}, None
        for motor in self.turned:
            motor.begin_anew()


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
_SETTER_NAMES = {layout.command: name for name, layout in protocol.SETTERS.items()}


class RoboclawDriver:
    """Satisfies `drivers.types.Driver`: pure, and no frame makes it raise."""

    clock_offset_ns: int | None = None

    def __init__(self, settings: RoboclawSettings) -> None:
        self._settings = settings
        self._boards = {address: Board(address) for address in settings.addresses}
        self.stats = DriverStats()
        self._permit = MotionPermit(idle=Stage.BRAKING, after_loss=Stage.BRAKING, stage=Stage.BRAKING)
        self._velocity_ns = self._asked_ns = self._repeat_ns = 0
        self._slow = 0

    @property
    def state(self) -> DriverState:
        """Where the driver is with its boards."""
        return self._permit.state(self._seen)

    @property
    def detail(self) -> str:
        """For a person: why the state is what it is, and what to do about it."""
        return self._permit.detail(self._seen)

    @property
    def _seen(self) -> Controllers:
        silent = ", ".join(str(board.address) for board in self._all if not board.is_known)
        missing = f"board {silent} does not answer; is it switched on, in packet serial, at this baud and address?"
        pressed = any(board.is_pressed for board in self._all)
        return Controllers(
            missing=None if self._is_known else missing,
            stopped="its e-stop input is pressed" if pressed else None,
            faulty="; ".join(board.error_words for board in self._all if board.errors) or None,
        )

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
        self._meet_anew(self._permit.linked(True))

    def link_down(self, now_ns: int) -> None:
        """The medium is gone: whatever was agreed is void."""
        self._meet_anew(self._permit.linked(False))

    def request(self, request: Request) -> None:
        """Set what the host wants; ARM only from standing by, and consumed when the motors are stopped."""
        before, self._permit = self._permit, self._permit.requested(request, self._seen)
        if self._permit.wanted is Request.ARM is not before.wanted:
            self._count("sessions")
            self._repeat_ns = 0
            for board in self._all:
                board.zeros, board.stopped = 0, False
                # A board that has restarted since has forgotten it.
                del board.known["serial_timeout"]

    def receive(self, now_ns: int, frames: Sequence[ReceivedFrame]) -> Readings:
        """Take in replies and return what they meant; those that come while the link is down are ignored."""
        wheels: list[WheelSample] = []
        status: list[RobotStatus] = []
        for received in frames if self._permit.link_is_up else ():
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
            if name == "speeds":
                board.turned[0].speed, board.turned[1].speed = board.speeds
            if name == "encoders" and self._is_known:
                status.append(self._status(received.t_ns))
                if all(each.is_new for board in self._all for each in board.turned):
                    wheels.append(self._sample(received.t_ns))
        if self._permit.link_is_up:
            self._check(now_ns)
        events, self._permit = self._permit.events, replace(self._permit, events=())
        return Readings(wheels=tuple(wheels), status=tuple(status[-1:]), events=events)

    def transmit(self, now_ns: int, command: WheelCommand | None) -> tuple[OutgoingFrame, ...]:
        """Packets due now: the command, or what stops; and the questions, which feed the serial timeout.

        Raises ValueError for a command that is not finite or valid for no time.
        """
        parts.check_command(command)
        if not self._permit.link_is_up:
            return ()
        if self._permit.is_late(now_ns, self._settings.watchdog_s):
            # They have no armed state to fall out of: the next speed would move them again.
            self._stop(self._permit.lost("no command for longer than the boards' serial timeout"))
            return self._brake(now_ns)
        match self._permit.stage:
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
        self._permit = self._permit.commanded(now_ns, command)
        self._count("commands_sent")
        return (*parts.commanding(now_ns, command, *self._velocity(now_ns)), *self._questions(now_ns, self._all))

    def release(self, why: str) -> None:
        """Zero duty for every motor from now on, which needs no encoder."""
        self._stop(self._permit.lost(why))

    def estop(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Packets that stop every motor in any state; the driver goes on with that until they are taken."""
        self._stop(self._permit.stopped())
        return parts.estop_frames(now_ns, self._stops(self._all))

    @property
    def _all(self) -> Sequence[Board]:
        return tuple(self._boards.values())

    @property
    def _is_known(self) -> bool:
        arming = self._permit.stage is Stage.ARMING
        return all(board.is_known or (arming and "encoders" in board.known) for board in self._all)

    @property
    def _stands(self) -> bool:
        return all(stands(self._settings, *board.speeds) for board in self._all)

    @property
    def _fastest_rad_s(self) -> float:
        return min(board.fastest_counts_s for board in self._all) / self._settings.counts_per_rad

    def _stops(self, boards: Sequence[Board]) -> tuple[Frame, ...]:
        return tuple(setting(board.address, "duty_m1m2", duty_m1=0, duty_m2=0) for board in boards)

    def _paced_questions(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        if now_ns - self._asked_ns < _PACE_NS:
            return ()
        return self._questions(now_ns, [board for board in self._all if board.stopped])

    def _questions(self, now_ns: int, boards: Sequence[Board]) -> tuple[OutgoingFrame, ...]:
        """What is still unknown of a board, one question at a time; of a known one speeds and counts.

        And of one board in turn its errors or its serial timeout.
        """
        self._asked_ns = now_ns
        frames = []
        self._slow += 1
        turn, number = divmod(self._slow, len(self._all))
        for board in boards:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
            unknown = [name for name in TO_KNOW if name not in board.known]
            names = unknown[:1] or ["speeds", "encoders"]
            if not unknown and board is self._all[number]:
                names.append("serial_timeout" if turn % _TIMEOUT_EVERY == 0 else "status")
            frames += [question(board.address, name) for name in names]
        return tuple(OutgoingFrame(frame, now_ns + _QUESTION_LIFE_NS, _QUESTION_RANK) for frame in frames)

    def _arm(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """The serial timeout, set and read back, and zeros for as long as the motors stand."""
        self._permit = self._permit.begun(now_ns)
        if not self._stands:
            self._stop(self._permit.given_up("not armed: a motor turns; wait until it stands"))
            return self._brake(now_ns)
        wanted = self._settings.timeout_ds
        without = [board for board in self._all if board.timeout_ds != wanted]
        if without and self._permit.lasts_ns(now_ns) > ARMING_TIMEOUT_NS:
            why = f"not armed: board {without[0].address} does not take its serial timeout"
            self._stop(self._permit.given_up(why))
            return self._brake(now_ns)
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
        self._permit = self._permit.fed_zero(now_ns)
        if all(board.zeros >= ZEROS_TO_ARM for board in self._all):
            self._permit = self._permit.armed(now_ns)
        sent = parts.outgoing(now_ns, *self._velocity(now_ns))
        return (*sent, *self._questions(now_ns, self._all))

    def _ramp(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Slow down with the declared deceleration, then stop, then only ask."""
        self._permit = self._permit.slowed(now_ns, self._settings.stop_deceleration_rad_s2)
        if any(self._permit.speeds):
            return (*parts.outgoing(now_ns, *self._velocity(now_ns)), *self._questions(now_ns, self._all))
        self._stop(self._permit.ramped())
        return self._brake(now_ns)

    def _brake(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Zero duty for each board until it takes it, and before that no question, which would feed its timeout."""
        self._permit = self._permit.begun(now_ns)
        waiting = [board for board in self._all if not board.stopped]
        stood = self._is_known and (self._stands or self._permit.lasts_ns(now_ns) > BRAKING_NS)
        if not waiting and stood:
            self._permit = self._permit.rested()
        if now_ns - self._asked_ns < _PACE_NS:
            return ()
        for board in waiting:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
        return (*parts.outgoing(now_ns, *self._stops(waiting)), *self._paced_questions(now_ns))

    def _reset(self, now_ns: int) -> tuple[OutgoingFrame, ...]:
        """Clear what is latched here and an e-stop that a board has latched; it ends its other errors by itself."""
        self._permit = self._permit.reset(self._seen)
        latched = [board.address for board in self._all if board.is_pressed]
        if self._permit.wanted is not Request.RESET or not latched or now_ns - self._repeat_ns < _REPEAT_NS:
            return ()
        self._repeat_ns = now_ns
        return parts.outgoing(now_ns, *(setting(address, "reset_estop") for address in latched))

    def _velocity(self, now_ns: int) -> list[Frame]:
        settings, self._velocity_ns = self._settings, now_ns
        per_board = {address: [0.0, 0.0] for address in self._boards}
        fastest = self._fastest_rad_s
        for side, direction, speed in zip(settings.sides, settings.direction, self._permit.speeds, strict=True):
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

    def _heard(self, board: Board) -> None:
        board.waits_ns = None
        self._count("frames_accepted")

    def _take_acknowledgement(self, board: Board, frame: Frame, t_ns: int) -> None:
        name = _SETTER_NAMES.get(frame.can_id & 0xFF)
        if name is None or frame.data != protocol.ACKNOWLEDGE:
            self._count("unknown_id")
            return
        self._heard(board)
        if name == "duty_m1m2" and self._permit.stage is Stage.BRAKING:
            # A speed that waited behind the stop is sent after it: what is taken before that is gone is no stop yet.
            board.stopped = t_ns - self._velocity_ns > _LONGEST_LIFE_NS
        elif name == "speed_accel_m1m2":
            board.refuses_ns = None
            board.zeros += 1

    def _take_counts(self, board: Board, read: Mapping[str, protocol.Value], t_ns: int) -> None:
        if not board.take_counts(read, t_ns, self._permit.looked_ns):
            self._count("implausible_ticks")
            if self._permit.is_driving:
                self._stop(self._permit.lost(f"board {board.address} has restarted: its counts jumped"))

    def _sample(self, t_ns: int) -> WheelSample:
        settings = self._settings
        turned = [[self._boards[address].turned[motor] for address, motor in side] for side in settings.sides]
        return parts.wheel_sample(t_ns, turned, settings.direction, 1.0 / settings.counts_per_rad)

    def _check(self, now_ns: int) -> None:
        """Errors, silence, commands not taken and a timeout that is not the one set stop all."""
        self._permit = self._permit.looked(now_ns)
        for board in self._all:
            silent_ns = 0 if board.waits_ns is None else self._permit.silent_ns(board.waits_ns)
            why = self._why_lost(board, silent_ns) if self._permit.is_driving else None
            if why is not None:
                self._stop(self._permit.lost(why))
            elif not self._permit.is_driving and silent_ns > GONE_NS and board.known:
                why = f"board {board.address} fell silent"
                self._meet_anew(self._permit.restarted(why, f"{why}: asking anew"))

    def _why_lost(self, board: Board, silent_ns: int) -> str | None:
        refused_ns = 0 if board.refuses_ns is None else self._permit.silent_ns(board.refuses_ns)
        if board.errors:
            return board.error_words
        if silent_ns > SILENT_NS:
            return f"board {board.address} fell silent"
        if refused_ns > SILENT_NS:
            return f"board {board.address} does not take its commands"
        if self._permit.stage is Stage.ARMED and board.timeout_ds != self._settings.timeout_ds:
            return f"board {board.address} has restarted: its serial timeout is not the one that was set"
        return None

    def _status(self, t_ns: int) -> RobotStatus:
        at_rest = self._stands and all(board.stopped for board in self._all)
        return parts.status(t_ns, self.state, at_rest)

    def _stop(self, permit: MotionPermit) -> None:
        """Each board is to take a stop from now on."""
        self._permit, self._asked_ns = permit, 0
        for board in self._all:
            board.stopped, board.refuses_ns = False, None

    def _meet_anew(self, permit: MotionPermit) -> None:
        self._stop(permit)
        for board in self._all:
            board.meet_anew()

    def _count(self, name: str) -> None:
        self.stats = parts.counted(self.stats, name)


DRIVER = MotorDriver(
    "roboclaw",
    lambda settings, _key: RoboclawDriver(settings),
    settings=RoboclawSettings,
    example=protocol.EXAMPLE,
    kinds=("serial",),
    exchange=lambda _settings: RoboclawExchange(),
    recognise=protocol.recognise,
    questions=protocol.QUESTIONS,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=protocol.stop_confirmation,
    cyclic_frames=protocol.cyclic_frames,
    safety_card=protocol.safety_card,
)
