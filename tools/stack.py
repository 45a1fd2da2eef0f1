"""The whole stack in processes of their own, for tests and benchmarks: virtual robot and daemon, in real time.

They are driven and broken from outside, and what the simulator recorded as the truth is read afterwards.
"""

from __future__ import annotations

import csv
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.experiments import Child, Operator, disco_hw_process, with_device

# Chosen: a busy machine is tried again.
_STARTS = 3
_CAUSES_OF_THIS_HOST = ("COMMAND_TIMEOUT", "COMMAND_EXPIRED", "HOST_SILENT")
_ROBOT_SILENT = "-> stopping: no wheel data"
FAST_TASK = 'kind = "circle"\nradius_m = 3.0\nspeed_m_s = 0.45\n'
# On the circle of FAST_TASK, facing along it: x, y (m) and a quarter turn.
FAST_START = (3.0, 0.0, 1.5707963)
CIRCLE_START = (0.75, 0.0, 1.5707963)
"""The same of the shipped robot's circle."""


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
    shipped = SHIPPED_ROBOT.parent
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
