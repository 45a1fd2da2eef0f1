"""Programs that show the whole stack at work: demo, experiments, and the daemon in simulated time.

Here the whole stack in processes of their own: virtual robot and daemon, driven and broken from outside, in real time.
The operator is a person's part, played by a program: it asks and commands the daemon and waits for what must happen.
"""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
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
_CAUSES_OF_THIS_HOST = ("COMMAND_TIMEOUT", "COMMAND_EXPIRED", "HOST_SILENT")
_ROBOT_SILENT = "-> stopping: no wheel data"


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


FAST_TASK = 'kind = "circle"\nradius_m = 3.0\nspeed_m_s = 0.45\n'
# On the circle of FAST_TASK, facing along it: x, y (m) and a quarter turn.
FAST_START = (3.0, 0.0, 1.5707963)


@dataclass(frozen=True)
class TruthRow:
    """One row of the simulator's truth."""

    t_s: float
    wheels: tuple[float, float]
    setpoints: tuple[float, float]
    state: str
    session: int
    accepted: int

    @property
    def fastest(self) -> float:
        """Speed of the faster wheel, rad/s."""
        return max(abs(self.wheels[0]), abs(self.wheels[1]))

    @property
    def requested(self) -> float:
        """The larger setpoint, rad/s."""
        return max(abs(self.setpoints[0]), abs(self.setpoints[1]))


def _faster_than(speed_rad_s: float, status: Mapping[str, Any]) -> bool:
    return status["wheels"] is not None and max(map(abs, status["wheels"])) > speed_rad_s


@dataclass
class Stack:
    """A running virtual robot with its daemon."""

    directory: Path
    robot_file: Path
    robot: Child
    daemon: Child
    operator: Operator
    _end: ExitStack = field(repr=False)

    def drive(self, until_rad_s: float = 6.0, timeout_s: float = 10.0) -> None:
        """Arm, start, and wait until the faster wheel has come up to speed."""
        self.drive_until("at speed", partial(_faster_than, until_rad_s), timeout_s)

    def drive_until(
        self, what: str, reached: Callable[[Mapping[str, Any]], bool], timeout_s: float
    ) -> Mapping[str, Any]:
        """Arm, start, and wait until `reached` holds, called `what` in words; the status then.

        A robot that stops because this busy machine held up the daemon or the robot is started again, twice at most.
        """
        for _ in range(_STARTS - 1):
            lines_before = len(self.daemon.output_lines())
            self.start()
            over = partial(self._over, reached, lines_before)
            status = self.operator.wait_until(what, over, timeout_s)
            if reached(status):
                return status
        self.start()
        return self.operator.wait_until(what, reached, timeout_s)

    def _over(self, reached: Callable[[Mapping[str, Any]], bool], lines_before: int, status: Mapping[str, Any]) -> bool:
        """Whether that is reached, or the robot stopped as it, or the daemon, heard nothing of the other.

        `lines_before`: number of lines that the daemon had printed before.
        """
        silent = (
            status["stop_cause"] in _CAUSES_OF_THIS_HOST or _ROBOT_SILENT in self.daemon.output_lines()[lines_before:]
        )
        return reached(status) or bool(status["state"] != "ARMED" and silent)

    def start(self) -> None:
        """Arm and start the task."""
        self.operator.arm()
        self.operator.request("start")

    def inject(self, command: str) -> str:
        """Do something to the robot or its link; returns the simulator's answer."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.bind(str(self.directory / f"client{time.monotonic_ns()}"))
            sock.settimeout(2.0)
            sock.sendto(command.encode(), str(self.directory / "inject"))
            return sock.recv(4096).decode()

    def truth(self) -> list[TruthRow]:
        """End both processes and read what truly happened."""
        self._end.close()
        return read_truth(self.directory / "truth.csv")


def read_truth(path: Path) -> list[TruthRow]:
    """Read what a virtual robot that has ended recorded of what truly happened."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            TruthRow(
                t_s=int(row["t_ns"]) * 1e-9,
                wheels=(float(row["left_speed_rad_s"]), float(row["right_speed_rad_s"])),
                setpoints=(float(row["left_setpoint_rad_s"]), float(row["right_setpoint_rad_s"])),
                state=row["state"],
                session=int(row["session"]),
                accepted=int(row["accepted_commands"]),
            )
            for row in csv.DictReader(file)
        ]


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


def write_robot_file(
    directory: Path,
    link: str = "can",
    task: str = "",
    model: str = "wombot_model.toml",
    device: str | None = None,
    control: str = "",
) -> Path:
    """Return the shipped robot with addresses of its own.

    `device`: another motor controller, of `DEVICES`. `control`: a line for that section.
    """
    shipped = Path(__file__).parents[1] / "robots"
    text = (shipped / "wombot.toml").read_text(encoding="utf-8")
    for old, new in {
        'kind = "can"': f'kind = "{link}"',
        "/tmp/disco-hw-wombot.can": str(directory / "bus"),
        "/tmp/disco-hw-wombot.tty": str(directory / "tty"),
        "wombot_model.toml": str(shipped / model),
        'directory = "logs"': f'directory = "{directory}"',
    }.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    if task:
        before, rest = text.split("[task]\n")
        text = before + "[task]\n" + task + "\n[model]" + rest.split("[model]")[1]
    if device is not None:
        text = with_device(text, device)
    if control:
        text = text.replace("[control]\n", f"[control]\n{control}\n")
    text += f'[daemon]\ncontrol_socket = "{directory / "control.sock"}"\n'
    path = directory / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


@contextmanager
def running_stack(
    directory: Path,
    link: str = "can",
    task: str = FAST_TASK,
    start: tuple[float, float, float] = FAST_START,
    sim_arguments: tuple[str, ...] = (),
    run_arguments: tuple[str, ...] = (),
    model: str = "wombot_model.toml",
    device: str | None = None,
    control: str = "",
) -> Iterator[Stack]:
    """Virtual robot and daemon on one link; both end with the block."""
    robot_file = write_robot_file(directory, link, task, model, device, control)
    simulator = [
        "sim", str(robot_file), "--truth", str(directory / "truth.csv"), "--inject", str(directory / "inject"),
        "--start", *map(str, start), *sim_arguments,
    ]  # fmt: skip
    with ExitStack() as stack:
        robot = stack.enter_context(disco_hw_process("virtual robot", simulator, directory / "sim.txt"))
        daemon = stack.enter_context(
            disco_hw_process(
                "daemon",
                ["run", str(robot_file), "--log", str(directory / "run.mcap"), *run_arguments],
                directory / "daemon.txt",
            )
        )
        yield Stack(directory, robot_file, robot, daemon, Operator(directory / "control.sock", (robot, daemon)), stack)
