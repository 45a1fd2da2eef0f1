"""The driver of RoboClaw boards on packet serial, one or two.

A board knows no armed state: the first speed that it is sent moves it, and every packet, a question too, feeds its
serial timeout. So nothing is asked of a board before it has taken a stop, and nothing is asked while it is armed
without a command. Armed is what this driver says it is: each board has its timeout, no error, and took zeros.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from drivers.motor import roboclaw_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.permit import Controllers, MotionPermit, Stage
from drivers.motor.roboclaw_protocol import (
    RoboclawExchange,
    RoboclawSettings,
    query,
    setting,
    stop_frames,
)
from drivers.motor.vendor_driver import (
    BRAKING_NS,
    IMPLAUSIBLE,
    UNKNOWN,
    FrameReport,
    Objection,
    Pending,
    Port,
    Source,
    Table,
    VendorDriver,
    stop_confirmation,
)
from drivers.types import (
    Frame,
    Identity,
    Limit,
    Limits,
    MotorDriver,
    OutgoingFrame,
    ReceivedFrame,
    Request,
    WheelSample,
)

# User manual, status: the e-stop input, and the bits of errors, above which those of warnings begin.
_ESTOP, _ERRORS = 0x1, 0xFFFF
_PRESSED = "its e-stop input is or was pressed; if reset does not help, switch the board off and on"
_ERROR_TEXTS = {
    0x2: "it is too hot",
    0x4: "it is too hot",
    0x8: "the main supply's voltage is too high",
    0x10: "the logic supply's voltage is too high",
    0x20: "the logic supply's voltage is too low",
    0x40: "the power stage of motor 1 failed",
    0x80: "the power stage of motor 2 failed",
    0x100: "motor 1 does not reach its speed",
    0x200: "motor 2 does not reach its speed",
    0x1000: "motor 1 draws too much current",
    0x2000: "motor 2 draws too much current",
    0x4000: "the main supply's voltage is too low",
    0x8000: "the main supply's voltage is too high",
}
TO_KNOW = ("version", "velocity_pid_m1", "velocity_pid_m2", "status", "serial_timeout", "encoders")


DUTY_ACCELS = "default_duty_accels"
"""Asked for before arming; not every board knows the question."""
# Chosen: so many answers in a row are not lost.
_DUTY_ACCELS_TRIES = 5
# Full duty, and Chosen: the shortest serial timeout; an e-stop, zero duty, may take no longer than a silent host.
_FULL_DUTY, _LONGEST_RAMP_S = 32767.0, 0.1

# Chosen: below any motion that could matter.
_STATIONARY_RAD_S = 0.1
# Chosen: with a coarse encoder of 1000 counts a turn, three counts at that speed. One count a motor may tremble.
_STANDING_NS, _TREMBLES_COUNTS = 200_000_000, 1.0
# Chosen: a little under two replies at 50 Hz, as one count more or less in one is 50 counts/s.
_SPEED_NS = 35_000_000
# As many as the reference controller asks for (firmware/command.c).
ZEROS_TO_ARM = 5
# Chosen: five replies at 50 Hz; gone when a board could have been switched off and on.
SILENT_NS, GONE_NS = 100_000_000, 500_000_000
# A little under the 20 ms of a tick at 50 Hz, so that a tick that comes early is not left out.
_PACE_NS = 18_000_000
# A tick: a question that waited for longer would hold up the commands of the next one.
_QUERY_LIFE_NS = 20_000_000
# After e-stop and commands.
_QUERY_RANK = 2
# Longer than a command may wait to be sent: half of its validity, which is 0.1 s at most.
_LONGEST_LIFE_NS = 60_000_000
_TIMEOUT_EVERY = 8
"""Of the slow questions every so many is for the serial timeout, the others for the errors."""
_SETTER_NAMES = {layout.command: name for name, layout in protocol.SETTERS.items()}


@dataclass(slots=True)
class Board:
    """State of one board: newest reply to each question in `known`, and the odometers of both motors in `turned`.

    `counted`: time and both counts of each reply of the last `_STANDING_NS`, and of one before. The speeds are taken
    from them, as the board's own is that of the last 1/300 s, in steps of 300 counts/s.

    `stopped`: it has taken a stop since the last command. `timeout_ds`: its serial timeout in steps of 0.1 s, as read
    since arming began. `requested_accels`: how often it was asked for them. `waits_ns`: since when it has not answered,
    `refuses_ns` since when it has taken no command.
    """

    address: int
    known: dict[str, Mapping[str, protocol.Value]] = field(default_factory=dict)
    turned: tuple[parts.Odometer, parts.Odometer] = field(default_factory=lambda: (parts.Odometer(), parts.Odometer()))
    counted: deque[tuple[int, int, int]] = field(default_factory=deque)
    stopped: bool = False
    zeros: int = 0
    timeout_ds: int | None = None
    requested_accels: int = 0
    waits_ns: int | None = None
    refuses_ns: int | None = None

    @property
    def errors(self) -> int:
        """The bits of its status that are no warnings."""
        return int(self.known["status"]["status_u32"]) & _ERRORS if "status" in self.known else 0

    @property
    def fastest_counts_s(self) -> float:
        """Speed (counts/s) that both motors reach at full duty."""
        return float(min(int(self.known[f"velocity_pid_m{motor}"]["qpps"]) for motor in (1, 2)))

    @property
    def is_known(self) -> bool:
        """Whether every reply needed before arming has been read, and for long enough whether the motors stand."""
        return not self.unknown and self.is_counted_long

    @property
    def is_counted_long(self) -> bool:
        """Whether the counts of a time are known in which a motor that turns is seen to."""
        return bool(self.counted) and self.counted[-1][0] - self.counted[0][0] >= _STANDING_NS

    @property
    def unknown(self) -> list[str]:
        """Names of the replies that have not been read yet; of the accelerations it may know nothing."""
        names = TO_KNOW if self.requested_accels >= _DUTY_ACCELS_TRIES else (*TO_KNOW, DUTY_ACCELS)
        return [name for name in names if name not in self.known]

    @property
    def slow_stop(self) -> str | None:
        """Text on why zero duty would stop its motors too slowly, and what to set; None if it would not."""
        decels = self.known.get(DUTY_ACCELS, {}).values()
        ramp_s = max((_FULL_DUTY / max(float(decel), 1.0) for decel in decels), default=0.0)
        if ramp_s <= _LONGEST_RAMP_S:
            return None
        return (
            f"board {self.address}: its e-stop takes {ramp_s:.3g} s from full duty; set Default Accel to 655359 "
            "(Motion Studio), for both motors"
        )

    @property
    def is_pressed(self) -> bool:
        """Whether its e-stop input is, or was and is latched."""
        return bool(self.errors & _ESTOP)

    @property
    def error_text(self) -> str:
        """Text of the board's first error, for the operator."""
        if self.is_pressed:
            return f"board {self.address}: its e-stop input is or was pressed"
        bit = self.errors & -self.errors
        return f"board {self.address}: {_ERROR_TEXTS.get(bit, f'error {self.errors:#06x}')}"

    def is_stationary(self, fastest_counts_s: float) -> bool:
        """Whether both motors have been slower than this for long enough to tell."""
        if not self.is_counted_long:
            return False
        newest, *before = reversed(self.counted)
        allowed = max(_TREMBLES_COUNTS, fastest_counts_s * 1e-9 * (newest[0] - before[-1][0]))
        return all(abs(_turned(motor, newest, each)) <= allowed for each in before for motor in (1, 2))

    def handle_counts(self, read: Mapping[str, protocol.Value], t_ns: int, looked_ns: int) -> bool:
        """Update speeds and odometers from encoder counts; return False if the motors cannot have turned that far."""
        newest = (t_ns, int(read["encoder_m1"]), int(read["encoder_m2"]))
        self.counted.append(newest)
        while len(self.counted) > 2 and t_ns - self.counted[1][0] >= _STANDING_NS:
            self.counted.popleft()
        before = next((each for each in reversed(self.counted) if t_ns - each[0] >= _SPEED_NS), None)
        for motor, turned in enumerate(self.turned, 1):
            turned.speed = 0.0 if before is None else _turned(motor, newest, before) / (1e-9 * (t_ns - before[0]))
        if not {"velocity_pid_m1", "velocity_pid_m2"} <= self.known.keys():
            return True
        fastest = 1.5 * self.fastest_counts_s
        plausible = [
            turned.add_wrapping(count, t_ns, looked_ns, fastest, 100.0)
            for turned, count in zip(self.turned, newest[1:], strict=True)
        ]
        return all(plausible)

    def reset_state(self) -> None:
        """Clear the board's replies, as for a new connection; the angles that its motors have turned are kept."""
        self.known, self.waits_ns, self.timeout_ds, self.requested_accels = {}, None, None, 0
        self.counted.clear()
        for motor in self.turned:
            motor.reset_state()


