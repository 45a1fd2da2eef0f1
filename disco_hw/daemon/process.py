"""The daemon as a process: signals that ask it to stop, a service manager that watches it, a terminal that may be slow.

A handler only notes the signal; the loop acts on it before its next tick. Protocol of the service manager: the manual
pages sd_notify(3) and sd_watchdog_enabled(3); nothing is sent where there is none. What is
printed goes through a thread of its own.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import socket
import threading
from collections.abc import Callable, Mapping
from types import FrameType, TracebackType
from typing import Any

from disco_hw.runtime import State

# A terminal that closes must not end the process before it has stopped the wheels, hence SIGHUP.
_STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MAY_STAY_IGNORED = signal.SIGHUP


class StopSignals:
    """Catches the signals while entered, in the main thread; the former handlers come back on exit.

    To be entered around the stop path too: the second signal of somebody impatient must not break it off. SIGHUP stays
    ignored where it was, as by nohup; SIGINT does not: a shell has it ignored in what a script starts with `&`, and
    whoever presses Ctrl-C wants the robot to stop.
    """

    def __init__(self) -> None:
        self._former: dict[signal.Signals, Any] = {}
        self.received: signal.Signals | None = None
        """The first signal that came, or None."""

    def __enter__(self) -> StopSignals:
        for number in _STOP_SIGNALS:
            if number is not _MAY_STAY_IGNORED or signal.getsignal(number) is not signal.SIG_IGN:
                self._former[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._former.items():
            # A handler that was not set from Python is known as None only and cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._former.clear()

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.received is None:
            self.received = signal.Signals(number)


class StopPath:
    """Steps to stop with, each in a guard of its own; what was added last runs first, so the wheels are added last.

    A step must not wait for ever: its guard holds exceptions, not time.
    """

    def __init__(self) -> None:
        self._steps: list[tuple[str, Callable[[], object]]] = []

    def add(self, name: str, step: Callable[[], object]) -> None:
        """Add a step, which will run before all those added so far."""
        self._steps.append((name, step))

    def run(self) -> dict[str, str]:
        """Run every step once and return what failed, by the step's name; never raises, a second call runs nothing."""
        failed = {}
        while self._steps:
            name, step = self._steps.pop()
            try:
                step()
            # Also SystemExit and KeyboardInterrupt: nothing may keep the steps after this one from running.
            except BaseException as error:
                failed[name] = f"{type(error).__name__}: {error}"
        return failed


class Notifier:
    """Sends state to the socket named by NOTIFY_SOCKET; never blocks."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._watchdog_ns = _watchdog_ns(environment)
        self._fed_ns: int | None = None

    def ready(self) -> None:
        """Say that the daemon serves; the service manager's watchdog runs from here."""
        self._send("READY=1")

    def status(self, text: str) -> None:
        """Show one line in `systemctl status`."""
        self._send(f"STATUS={' '.join(text.split())}")

    def watchdog(self, now_ns: int) -> None:
        """Feed the watchdog if half its interval has passed; to be called by the loop itself, in each tick."""
        if self._watchdog_ns is None:
            return
        if self._fed_ns is None or now_ns - self._fed_ns >= self._watchdog_ns // 2:
            self._fed_ns = now_ns
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the daemon is stopping."""
        self._send("STOPPING=1")

    def _send(self, message: str) -> None:
        if self._address is not None:
            # A manager that has gone or does not read is no reason to stop driving.
            with contextlib.suppress(OSError):
                self._socket.sendto(message.encode(), self._address)


def _address(name: str) -> str | bytes | None:
    """Return the socket's address: a path, or "@name" for one in the abstract namespace; None if there is none."""
    if name.startswith("@"):
        return b"\0" + name[1:].encode()
    return name if name.startswith("/") else None


def _watchdog_ns(environment: Mapping[str, str]) -> int | None:
    """Return the watchdog's interval, None if there is no watchdog or it is meant for another process."""
    with contextlib.suppress(ValueError):
        interval_us = int(environment.get("WATCHDOG_USEC", ""))
        process = int(environment.get("WATCHDOG_PID", os.getpid()))
        if interval_us > 0 and process == os.getpid():
            return interval_us * 1000
    return None


# File descriptors (POSIX).
STANDARD_INPUT, STANDARD_OUTPUT, STANDARD_ERROR = 0, 1, 2
# Chosen: lines for a terminal that has stopped reading; further ones are dropped and counted.
_MOST_LINES = 1000


class AsyncPrinter:
    """Writes a line for each sentence to a descriptor, from a thread of its own: called as `report(topic, text)`.

    Who holds the output, by Ctrl-S, a pager or a connection that hangs, would hold up the control loop with it. What
    comes while a thousand lines wait is dropped and counted; a reader that has gone gets nothing more. The thread
    begins with the first sentence, and so has the priority of who says that: one of normal priority could be set aside
    with the interpreter's lock in its hand, and the loop with it.
    """

    def __init__(self, descriptor: int, line_of: Callable[[str, str], str], most: int = _MOST_LINES) -> None:
        self.dropped = 0
        self._descriptor = descriptor
        self._line_of = line_of
        self._most = most
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def __call__(self, topic: str, text: str) -> None:
        """Have the sentence written."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._write, name="async printer", daemon=True)
            self._thread.start()
        if self._lines.qsize() < self._most:
            self._enqueue(topic, text)
        else:
            self.dropped += 1

    def close(self, timeout_s: float = 1.0) -> None:
        """Wait at most `timeout_s` until everything is written; safe to call twice."""
        if self.dropped:
            self._enqueue(
                "output", f"{self.dropped} messages are missing here, because the output was not read fast enough"
            )
            self.dropped = 0
        if self._thread is not None:
            self._lines.put(None)
            self._thread.join(timeout_s)

    def _enqueue(self, topic: str, text: str) -> None:
        self._lines.put(f"{self._line_of(topic, text)}\n".encode(errors="surrogateescape"))

    def _write(self) -> None:
        # Straight to the descriptor: a thread that is held inside of `print` would keep the process from ending.
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError):
                while line:
                    line = line[os.write(self._descriptor, line) :]


_WAITS_FOR_ROBOT = frozenset({State.DISCONNECTED, State.HANDSHAKE})
# Times that it is asked, once a second: a minute.
_PATIENT_AFTER = 60
_EVERY = 60


class Waiting:
    """Asked once a second; what stays the same for a minute is then said once a minute, as a journal is not endless."""

    def __init__(self) -> None:
        self._last_detail = ""
        self._repeated = 0

    def should_report(self, state: State, detail: str) -> bool:
        """Whether these words of this state should be said now."""
        if detail != self._last_detail:
            self._last_detail, self._repeated = detail, 0
            return True
        self._repeated += 1
        return state in _WAITS_FOR_ROBOT and (self._repeated < _PATIENT_AFTER or self._repeated % _EVERY == 0)
