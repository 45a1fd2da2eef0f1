"""Watches an armed robot: it must send its state at least every half second, and take commands in time."""

from __future__ import annotations

from collections import deque

from firmware_protocol.e2e import COUNTER_MODULUS

_REMEMBERED = 256
STATE_TIMEOUT_NS = 500_000_000
# Above the 100 ms after which the robot stops by itself, so that no pause of this host alone looks like a slow link.
LATE_NS = 150_000_000


class ArmedWatch:
    """Watches both; pure. `late` counts the times that commands were late, `silent` those without the state."""

    def __init__(self) -> None:
        self.late = 0
        self.silent = 0
        self._echo = CommandEcho()
        self._reported_ns: int | None = None
        self._late_ns = 0

    def sent(self, number: int, now_ns: int) -> None:
        """Remember a wheel command, by its number since the driver was made."""
        self._echo.sent(number, now_ns)

    def rest(self) -> None:
        """Nothing is commanded: expect nothing."""
        self._echo.forget()
        self._reported_ns = None
        self._late_ns = 0

    def reported(self, last_command_counter: int, received_ns: int) -> None:
        """Take in SYSTEM_STATE."""
        self._reported_ns = received_ns
        self._late_ns = self._echo.late_ns(last_command_counter, received_ns)

    def objection(self, now_ns: int) -> str | None:
        """Return why a robot that is armed must not stay so, None while all is well; counts each call that objects."""
        if self._late_ns > LATE_NS:
            self.late += 1
            return f"commands reach the robot over {self._late_ns * 1e-9:.2f} s late; see what holds up the link"
        if self._reported_ns is not None and now_ns - self._reported_ns > STATE_TIMEOUT_NS:
            self.silent += 1
            return f"the robot has not sent its state for {STATE_TIMEOUT_NS * 1e-9:g} s"
        return None


class CommandEcho:
    """Compares what was sent with what the robot has taken.

    Counters and the watchdog notice a frame that is missing and a pause; they do not notice commands that all come,
    each in its turn, later and later. Pure; times in ns of the host's clock.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        self._last = 0
        self._last_when_reported = 0
        self._taken: int | None = None

    def sent(self, number: int, now_ns: int) -> None:
        """Remember the command of this number, whose frame has the number modulo 16 as its counter."""
        self._waiting.append((number, now_ns))
        self._last = number

    def forget(self) -> None:
        """Expect no more of what was sent so far."""
        self._waiting.clear()
        self._taken = None

    def late_ns(self, counter: int, received_ns: int) -> int:
        """Return how long before `received_ns` the oldest command was sent that the robot had not taken; 0 for none.

        `counter` is that of the last command it took. It has four bits: where sixteen commands or more were sent since
        the last report, the robot is taken to be as little behind as it can be.
        """
        waiting = self._waiting
        if not waiting:
            return 0
        taken = self._find_taken(counter)
        if taken >= waiting[0][0] or self._taken is not None:
            self._taken = taken
        self._last_when_reported = self._last
        while waiting and waiting[0][0] <= taken:
            waiting.popleft()
        return received_ns - waiting[0][1] if waiting else 0

    def _find_taken(self, counter: int) -> int:
        last, before = self._last, self._taken
        if before is not None and last - self._last_when_reported < COUNTER_MODULUS:
            taken = before + (counter - before) % COUNTER_MODULUS
            if taken <= last:
                return taken
        return last - (last - counter) % COUNTER_MODULUS
