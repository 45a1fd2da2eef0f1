"""A person's part, played by a program: start processes, ask and tell the daemon, wait for what must happen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from disco_hw.daemon.control_client import send_request
from disco_hw.errors import WorkError

_POLL_S = 0.05
_END_TIMEOUT_S = 10.0
_STILL_RAD_S = 0.05


@dataclass(frozen=True, slots=True)
class Child:
    """A process and the file that its output goes to."""

    name: str
    process: subprocess.Popen[bytes]
    output: Path

    def last_words(self) -> str:
        """The last line it wrote."""
        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


@contextmanager
def disco_hw_process(name: str, arguments: Sequence[str], output: Path) -> Iterator[Child]:
    """A `disco-hw` process in a session of its own; SIGTERM at the end, SIGKILL if that is ignored."""
    with output.open("wb") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "disco_hw", *arguments],
            stdout=sink,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield Child(name, process, output)
    finally:
        if process.poll() is None:
            # A stopped process would not see the request to end.
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


class Operator:
    """Whoever holds the control socket; notices when a process it depends on has ended."""

    def __init__(self, socket: Path, children: Sequence[Child] = ()) -> None:
        self._socket = socket
        self._children = tuple(children)

    def status(self) -> Mapping[str, Any]:
        """The daemon's status; raises WorkError if a process has ended or the daemon does not answer."""
        self._check_alive()
        return send_request(self._socket, {"do": "status"}, timeout_s=2.0)

    def tell(self, what: str) -> None:
        """Have the daemon do something; raises WorkError in its words if it refuses."""
        reply = send_request(self._socket, {"do": what}, timeout_s=2.0)
        if not reply.get("ok"):
            raise WorkError(f"the daemon refused to {what}: {reply.get('error')}")

    def wait_until(
        self, what: str, condition: Callable[[Mapping[str, Any]], bool], timeout_s: float
    ) -> Mapping[str, Any]:
        """Poll the status until `condition` holds; raises WorkError naming `what` if it never does."""
        deadline = time.monotonic() + timeout_s
        words = "no answer yet"
        while time.monotonic() < deadline:
            self._check_alive()
            if self._socket.exists():
                try:
                    status = send_request(self._socket, {"do": "status"}, timeout_s=2.0)
                except WorkError as error:
                    words = str(error)
                    continue
                if status.get("ok") and condition(status):
                    return status
                words = f"{status.get('state')}: {status.get('detail')}"
            time.sleep(_POLL_S)
        raise WorkError(f"not {what} within {timeout_s:g} s ({words})")

    def wait_for(self, state: str, timeout_s: float) -> Mapping[str, Any]:
        """Wait for a state of the daemon."""
        return self.wait_until(state, lambda status: bool(status["state"] == state), timeout_s)

    def wait_for_standstill(self, timeout_s: float) -> Mapping[str, Any]:
        """Wait until the measured wheel speeds are below 0.05 rad/s."""
        return self.wait_until("standing still", stands, timeout_s)

    def _check_alive(self) -> None:
        for child in self._children:
            code = child.process.poll()
            if code is not None:
                raise WorkError(f"the {child.name} ended with exit code {code}: {child.last_words()}")


def stands(status: Mapping[str, Any]) -> bool:
    """Whether the wheels are measured and stand still."""
    wheels = status["wheels"]
    return wheels is not None and max(abs(wheels[0]), abs(wheels[1])) < _STILL_RAD_S