class _RoboclawPort(Port):
    """Port of `VendorDriver` for RoboClaw boards."""

    def __init__(self, settings: RoboclawSettings) -> None:
        self._settings = settings
        # They have no armed state to fall out of, and whatever ends a drive must have taken a stop.
        self.table = Table(
            stop_deceleration_rad_s2=settings.stop_deceleration_rad_s2,
            watchdog_s=settings.watchdog_s,
            idle=Stage.BRAKING,
            after_loss=Stage.BRAKING,
        )
        self._boards = {address: Board(address) for address in settings.addresses}
        self._velocity_ns = self._requested_ns = 0
        self._slow = 0

    @property
    def seen(self) -> Controllers:
        silent = ", ".join(str(board.address) for board in self._all if not board.is_known)
        missing = (
            f"board {silent} does not answer; check that it is switched on, in packet serial, at this baud and address"
        )
        pressed = any(board.is_pressed for board in self._all)
        return Controllers(
            missing=missing if silent else None,
            refused=next(filter(None, (board.slow_stop for board in self._all)), None),
            stopped=_PRESSED if pressed else None,
            faulty="; ".join(board.error_text for board in self._all if board.errors) or None,
        )

    @property
    def identity(self) -> Identity | None:
        """Identity that the first board reports; None before all boards are known."""
        if not self._is_known or self.seen.refused is not None:
            return None
        return Identity("RoboClaw", str(self._all[0].known["version"]["version"]).strip(), "device")

    @property
    def limits(self) -> Limits:
        """The slowest board's fastest speed, and the serial time-out that is set before each arming and read back."""
        return parts.limits(
            Limit(self._fastest_rad_s, "device"),
            Limit(self._settings.watchdog_s, "device"),
            self.table.stop_deceleration_rad_s2,
        )

    @property
    def is_stopped(self) -> bool:
        """Whether every board has taken a stop, and its motors stand."""
        return all(board.stopped for board in self._all) and self._is_stationary

    def reset_state(self, now_ns: int) -> None:
        for board in self._all:
            board.reset_state()

    def end_drive(self) -> None:
        """Make each board take a stop from now on."""
        self._requested_ns = 0
        for board in self._all:
            board.stopped, board.refuses_ns = False, None

    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        frame, t_ns = received.frame, received.t_ns
        address, command = divmod(frame.can_id, 256)
        board = self._boards.get(address)
        if board is None or frame.extended:
            return UNKNOWN
        name = protocol.getter_name(command)
        if name is None:
            return self._handle_acknowledgement(board, frame, t_ns, permit.stage)
        read = protocol.reply(address, name, frame.data)
        if read is None:
            return FrameReport(counts=("rejected_crc",))
        board.waits_ns = None
        plausible = name != "encoders" or board.handle_counts(read[0], t_ns, permit.looked_ns)
        board.known[name] = read[0]
        if name == "serial_timeout":
            board.timeout_ds = int(read[0]["timeout_ds"])
        is_status = name == "encoders" and self._is_known
        is_new = is_status and all(each.is_new for one in self._all for each in one.turned)
        wheels = self._sample(t_ns) if is_new else None
        if plausible:
            return FrameReport(is_status=is_status, wheels=wheels)
        jumped = f"board {address} has restarted: its counts jumped"
        return FrameReport(counts=IMPLAUSIBLE, is_status=is_status, wheels=wheels, lost=jumped)

    def sources(self) -> Sequence[Source]:
        return [
            Source(f"board {board.address}", board.waits_ns if board.known else None, SILENT_NS, GONE_NS)
            for board in self._all
        ]

    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return why driving must end: a board error, unacknowledged commands, or a wrong serial timeout."""
        for board in self._all:
            refused_ns = 0 if board.refuses_ns is None else permit.silent_ns(board.refuses_ns)
            if board.errors:
                return Objection(board.error_text)
            if refused_ns > SILENT_NS:
                return Objection(f"board {board.address} does not accept its commands")
            if permit.stage is Stage.ARMED and board.timeout_ds != self._settings.timeout_ds:
                why = "its serial timeout differs from the one that was set"
                return Objection(f"board {board.address} has restarted: {why}")
        return None

    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """Return what arming still needs: the serial timeout, set and read back, then zeros that each board takes."""
        if permit.lasts_ns(now_ns) == 0:
            self._repeat_ns = 0
            for board in self._all:
                # A board that has restarted since has forgotten its timeout.
                board.zeros, board.stopped, board.timeout_ds = 0, False, None
        if not self._is_stationary:
            return Pending(why="a motor is turning; wait until it stands still", is_final=True)
        configured = self._settings.timeout_ds
        without = [board.address for board in self._all if board.timeout_ds != configured]
        if without:
            why = f"board {without[0]} does not accept its serial timeout"
            if not self._is_due(now_ns):
                return Pending(why=why)
            sets = (setting(address, "set_serial_timeout", timeout_ds=configured) for address in without)
            questions = (query(address, "serial_timeout") for address in without)
            return Pending(why=why, frames=tuple(frame for pair in zip(sets, questions, strict=True) for frame in pair))
        if all(board.zeros >= ZEROS_TO_ARM for board in self._all):
            return None
        return Pending(why="a board does not accept commands of zero", frames=tuple(self.speeds(now_ns, 0.0, 0.0)))

    def speeds(self, now_ns: int, left_rad_s: float, right_rad_s: float) -> Sequence[Frame]:
        settings, self._velocity_ns = self._settings, now_ns
        per_board = {address: [0.0, 0.0] for address in self._boards}
        fastest, commanded = self._fastest_rad_s, (left_rad_s, right_rad_s)
        for side, direction, speed in zip(settings.sides, settings.direction, commanded, strict=True):
            for address, motor in side:
                per_board[address][motor] = direction * min(max(speed, -fastest), fastest) * settings.counts_per_rad
        accel = max(1, round(settings.acceleration_rad_s2 * settings.counts_per_rad))
        frames = []
        for board in self._all:
            board.refuses_ns = now_ns if board.refuses_ns is None else board.refuses_ns
            board.stopped = False
            first, second = map(round, per_board[board.address])
            speeds = {"speed_m1_counts_s": first, "speed_m2_counts_s": second}
            frames.append(setting(board.address, "speed_accel_m1m2", accel_counts_s2=accel, **speeds))
        return frames

    def brake(self, now_ns: int, lasts_ns: int) -> tuple[Sequence[Frame], bool]:
        """Return zero duty for each board that has not acknowledged a stop, and whether braking is over."""
        waiting = [board for board in self._all if not board.stopped]
        is_over = not waiting and self._is_known and (self._is_stationary or lasts_ns > BRAKING_NS)
        if now_ns - self._requested_ns < _PACE_NS:
            return (), is_over
        for board in waiting:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
        return [_stop(board.address) for board in waiting], is_over

    def rest(self, now_ns: int, permit: MotionPermit) -> Sequence[Frame]:
        """Reset an e-stop that a board has latched, when requested; it ends its other errors by itself."""
        latched = [board.address for board in self._all if board.is_pressed]
        if permit.target is not Request.RESET or not latched or not self._is_due(now_ns):
            return ()
        return [setting(address, "reset_estop") for address in latched]

    def questions(self, now_ns: int, permit: MotionPermit) -> tuple[OutgoingFrame, ...]:
        """Return the questions to boards with a command in this tick, or, more slowly, to boards that are stopped.

        What is still unknown of a board, one question at a time; of a known one its counts, and of one board in turn
        its errors or its serial timeout.
        """
        boards = self._all
        if permit.stage in (Stage.REST, Stage.BRAKING):
            if now_ns - self._requested_ns < _PACE_NS:
                return ()
            boards = [board for board in self._all if board.stopped]
        elif self._velocity_ns != now_ns:
            return ()
        self._requested_ns = now_ns
        frames = []
        self._slow += 1
        turn, number = divmod(self._slow, len(self._all))
        for board in boards:
            board.waits_ns = now_ns if board.waits_ns is None else board.waits_ns
            unknown = board.unknown
            names = unknown[:1] or ["encoders"]
            board.requested_accels += DUTY_ACCELS in names
            if not unknown and board is self._all[number]:
                names.append("serial_timeout" if turn % _TIMEOUT_EVERY == 0 else "status")
            frames += [query(board.address, name) for name in names]
        return tuple(OutgoingFrame(frame, now_ns + _QUERY_LIFE_NS, _QUERY_RANK) for frame in frames)

    def stop_frames(self) -> tuple[Frame, ...]:
        return tuple(_stop(board.address) for board in self._all)

    @property
    def _all(self) -> Sequence[Board]:
        """All boards, in the order of the settings."""
        return tuple(self._boards.values())

    @property
    def _is_known(self) -> bool:
        return all(board.is_known for board in self._all)

    @property
    def _is_stationary(self) -> bool:
        fastest = _STATIONARY_RAD_S * self._settings.counts_per_rad
        return all(board.is_stationary(fastest) for board in self._all)

    @property
    def _fastest_rad_s(self) -> float:
        return min(board.fastest_counts_s for board in self._all) / self._settings.counts_per_rad

    def _handle_acknowledgement(self, board: Board, frame: Frame, t_ns: int, stage: Stage) -> FrameReport:
        """Take in the acknowledgement of a stop, which counts only while braking, or of a speed command."""
        name = _SETTER_NAMES.get(frame.can_id & 0xFF)
        if name is None or frame.data != protocol.ACKNOWLEDGE:
            return UNKNOWN
        board.waits_ns = None
        if name == "duty_m1m2" and stage is Stage.BRAKING:
            # A speed that waited behind the stop is sent after it: what is taken before that is gone is no stop yet.
            board.stopped = t_ns - self._velocity_ns > _LONGEST_LIFE_NS
        elif name == "speed_accel_m1m2":
            board.refuses_ns = None
            board.zeros += 1
        return FrameReport()

    def _sample(self, t_ns: int) -> WheelSample:
        settings = self._settings
        turned = [[self._boards[address].turned[motor] for address, motor in side] for side in settings.sides]
        return parts.wheel_sample(t_ns, turned, settings.direction, 1.0 / settings.counts_per_rad)


def _turned(motor: int, newest: Sequence[int], before: Sequence[int]) -> int:
    """Return by how much a motor was counted between two entries of `Board.counted`; counts wrap at 2^32."""
    return (newest[motor] - before[motor] + 2**31) % 2**32 - 2**31


def _stop(address: int) -> Frame:
    return setting(address, "duty_m1m2", duty_m1=0, duty_m2=0)


DRIVER = MotorDriver(
    "roboclaw",
    lambda settings, _key: VendorDriver(_RoboclawPort(settings)),
    settings=RoboclawSettings,
    example=protocol.EXAMPLE,
    kinds=("serial",),
    exchange=lambda _settings: RoboclawExchange(),
    recognise=protocol.recognise,
    questions=protocol.QUESTIONS,
    latches_stop=False,
    stop_frames=stop_frames,
    stop_confirmation=lambda settings: stop_confirmation(_RoboclawPort(settings)),
    cyclic_frames=protocol.cyclic_frames,
    safety_card=protocol.safety_card,
)
