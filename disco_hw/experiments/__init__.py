"""Programs that show the whole stack at work: demo, experiments, and the daemon in simulated time.

Here processes of `disco-hw`, and the operator's part, played by a program: it asks and commands the daemon and waits
for what must happen.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from disco_hw.daemon import send_request
from disco_hw.errors import WorkError
from disco_hw.processes import PARENT_VARIABLE
from drivers.motor import find_driver, motor_drivers
from drivers.pose.udp import SOURCE as UDP_POSES

DEVICES = MappingProxyType({driver.name: driver.example for driver in motor_drivers().values() if driver.example})
"""By name of a driver whose controller can be simulated: its lines in [link]."""
# As docs/controllers.md asks for at least.
_VENDORS_BAUD = 115_200
READY_TIMEOUT_S = 180.0
"""A first start compiles the planner: more than a minute on a busy machine. A daemon that ends is noticed at once."""
# Chosen: how late a state is noticed, an end waited for, standing told from noise, and a busy machine tried again.
_POLL_S = 0.05
_END_TIMEOUT_S = 10.0
_STATIONARY_RAD_S = 0.05
_STARTS = 3


@dataclass(frozen=True, slots=True)
class Child:
    """A process and the file that its output goes to."""

    name: str
    process: subprocess.Popen[bytes]
    output: Path

    def output_lines(self) -> str:
        """Return all that the process wrote so far."""
        return self.output.read_text(encoding="utf-8", errors="replace")

    def last_line(self) -> str:
        """Return the last line it wrote."""
        lines = self.output_lines().strip().splitlines()
        return lines[-1] if lines else ""


@contextmanager
def disco_hw_process(name: str, arguments: Sequence[str], output: Path) -> Iterator[Child]:
    """Run a `disco-hw` process in a session of its own; SIGTERM at the end, SIGKILL if that is ignored.

    SIGTERM too if the thread that entered is gone, whatever ended it.
    """
    with output.open("wb") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "disco_hw", *arguments],
            stdout=sink,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, PARENT_VARIABLE: str(os.getpid())},
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
    """Program in the operator's place at the control socket; notices when a process it depends on has ended."""

    def __init__(self, socket: Path, children: Sequence[Child] = ()) -> None:
        self._socket = socket
        self._children = tuple(children)

    def status(self) -> Mapping[str, Any]:
        """Return the daemon's status; raise WorkError if a process has ended or the daemon does not answer."""
        self._check_alive()
        return send_request(self._socket, {"do": "status"}, timeout_s=2.0)

    def request(self, what: str, **arguments: float | str) -> None:
        """Send one request such as "arm"; raises WorkError with the daemon's reason if it refuses."""
        reply = send_request(self._socket, {"do": what, **arguments}, timeout_s=2.0)
        if not reply.get("ok"):
            raise WorkError(f"the daemon refused to {what}: {reply.get('error')}")

    def arm(self, timeout_s: float = 5.0) -> None:
        """Wait until the robot is ready and arm it; raises WorkError with what kept the robot from it.

        A busy machine may hold up the robot or its daemon while it arms, who then drop the request, as they must.
        Nothing arms again by itself: it is asked for again here, twice at most, but not in a fault.
        """
        for left in reversed(range(_STARTS)):
            self.wait_for("READY", READY_TIMEOUT_S)
            try:
                self.request("arm")
                self.wait_for("ARMED", timeout_s)
            except WorkError:
                if not left or self.status()["state"] == "FAULT":
                    raise
            else:
                return

    def wait_until(
        self, what: str, condition: Callable[[Mapping[str, Any]], bool], timeout_s: float
    ) -> Mapping[str, Any]:
        """Poll the status until `condition` holds; raises WorkError naming `what` if it never does.

        A first start on a busy machine compiles for longer than any start takes: that time does not count, up to ten
        times `timeout_s`.
        """
        deadline = time.monotonic() + timeout_s
        latest = deadline + 9.0 * timeout_s
        detail = "no answer yet"
        while time.monotonic() < deadline:
            self._check_alive()
            compiling = [line for child in self._children if (line := child.last_line()).startswith("compiling")]
            if compiling:
                detail, deadline = compiling[0], min(time.monotonic() + timeout_s, latest)
            if self._socket.exists():
                try:
                    status = send_request(self._socket, {"do": "status"}, timeout_s=2.0)
                except WorkError as error:
                    detail = str(error)
                    continue
                if status.get("ok") and condition(status):
                    return status
                detail = f"{status.get('state')}: {status.get('detail')}"
            time.sleep(_POLL_S)
        line = "".join(f"; last line of the {child.name}: {child.last_line()}" for child in self._children)
        raise WorkError(f"not {what} within {timeout_s:g} s ({detail}{line})")

    def wait_for(self, state: str, timeout_s: float) -> Mapping[str, Any]:
        """Wait for a state of the daemon."""
        return self.wait_until(state, lambda status: bool(status["state"] == state), timeout_s)

    def wait_for_standstill(self, timeout_s: float) -> Mapping[str, Any]:
        """Wait until the measured wheel speeds are below 0.05 rad/s."""
        return self.wait_until("standing still", is_stationary, timeout_s)

    def _check_alive(self) -> None:
        for child in self._children:
            code = child.process.poll()
            if code is not None:
                raise WorkError(f"the {child.name} ended with exit code {code}: {child.last_line()}")


def is_stationary(status: Mapping[str, Any]) -> bool:
    """Whether the wheels are measured and stand still."""
    wheels = status["wheels"]
    return wheels is not None and max(abs(wheels[0]), abs(wheels[1])) < _STATIONARY_RAD_S


def link_of_device(device: str) -> str:
    """Return the kind of link that a motor controller of `DEVICES` is usually on."""
    return find_driver(device).kinds[0]


def with_device(text: str, device: str) -> str:
    """Return a robot.toml's text with another motor controller of `DEVICES`, whose poses come by datagrams."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        port = opened.getsockname()[1]
    text = text.replace("[link]\n", f'[link]\ndriver = "{device}"\n{DEVICES[device]}')
    if link_of_device(device) == "serial":
        text = text.replace('\nkind = "can"', '\nkind = "serial"').replace("baud = 921600", f"baud = {_VENDORS_BAUD}")
    return text + f'\n[pose]\nsource = "{UDP_POSES}"\nport = {port}\n'
