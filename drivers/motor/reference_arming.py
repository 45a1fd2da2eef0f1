"""The host's side of a session: handshake, arming, the cyclic frames, and the watch over an armed robot."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec

from drivers.motor.vendor_driver import ARMING_TIMEOUT_NS
from drivers.types import Identity, Limit, Limits, Request
from firmware_protocol import status_codes
from firmware_protocol.codec import Codec, Decoded
from firmware_protocol.protection import COUNTER_MODULUS, challenge_answer

# At 100 Hz more than two seconds: well above STATE_TIMEOUT_NS, at which the watch disarms anyway.
_REMEMBERED = 256
# Five periods of SYSTEM_STATE (0.1 s).
STATE_TIMEOUT_NS = 500_000_000
# Above the 100 ms after which the robot stops by itself, so that no pause of this host alone looks like a slow link.
DELAY_NS = 150_000_000


class ArmedWatch:
    """Monitor of commands and state while armed; pure, times in ns of the host's clock.

    Counters and the watchdog notice a frame that is missing and a pause; they do not notice commands that all come,
    each in its turn, later and later. So what was sent is compared with what the robot has taken. `delay_ns`: how long
    before the robot's last report the oldest command was sent that it had not taken, 0 for none. `late_commands`
    counts the times that commands were late, `silent` those that no state was received.
    """

    def __init__(self) -> None:
        self.late_commands = 0
        self.silent = 0
        self._waiting: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        self._last = 0
        self._last_when_reported = 0
        self.rest()

    def rest(self) -> None:
        """Expect nothing of what was sent so far, because nothing is commanded."""
        self._waiting.clear()
        self._accepted: int | None = None
        self._reported_ns: int | None = None
        self.delay_ns = 0

    def sent(self, number: int, now_ns: int) -> None:
        """Remember the command of this number since the driver was made; its counter is the number modulo 16."""
        self._waiting.append((number, now_ns))
        self._last = number

    def reported(self, last_command_counter: int, received_ns: int) -> None:
        """Take in SYSTEM_STATE, with the counter of the last command that the robot took.

        The counter has four bits: where sixteen commands or more were sent since the last report, the robot is taken
        to be as little behind as it can be.
        """
        self._reported_ns, self.delay_ns = received_ns, 0
        waiting = self._waiting
        if not waiting:
            return
        accepted = self._find_accepted(last_command_counter)
        if accepted >= waiting[0][0] or self._accepted is not None:
            self._accepted = accepted
        self._last_when_reported = self._last
        while waiting and waiting[0][0] <= accepted:
            waiting.popleft()
        if waiting:
            self.delay_ns = received_ns - waiting[0][1]

    def objection(self, now_ns: int) -> str | None:
        """Return why a robot that is armed must not stay so, None while all is well; counts each call that objects."""
        if self.delay_ns > DELAY_NS:
            self.late_commands += 1
            return (
                f"commands reach the robot over {self.delay_ns * 1e-9:.2f} s late; check the load of the link and "
                "of this computer"
            )
        if self._reported_ns is not None and now_ns - self._reported_ns > STATE_TIMEOUT_NS:
            self.silent += 1
            return (
                f"the robot has not sent its state for {STATE_TIMEOUT_NS * 1e-9:g} s; check the cable and the load "
                "of the link"
            )
        return None

    def _find_accepted(self, counter: int) -> int:
        """Return the number of the last accepted command, inferred from its counter."""
        last, before = self._last, self._accepted
        if before is not None and last - self._last_when_reported < COUNTER_MODULUS:
            accepted = before + (counter - before) % COUNTER_MODULUS
            if accepted <= last:
                return accepted
        return last - (last - counter) % COUNTER_MODULUS


# Three periods of SESSION_STATE (0.1 s): one that was sent before the session was chosen is no refusal.
SESSION_REFUSED_AFTER_NS = 300_000_000
_OPEN = ("READY", "ARMED")
_LATCHED = ("FAULT", "ESTOP")
# Eight bits in HOST_STATE, of which 0 is no session.
_SESSIONS = 255
MESSAGES = frozenset({"HELLO", "BUILD", "LIMITS"})
# Top bit of BUILD.board_id (firmware_protocol/README.md).
_VIRTUAL_BOARD = 0x8000
_AUTHENTICATION = Codec().choice_value("HELLO", "capabilities", "AUTHENTICATION")


class HostState(msgspec.Struct, frozen=True, gc=False):
    """Contents of the message HOST_STATE."""

    request: str
    session: int
    challenge_answer: int


class Arming:
    """Leads the robot from STANDBY to ARMED with a new session each time, and never again by itself.

    A session serves one arming: as soon as the robot has left READY or ARMED, or the host has asked for less, it is
    spent. ARM is consumed when the robot leaves ARMED, refuses to arm within 1.5 s, or has a fault or an emergency
    stop; RESET is consumed when the robot leaves FAULT or ESTOP.
    """

    def __init__(self, dbc_hash: int, draw_session: Callable[[], int]) -> None:
        """`draw_session` returns any non-negative integer, best at random."""
        self._dbc_hash = dbc_hash
        self._draw_session = draw_session
        self.target = Request.STANDBY
        self.session = 0
        self.sessions = 0
        self.note = ""
        self._last_session = 0
        self._session_since_ns = 0
        self._opened = False
        self._spent = False
        self._was_armed = False
        self._requested_ns: int | None = None
        self._robot_state = "BOOT"
        self._robot_session = 0
        self._reject_reason = "NONE"
        self._blockers: tuple[str, ...] = ()
        self._challenge = (0, 0)
        self._response = challenge_answer(0, 0, dbc_hash)

    @property
    def armed(self) -> bool:
        """Whether the robot is armed in our session and is to stay so."""
        return self.target is Request.ARM and self._robot_state == "ARMED" and self._ours and not self._spent

    @property
    def needs_zeros(self) -> bool:
        """Whether the robot waits for zero commands before it arms."""
        return self.target is Request.ARM and self._robot_state == "READY" and self._ours and not self._spent

    @property
    def ready(self) -> bool:
        """Whether the robot is READY in our session, and the session is not spent."""
        return self._robot_state == "READY" and self._ours and not self._spent

    @property
    def _ours(self) -> bool:
        return self.session != 0 and self._robot_session == self.session

    def request(self, request: Request) -> None:
        """Set what the host wants; only asking for ARM keeps an armed session."""
        if request is self.target:
            return
        if request is Request.ARM:
            self.note = ""
        elif self._opened and (self.target is Request.ARM or request is not Request.READY):
            self._spent = True
        self.target = request
        self._requested_ns = None
        self._was_armed = False

    def give_up(self, why: str) -> None:
        """End an arming or an armed session, with what `note` is to say."""
        self.note = why
        self._spent = self._opened
        self._set_standby()

    def reset(self, why: str) -> None:
        """Void everything agreed with the robot: the link or the robot is another one."""
        if self.target is Request.ARM:
            self.note = f"disarmed: {why}"
        self._void_session()
        self._set_standby()
        self._robot_state, self._robot_session = "BOOT", 0

    def handle_status(self, state: str, session: int, stop_cause: str, reject_reason: str) -> None:
        """Take in SYSTEM_STATE, by the names of the DBC's value tables."""
        before, self._robot_state = self._robot_state, state
        self._robot_session = session
        self._reject_reason = reject_reason
        if self._ours and state in _OPEN:
            self._opened = True
        elif self._opened:
            self._void_session()
        if self.armed:
            self._was_armed = True
        elif self._was_armed or (self.target is Request.ARM and state in _LATCHED):
            self.give_up(f"the robot disarmed itself: {status_codes.stop_cause(stop_cause)}" if self._was_armed else "")
        if self.target is Request.RESET and before in _LATCHED and state not in _LATCHED:
            self._set_standby()
            self.note = ""

    def handle_session(self, challenge: int, session: int, blockers: tuple[str, ...], now_ns: int) -> None:
        """Handle the message SESSION_STATE; `blockers` by the names of the DBC's value table."""
        if self._challenge != (challenge, session):
            self._challenge = (challenge, session)
            self._response = challenge_answer(challenge, session, self._dbc_hash)
        self._blockers = blockers
        refused = "SESSION" in blockers and self._robot_state == "STANDBY" and self.session != 0
        if refused and now_ns - self._session_since_ns > SESSION_REFUSED_AFTER_NS:
            # The robot has had this session before: it was opened and closed without our seeing it.
            self._void_session()

    def step(self, now_ns: int) -> None:
        """Give up an arming that takes too long, and choose a session where one is needed."""
        if self.target is Request.ARM and not self._was_armed:
            if self._requested_ns is None:
                self._requested_ns = now_ns
            elif now_ns - self._requested_ns > ARMING_TIMEOUT_NS:
                self.give_up(f"the robot did not arm within {ARMING_TIMEOUT_NS * 1e-9:g} s: {self._why_not()}")
        is_arming = self.target in (Request.READY, Request.ARM)
        if is_arming and self.session == 0 and self._robot_state in ("STANDBY", "READY"):
            self._choose_session(now_ns)

    def host_state(self) -> HostState:
        """Return the fields of HOST_STATE to send now."""
        if self._spent or self.target is Request.STANDBY:
            return HostState("STANDBY", self.session, 0)
        if self.target is Request.RESET:
            return HostState("RESET", self.session, 0)
        may_respond = self._ours and self._challenge[1] == self.session and self._robot_state in _OPEN
        if self.target is Request.ARM and may_respond:
            return HostState("ARM", self.session, self._response)
        return HostState("READY", self.session, 0)

    def _choose_session(self, now_ns: int) -> None:
        session = 1 + self._draw_session() % _SESSIONS
        while session in (self._last_session, self._robot_session):
            session = session % _SESSIONS + 1
        self.session = self._last_session = session
        self._session_since_ns = now_ns
        self.sessions += 1

    def _void_session(self) -> None:
        self.session = 0
        self._opened = self._spent = False

    def _set_standby(self) -> None:
        self.target = Request.STANDBY
        self._was_armed = False

    def _why_not(self) -> str:
        if self._blockers:
            reasons = ", ".join(status_codes.blocker(name) for name in self._blockers)
            rejected = status_codes.reject_reason(self._reject_reason)
            return f"{reasons} (last rejection: {rejected})" if rejected else reasons
        return status_codes.reject_reason(self._reject_reason) or "the robot gave no reason"


