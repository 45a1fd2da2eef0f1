"""Demonstration with virtual robot and daemon as processes of their own, driven round the circle and evaluated.

This process plays the operator: it starts both, talks to the daemon's control socket, and reads the log and the
simulator's truth afterwards. Nothing here reaches into either process.
"""

from __future__ import annotations

import math
import shlex
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.errors import InputError, WorkError
from disco_hw.experiments import (
    DEVICES,
    READY_TIMEOUT_S,
    Child,
    Operator,
    disco_hw_process,
    is_stationary,
    link_of_device,
    with_device,
)
from disco_hw.experiments.circle_report import (
    NARROWEST,
    CircleReport,
    Point,
    circle_points,
    load_circle_report,
    picture,
)
from disco_hw.fence import Circle, Footprint
from disco_hw.processes import stolen_ms
from disco_hw.runtime.robot_setup import Setup, geometry, load_setup
from disco_hw.tasks.circle import CircleTask, circle_task, inwards_sine
from disco_hw.viewer import DEFAULT_PORT, page_token

# Chosen: how often the picture in the terminal is drawn.
_POLL_S = 0.1
_STOP_TIMEOUT_S = 10.0
# Chosen: a page starts in a few seconds, on a busy computer in ten.
_PAGE_TIMEOUT_S = 20.0
_STALL_MS = 100
_PICTURE_ROWS = 14
_STALL_LOOK_BACK_S = 0.5
PILLAR = Circle((-0.53, 0.53), 0.12)
"""What stands on the circle with `--obstacle`, and is driven around."""
FOOTPRINT = Footprint(0.40, 0.36, 0.10)
_FOOTPRINT_TOML = "{ length = 0.40, width = 0.36, ahead = 0.10 }"
_FENCE_TOML = """
[fence]
keep_in = [[-1.8, -1.8], [1.8, -1.8], [1.8, 1.8], [-1.8, 1.8]]
"""
_WATCHDOG = frozenset({"COMMAND_TIMEOUT", "COMMAND_EXPIRED", "HOST_SILENT"})


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """Options of the demonstration; `laps` are counter-clockwise turns around the circle's centre."""

    link: str = "can"
    device: str | None = None
    out: Path = Path("out/demo")
    laps: float = 1.5
    plant_seed: int = 1
    uncertainty: str = "ut"
    view: bool = False
    adapt: bool = False
    obstacle: bool = False
    backwards: bool = False
    port: int = DEFAULT_PORT
    show_progress: bool = True

    @property
    def facing(self) -> str:
        """Value of `control.facing` in robot.toml."""
        return "backwards" if self.backwards else "forwards"

    @property
    def log(self) -> Path:
        """File of the daemon's log."""
        return self.out / "demo.mcap"

    @property
    def truth(self) -> Path:
        """File of the virtual robot's true motion."""
        return self.out / "truth.csv"


def run_demo(options: DemoOptions) -> CircleReport:
    """Drive the circle with a virtual robot and return the figures; prints progress, a table and the files written.

    Drives anew, once, and says so, where the robot's watchdog stopped it right after the host of this virtual machine
    had taken the processors away. Raises InputError for wrong options and WorkError when a process fails, the robot
    stops for another reason, or the lap is not completed in time.
    """
    if options.link not in {"can", "serial"}:
        raise InputError(f"--link {options.link}: no such link; write can or serial")
    if options.uncertainty not in {"ut", "mc", "joint", "point"}:
        raise InputError(f"--uncertainty {options.uncertainty}: no such choice; write ut, mc, joint or point")
    if options.device is not None and options.device not in DEVICES:
        raise InputError(f"--device {options.device}: no such device; write one of {', '.join(DEVICES)}")
    if options.device is not None and options.link != "can":
        raise InputError(
            f"--link {options.link}: cannot be used with --device, which sets its own link; leave --link out"
        )
    if options.view:
        # A wrong one in the environment is refused before anything is started.
        page_token()
    options.out.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=not options.show_progress)
    with _ended_by_signals(), tempfile.TemporaryDirectory(prefix="disco-hw-demo-") as scratch:
        stopped = _drive_undisturbed(options, _write_robot_file(Path(scratch), options), console)
    task = circle_task(load_robot_config(SHIPPED_ROBOT).task, "the demonstration")
    report = load_circle_report(options.log, options.truth, task, options.laps, stopped, options.backwards)
    if options.obstacle:
        report = replace(report, pillar=PILLAR, footprint=FOOTPRINT)
    picture_file = options.out / "circle.png"
    report.draw(picture_file)
    console.print(report.table())
    console.print(f"log {options.log}   picture {picture_file}   truth {options.truth}")
    for line in what_next(options, options.log, picture_file):
        console.print(line, soft_wrap=True, highlight=False)
    return report


