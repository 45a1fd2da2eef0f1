"""Tells a frame of one's own that comes back from one that somebody else has sent."""

from __future__ import annotations

import threading
from collections import deque

from drivers.types import Frame

ECHO_NS = 1_000_000_000


class OwnFrames:
    """For buses that hand a sender its own frames; a sending and a receiving thread may use it at once.

    Each frame sent excuses one equal frame received within a second. So a second host is seen even if it sends the
    same: of two equal frames only one is excused.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: deque[tuple[int, Frame]] = deque()

    def sent(self, now_ns: int, frame: Frame) -> None:
        """Note a frame, before it is handed to the bus: its echo can be faster than the call that sends it."""
        with self._lock:
            self._forget(now_ns)
            self._sent.append((now_ns, frame))

    def not_sent(self, frame: Frame) -> None:
        """Take back the newest note of a frame that the bus did not take."""
        with self._lock:
            for index in range(len(self._sent) - 1, -1, -1):
                if self._sent[index][1] == frame:
                    del self._sent[index]
                    return

    def is_echo(self, now_ns: int, frame: Frame) -> bool:
        """Tell whether a received frame is one's own; each note counts once."""
        with self._lock:
            self._forget(now_ns)
            for index, (_, sent) in enumerate(self._sent):
                if sent == frame:
                    del self._sent[index]
                    return True
        return False

    def _forget(self, now_ns: int) -> None:
        while self._sent and now_ns - self._sent[0][0] > ECHO_NS:
            self._sent.popleft()
