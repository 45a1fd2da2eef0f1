"""Sessions and arming: what the host asks of the robot's state machine, and when it may command the wheels."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from drivers import words
from drivers.types import Request
from firmware_protocol.e2e import challenge_answer

ARMING_TIMEOUT_NS = 1_500_000_000
SESSION_REFUSED_AFTER_NS = 300_000_000
_OPEN = ("READY", "ARMED")
_LATCHED = ("FAULT", "ESTOP")
_SESSIONS = 255


class HostState(msgspec.Struct, frozen=True, gc=False):
    """What HOST_STATE is to say."""

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
        self.wanted = Request.STANDBY
        self.session = 0
        self.sessions = 0
        self.note = ""
        self._last_session = 0
        self._session_since_ns = 0
        self._opened = False
        self._spent = False
        self._was_armed = False
        self._asked_ns: int | None = None
        self._robot_state = "BOOT"
        self._robot_session = 0
        self._reject_reason = "NONE"
        self._blockers: tuple[str, ...] = ()
        self._challenge = (0, 0)
        self._answer = challenge_answer(0, 0, dbc_hash)

    @property
    def armed(self) -> bool:
        """Whether the robot is armed in our session and is to stay so."""
        return self.wanted is Request.ARM and self._robot_state == "ARMED" and self._ours and not self._spent

    @property
    def needs_zeros(self) -> bool:
        """Whether the robot waits for zero commands before it arms."""
        return self.wanted is Request.ARM and self._robot_state == "READY" and self._ours and not self._spent

    @property
    def ready(self) -> bool:
        """Whether our session is open and nothing else is asked of it."""
        return self._robot_state == "READY" and self._ours and not self._spent

    @property
    def _ours(self) -> bool:
        return self.session != 0 and self._robot_session == self.session

    def request(self, request: Request) -> None:
        """Set what the host wants; only asking for ARM keeps an armed session."""
        if request is self.wanted:
            return
        if request is Request.ARM:
            self.note = ""
        elif self._opened and (self.wanted is Request.ARM or request is not Request.READY):
            self._spent = True
        self.wanted = request
        self._asked_ns = None
        self._was_armed = False

    def give_up(self, why: str) -> None:
        """End an arming or an armed session, with what `note` is to say."""
        self.note = why
        self._spent = self._opened
        self._set_standby()

    def reset(self, why: str) -> None:
        """Void everything agreed with the robot: the link or the robot is another one."""
        if self.wanted is Request.ARM:
            self.note = f"disarmed: {why}"
        self._void_session()
        self._set_standby()
        self._robot_state, self._robot_session = "BOOT", 0

    def take_status(self, state: str, session: int, stop_cause: str, reject_reason: str) -> None:
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
        elif self._was_armed or (self.wanted is Request.ARM and state in _LATCHED):
            self.give_up(f"the robot disarmed itself: {words.stop_cause(stop_cause)}" if self._was_armed else "")
        if self.wanted is Request.RESET and before in _LATCHED and state not in _LATCHED:
            self._set_standby()
            self.note = ""

    def take_session(self, challenge: int, session: int, blockers: tuple[str, ...], now_ns: int) -> None:
        """Take in SESSION_STATE; `blockers` by the names of the DBC's value table."""
        if self._challenge != (challenge, session):
            self._challenge = (challenge, session)
            self._answer = challenge_answer(challenge, session, self._dbc_hash)
        self._blockers = blockers
        refused = "SESSION" in blockers and self._robot_state == "STANDBY" and self.session != 0
        if refused and now_ns - self._session_since_ns > SESSION_REFUSED_AFTER_NS:
            # The robot has had this session before: it was opened and closed without our seeing it.
            self._void_session()

    def step(self, now_ns: int) -> None:
        """Give up an arming that takes too long, and choose a session where one is needed."""
        if self.wanted is Request.ARM and not self._was_armed:
            if self._asked_ns is None:
                self._asked_ns = now_ns
            elif now_ns - self._asked_ns > ARMING_TIMEOUT_NS:
                self.give_up(f"not armed within {ARMING_TIMEOUT_NS * 1e-9:g} s: {self._why_not()}")
        wanted = self.wanted in (Request.READY, Request.ARM)
        if wanted and self.session == 0 and self._robot_state in ("STANDBY", "READY"):
            self._choose_session(now_ns)

    def host_state(self) -> HostState:
        """Return what to tell the robot now."""
        if self._spent or self.wanted is Request.STANDBY:
            return HostState("STANDBY", self.session, 0)
        if self.wanted is Request.RESET:
            return HostState("RESET", self.session, 0)
        may_answer = self._ours and self._challenge[1] == self.session and self._robot_state in _OPEN
        if self.wanted is Request.ARM and may_answer:
            return HostState("ARM", self.session, self._answer)
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
        self.wanted = Request.STANDBY
        self._was_armed = False

    def _why_not(self) -> str:
        if self._blockers:
            reasons = ", ".join(words.blocker(name) for name in self._blockers)
            rejected = words.reject_reason(self._reject_reason)
            return f"{reasons} (last rejection: {rejected})" if rejected else reasons
        return words.reject_reason(self._reject_reason) or "the robot gave no reason"