def what_next(options: DemoOptions, log: Path, picture_file: Path) -> list[str]:
    """Return lines on what to look at now, and what to type next."""
    again = (
        []
        if options.view
        else ["  disco-hw demo --view           the same, with the page in your browser while it drives"]
    )
    named = shlex.quote(str(log))
    return [
        f"look at {picture_file}: the circle, what was driven, what was estimated",
        "type next:",
        f"  disco-hw view {named}    the drive again, on the page, with a bar to scrub",
        f"  disco-hw replay {named}  the controller again on the recorded inputs, bit for bit",
        *again,
        "  disco-hw experiment gap        an effect hidden in the robot, found, named, and driven again with",
        "  disco-hw init                  a robot.toml for a robot of your own",
    ]


def _write_robot_file(scratch: Path, options: DemoOptions) -> Path:
    """Copy the shipped robot with addresses of its own, so that two demonstrations never meet."""
    model = SHIPPED_ROBOT.with_name("wombot_model.toml")
    text = SHIPPED_ROBOT.read_text(encoding="utf-8")
    replaced = {
        'kind = "can"': f'kind = "{options.link}"',
        'channel = "/tmp/disco-hw-wombot.can"': f'channel = "{scratch / "bus"}"',
        'port = "/tmp/disco-hw-wombot.tty"': f'port = "{scratch / "tty"}"',
        'file = "wombot_model.toml"': f'file = "{model}"',
        "[control]\n": f'[control]\nuncertainty = "{options.uncertainty}"\nfacing = "{options.facing}"\n',
    }
    for old, new in replaced.items():
        if text.count(old) != 1:
            raise WorkError(f"{SHIPPED_ROBOT}: expected exactly one line '{old.strip()}'")
        text = text.replace(old, new)
    if options.device is not None:
        text = with_device(text, options.device)
    if options.obstacle:
        text = text.replace("[robot]\n", f"[robot]\nfootprint_m = {_FOOTPRINT_TOML}\n", 1) + _FENCE_TOML
    text += f'\n[daemon]\ncontrol_socket = "{scratch / "control.sock"}"\n'
    path = scratch / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Within the block, SIGTERM and SIGHUP end this process as Ctrl-C does: what was started is ended first."""

    def end(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


class _HostStallError(WorkError):
    """The robot's watchdog ended the drive right after the host of this virtual machine took 100 ms or more."""


def _drive_undisturbed(options: DemoOptions, robot_file: Path, console: Console) -> bool:
    """`_drive`, once more from new processes where the machine's host held it up just before the robot stopped."""
    try:
        return _drive(options, robot_file, console)
    except _HostStallError as error:
        console.print(f"{error}\ndriving anew")
    return _drive(options, robot_file, console)


def start_pose(setup: Setup) -> tuple[float, float, float]:
    """On the circle, x, y (m), yaw (rad), in the heading in which the believed robot goes round.

    Along the circle it would have to turn inwards first, which swings the tracked point out by x_icr_m^2 / radius_m.
    """
    task = circle_task(setup.config.task, "the demonstration")
    (_, _, x_icr_m), _ = geometry(setup.model)
    turned_rad = setup.config.turned_rad
    inwards_rad = math.asin(inwards_sine(task.radius_m, -x_icr_m if turned_rad else x_icr_m))
    return task.center_x_m + task.radius_m, task.center_y_m, 0.5 * math.pi + inwards_rad + turned_rad


def _drive(options: DemoOptions, robot_file: Path, console: Console) -> bool:
    """Drive and stop the robot; return whether daemon and robot both reported it standing and disarmed."""
    log, truth = options.log, options.truth
    for old in (log, truth, *log.parent.glob(f"{log.stem}.part*{log.suffix}")):
        old.unlink(missing_ok=True)
    setup = load_setup(robot_file)
    task = circle_task(setup.config.task, "the demonstration")
    lap_s = 2.0 * math.pi * task.radius_m / task.speed_m_s
    simulator = [
        "sim", str(robot_file), "--plant-seed", str(options.plant_seed), "--truth", str(truth),
        "--start", *map(str, start_pose(setup)),
    ]  # fmt: skip
    daemon_arguments = ["run", str(robot_file), "--log", str(log)]
    daemon_arguments += ["--view", "--port", str(options.port)] if options.view else []
    daemon_arguments += ["--adapt"] if options.adapt else []
    with (
        disco_hw_process("virtual robot", simulator, options.out / "sim.txt") as robot,
        disco_hw_process("daemon", daemon_arguments, options.out / "daemon.txt") as daemon,
    ):
        operator = Operator(robot_file.with_name("control.sock"), (robot, daemon))
        link = options.link if options.device is None else link_of_device(options.device)
        console.print(f"virtual robot pid {robot.process.pid}, daemon pid {daemon.process.pid}, link {link}")
        if options.view:
            operator.wait_for("READY", READY_TIMEOUT_S)
            console.print(page_line(daemon), soft_wrap=True, markup=False)
        operator.arm()
        if options.obstacle:
            (x_m, y_m), radius_m = PILLAR.center, PILLAR.radius_m
            operator.request("obstacle", change="add", name="pillar", x_m=x_m, y_m=y_m, radius_m=radius_m)
        operator.request("start")
        _watch_laps(operator, options, 3.0 * lap_s * options.laps + 10.0, console)
        operator.request("stop")
        operator.wait_for_standstill(5.0)
        operator.request("disarm")
        stopped = is_stationary(operator.wait_for("READY", 5.0))
        operator.request("quit")
        code = daemon.process.wait(_STOP_TIMEOUT_S)
        if code != 0:
            raise WorkError(f"the daemon ended with exit code {code}: {daemon.last_line()}")
    return stopped


