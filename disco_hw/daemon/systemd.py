"""Tells the service manager how the daemon is (sd_notify, watchdog); does nothing where there is none.

Protocol: the manual pages sd_notify(3) and sd_watchdog_enabled(3).
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends state to the socket named by NOTIFY_SOCKET; never blocks, counts what could not be sent."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
        self._watchdog_ns = _watchdog_ns(environment)
        self._fed_ns: int | None = None
        self._unsent = 0

    @property
    def unsent(self) -> int:
        """Number of messages that the service manager did not take."""
        return self._unsent

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

    def close(self) -> None:
        """Release the socket; safe to call twice. What is sent afterwards goes nowhere."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> None:
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:
            self._unsent += 1


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