class Handshake:
    """Gathers HELLO, BUILD and both pages of LIMITS, and judges them.

    Another major version is refused. The same major version with another DBC hash may be read, but never armed.
    `refusal` says why the robot must not be armed and what to do about it, None if nothing speaks against it so far;
    `identity` and `limits` are what the robot said of itself, None until all of it has come or if its limits make no
    sense.
    """

    def __init__(self, major: int, minor: int, dbc_hash: int, *, has_key: bool = False) -> None:
        """Create a handshake that expects this protocol; `has_key`: whether this host authenticates its commands."""
        self._has_key = has_key
        self._major = major
        self._minor = minor
        self._dbc_hash = dbc_hash
        self._hello: dict[str, float] | None = None
        self._build: dict[str, float] | None = None
        self._pages: dict[int, dict[str, float]] = {}
        self.refusal: str | None = None
        self.identity: Identity | None = None
        self.limits: Limits | None = None

    def handle(self, decoded: Decoded) -> None:
        """Take in a frame of one of `MESSAGES`."""
        match decoded.name:
            case "HELLO":
                self._hello = decoded.values
            case "BUILD":
                self._build = decoded.values
            case _:
                self._pages[int(decoded.values["page"])] = decoded.values
        self.refusal = self._fault()
        self._gather()

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the messages that have not come yet."""
        names = {"HELLO": self._hello, "BUILD": self._build, "LIMITS": len(self._pages) == 2 or None}
        return tuple(name for name, value in names.items() if value is None)

    def _fault(self) -> str | None:
        if self._hello is not None and int(self._hello["protocol_major"]) != self._major:
            theirs = f"{int(self._hello['protocol_major'])}.{int(self._hello['protocol_minor'])}"
            return (
                f"the robot speaks protocol {theirs}, this host {self._major}.{self._minor}; "
                f"flash the firmware that matches this host, or install the host that matches the firmware"
            )
        if self._build is not None and int(self._build["dbc_hash"]) != self._dbc_hash:
            return (
                f"the robot's DBC hash is {int(self._build['dbc_hash']):08x}, this host's {self._dbc_hash:08x}: the "
                "robot can be read but not driven; flash the firmware built from this host's disco_robot.dbc, or "
                "install the host that matches the firmware"
            )
        if self._hello is not None and bool(int(self._hello["capabilities"]) & _AUTHENTICATION) != self._has_key:
            if self._has_key:
                return (
                    "the robot accepts commands without authentication, but this host has a key: put the key into "
                    "the robot's firmware, or remove link.key_file from robot.toml"
                )
            return (
                "the robot accepts authenticated commands only: in robot.toml set link.key_file to the file with "
                "the robot's key"
            )
        if len(self._pages) == 2 and not self._limits_are_valid():
            return "the robot reports limits that are not above zero; correct its configuration"
        return None

    def _gather(self) -> None:
        """Set `identity` and `limits`; None while messages are missing or limits are invalid."""
        hello, build = self._hello, self._build
        if hello is None or build is None or self.missing or not self._limits_are_valid():
            self.identity = self.limits = None
            return
        speed, times = self._pages[0], self._pages[1]
        protocol = f"{int(hello['protocol_major'])}.{int(hello['protocol_minor'])}"
        self.identity = Identity(
            "reference controller",
            ".".join(str(int(hello[f"firmware_{part}"])) for part in ("major", "minor", "patch")),
            "device",
            f"{_board(int(build['board_id']))}, protocol {protocol}, DBC {int(build['dbc_hash']):08x}",
        )
        self.limits = Limits(
            max_wheel_speed_rad_s=Limit(speed["max_wheel_speed"], "device"),
            command_timeout_s=Limit(times["command_timeout"], "device"),
            stop_deceleration_rad_s2=Limit(times["stop_deceleration"], "device"),
            max_wheel_acceleration_rad_s2=Limit(speed["max_wheel_acceleration"], "device"),
            ticks_per_rev=Limit(speed["ticks_per_rev"], "device"),
            drive_off_timeout_s=Limit(times["drive_off_timeout"], "device"),
        )

    def _limits_are_valid(self) -> bool:
        values = {name: value for page in self._pages.values() for name, value in page.items() if name != "page"}
        return all(value > 0 for value in values.values())


def _board(board_id: int) -> str:
    """Describe a board by its number, whose top bit marks simulated wheels."""
    number = board_id & ~_VIRTUAL_BOARD
    return f"board {number}" if number == board_id else f"board {number} with VIRTUAL wheels"