def page_line(daemon: Child) -> str:
    """Return the line about the page for the operator: its address, or why there is none.

    Another program may listen on the port, so that the page's own word counts. It is waited for some seconds: the drive
    needs no page.
    """
    deadline_s = time.monotonic() + _PAGE_TIMEOUT_S
    while time.monotonic() < deadline_s:
        for line in daemon.output_lines().splitlines(keepends=True):
            if line.startswith("page: http") and line.endswith("\n"):
                return f"page {line.removeprefix('page: ').strip()} (until the drive is over)"
            if line.startswith("page: ") and line.endswith("\n"):
                return line.strip()
        time.sleep(_POLL_S)
    return f"page: no address in {daemon.output} after {_PAGE_TIMEOUT_S:g} s"


def _watch_laps(operator: Operator, options: DemoOptions, limit_s: float, console: Console) -> None:
    """Show progress until the laps are driven; raises WorkError when it takes longer than `limit_s`."""
    stolen: deque[tuple[float, int]] = deque()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TextColumn("{task.completed:.2f} of {task.total:.2f} laps"),
        TextColumn("{task.fields[figures]}"),
    )
    progress = Progress(*columns, console=console)
    task = progress.add_task("circle", total=options.laps, figures="")
    deadline = time.monotonic() + limit_s
    next_line = 0.0
    floor = _Floor(circle_task(load_robot_config(SHIPPED_ROBOT).task, "the demonstration"))
    shown = Group(progress, floor) if console.width >= NARROWEST else progress
    with Live(shown, console=console, refresh_per_second=4) if console.is_terminal else nullcontext():
        while True:
            # Taken before a status is asked for: a daemon that is held up answers only afterwards.
            stolen.append((time.monotonic(), stolen_ms()))
            while len(stolen) > 1 and stolen[-1][0] - stolen[1][0] >= _STALL_LOOK_BACK_S:
                stolen.popleft()
            status = operator.status()
            if status["state"] != "ARMED":
                raise _why_stopped(operator, status, stolen_ms() - stolen[0][1])
            laps = float(status["task"]["laps"])
            floor.driven.append((status["pose"][0], status["pose"][1]))
            figures = (
                f"d {status['task']['distance_m'] * 1e3:4.0f} mm  v {status['task']['speed_m_s']:.3f} m/s  "
                f"late p99 {status['loop']['lateness_us']['p99'] or 0.0:.0f} us"
            )
            progress.update(task, completed=min(max(laps, 0.0), options.laps), figures=figures)
            if not console.is_terminal and laps >= next_line:
                console.print(f"laps {laps:5.2f}  {figures}")
                next_line = max(next_line, 0.0) + 0.1
            if laps >= options.laps:
                return
            if time.monotonic() > deadline:
                raise WorkError(
                    f"only {laps:.2f} of {options.laps} laps were driven in {limit_s:.0f} s; stop other programs on "
                    "this computer, and try again"
                )
            time.sleep(_POLL_S)


class _Floor:
    """The task's circle and the way driven, as a picture that `rich` draws anew whenever it is shown."""

    def __init__(self, task: CircleTask) -> None:
        self.driven: list[Point] = []
        self._task = task

    def __rich__(self) -> Text:
        task, reach_m = self._task, 1.3 * self._task.radius_m
        centre = (task.center_x_m, task.center_y_m)
        low, high = (centre[0] - reach_m, centre[1] - reach_m), (centre[0] + reach_m, centre[1] + reach_m)
        layers = [circle_points(centre, task.radius_m), self.driven]
        return Text("\n".join(picture(layers, low, high, _PICTURE_ROWS)))


def _why_stopped(operator: Operator, status: Mapping[str, Any], stolen_ms: int) -> WorkError:
    """Return what to raise for a drive that ended before its laps; `stolen_ms`: CPU time lost to the host just before.

    What the host takes bit by bit over a whole drive excuses nothing, hence only the last half second.
    """
    detail = f"the daemon left ARMED for {status['state']}: {status['detail']}"
    # After a long stall the wheels may already stand at the first status: READY in place of STOPPING.
    if status["state"] not in ("STOPPING", "READY") or stolen_ms < _STALL_MS:
        return WorkError(detail)
    # The daemon may notice a stall before the robot has reported its own stop.
    after = operator.wait_until("stopped", lambda status: bool(status["state"] != "STOPPING"), 5.0)
    if after["stop_cause"] not in _WATCHDOG:
        return WorkError(detail)
    return _HostStallError(
        f"{detail}\nthe host of this virtual machine took {stolen_ms} ms of its processors just before"
    )
