"""How late the robot is with our commands, by the counter of the last one it took, which its telemetry gives back."""

from __future__ import annotations

from collections import deque

from firmware_protocol.e2e import COUNTER_MODULUS

_REMEMBERED = 256


class CommandEcho:
    """Compares what was sent with what the robot has taken.

    Counters and the watchdog notice a frame that is missing and a pause; they do not notice commands that all come,
    each in its turn, later and later. Pure; times in ns of the host's clock.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        self._last = 0
        self._last_when_told = 0
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
        it was last told, the robot is taken to be as little behind as it can be.
        """
        waiting = self._waiting
        if not waiting:
            return 0
        taken = self._find_taken(counter)
        if taken >= waiting[0][0] or self._taken is not None:
            self._taken = taken
        self._last_when_told = self._last
        while waiting and waiting[0][0] <= taken:
            waiting.popleft()
        return received_ns - waiting[0][1] if waiting else 0

    def _find_taken(self, counter: int) -> int:
        last, before = self._last, self._taken
        if before is not None and last - self._last_when_told < COUNTER_MODULUS:
            taken = before + (counter - before) % COUNTER_MODULUS
            if taken <= last:
                return taken
        return last - (last - counter) % COUNTER_MODULUS
