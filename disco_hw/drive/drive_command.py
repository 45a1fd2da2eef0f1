"""What `disco-hw drive` does: the daemon with a person or a script in the planner's place."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from disco_hw.config import Link, RobotConfig
from disco_hw.daemon import socket_path
from disco_hw.daemon.loop import MonotonicClock
from disco_hw.daemon.process import STANDARD_ERROR, STANDARD_INPUT, STANDARD_OUTPUT, AsyncPrinter
from disco_hw.daemon.run import in_text, new_log, serve
from disco_hw.drive import PAD_STATUS_TEXT, GamepadSource, ManualSource, PageSource
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.fit import FittedScriptSource
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.drive.script import RobotModel, Script, ScriptSource, Unattended, in_table, room_needed
from disco_hw.drive.scripts import create_script
from disco_hw.drive.terminal import HELP, Keyboard, KeyHold
from disco_hw.errors import InputError, LogError
from disco_hw.fence.clearance import Boundaries
from disco_hw.files import check_log_file
from disco_hw.log.reader import open_log
from disco_hw.runtime.assembly import odometry_parameters
from disco_hw.runtime.robot_setup import Setup, load_setup
from drivers.gamepad import Gamepad, GamepadError, GamepadMapping, open_gamepad

_VIRTUAL_INTERFACES = ("unixcan", "virtual")
_PSEUDO_TERMINALS = "/dev/pts/"
# Chosen: longer than the display's process takes to end by itself; then it is killed.
_DISPLAY_TIMEOUT_S = 2.0


def leads_to_virtual_robot(link: Link) -> bool:
    """Return True for the simulator's own bus, Linux's vcan and existing pseudo-terminals; False when in doubt."""
    if link.kind == "serial":
        return os.path.realpath(link.port).startswith(_PSEUDO_TERMINALS)
    if link.interface == "socketcan":
        return link.channel.startswith("vcan")
    return link.interface in _VIRTUAL_INTERFACES


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """Options of `disco-hw drive`; None leaves what robot.toml says, `seconds` breaks a script off."""

    robot: Path
    model: Path | None = None
    link: str | None = None
    log_file: Path | None = None
    gamepad: bool = False
    page: bool = False
    ros2: bool = False
    script: str | None = None
    unattended: bool = False
    seconds: float | None = None
    seed: int = 1
    as_json: bool = False


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Result of a drive: its log, what was excited, why it ended, whether it was completed, what of the log was lost.

    `recording_errors`: sentences, if the log does not prove by its end that every tick is in it; with any of them the
    drive is not `completed`, as it was made for its log.
    """

    log: Path
    ended: str
    completed: bool
    coverage: dict[str, Any]
    coverage_text: str
    recording_errors: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict."""
        return {**asdict(self), "log": str(self.log)}

    def as_text(self) -> str:
        """Return the result as text."""
        missing = "".join(f"\nLOG NOT COMPLETE: {error}" for error in self.recording_errors)
        return f"{self.ended}\n{self.coverage_text}\nlog {self.log}{missing}"


def run_drive(options: DriveOptions, page_messages: Callable[[], tuple[str, ...]] = lambda: ()) -> DriveResult:
    """Drive by keyboard, gamepad or script until that ends, and record it; `page_messages` as for `run_daemon`.

    Runs the daemon's loop with its governor, supervisor and recorder; there is no planner, and no pose is needed.
    Raises InputError for wrong options, files and devices.
    """
    check_log_file(options.log_file)
    setup = load_setup(options.robot, options.model, options.link)
    config = setup.config
    script = _script(options, config)
    log_file = options.log_file or new_log(config, "drive-")
    top_rad_s = config.drive.speed_share * config.robot.max_wheel_speed_rad_s
    prompt = "cmd_vel: arm through the bridge, then it drives; Ctrl-C ends" if options.ros2 else PAD_STATUS_TEXT
    page = PageSource(top_rad_s, config.drive.turn_share, prompt) if options.page or options.ros2 else None
    source = _source(options, setup, script, top_rad_s, page)
    try:
        if not options.as_json:
            print("\n".join(_announcement(options, config, script)), flush=True)
        coverage = Coverage(top_rad_s)
        errors: list[str] = []
        with _display(socket_path(config), shown=not options.as_json) as show:

            def report(topic: str, text: str) -> None:
                if topic == "recording":
                    errors.append(text)
                show(topic, text)

            code = serve(setup, log_file, report, HandPilot(source, coverage, page), page_messages=page_messages)
    finally:
        source.close()
    # A writer that was slow for a second and then wrote all that had waited has lost nothing.
    # The first file shows nothing of later parts; `serve` knows of all of them.
    is_complete = not code and (not errors or _is_complete(log_file))
    missing = () if is_complete else tuple(errors) or ("not every tick is in its file",)
    return DriveResult(
        log=log_file,
        ended=source.ended or "stopped on request",
        completed=source.completed and not missing,
        coverage=coverage.as_dict(),
        coverage_text=coverage.describe(),
        recording_errors=missing,
    )


def _is_complete(log_file: Path) -> bool:
    """Whether the log has the recorder's last word, and every tick up to it."""
    try:
        with open_log(log_file) as log:
            summary = log.summary()
    except (InputError, LogError):
        return False
    return summary.complete and summary.ended is True and not summary.missing_ticks


def _script(options: DriveOptions, config: RobotConfig) -> Script | None:
    if options.script is None:
        if options.unattended or options.seconds is not None:
            raise InputError("--unattended and --seconds belong to a script; add --script circle, steps or excite")
        return None
    script = create_script(options.script, config.robot, config.task, config.drive.speed_share, options.seed)
    return script if options.seconds is None else script.cut(options.seconds)


def _announcement(options: DriveOptions, config: RobotConfig, script: Script | None) -> list[str]:
    """Return the lines that are printed before anything moves."""
    lines = []
    if script is not None:
        room = room_needed(script, config.robot)
        lines += [*in_table(script), f"{script.duration_s:.0f} s, needs {room.describe()}"]
    if not (options.gamepad or options.page or options.ros2 or options.unattended):
        lines.append(HELP)
    return lines


def _source(
    options: DriveOptions, setup: Setup, script: Script | None, top_rad_s: float, page: PageSource | None
) -> ManualSource:
    config = setup.config
    deadmen = {
        "--unattended": options.unattended,
        "--gamepad": options.gamepad,
        "--page": options.page,
        "--ros2": options.ros2,
    }
    chosen = [name for name, given in deadmen.items() if given]
    if len(chosen) > 1:
        raise InputError(f"{' and '.join(chosen)}: only one deadman can be used; leave one of them out")
    source: ManualSource
    if options.unattended:
        link = config.link
        if not leads_to_virtual_robot(link):
            named = f"port {link.port}" if link.kind == "serial" else f"interface {link.interface} {link.channel}"
            raise InputError(
                f"--unattended: link.{named} may lead to a real robot; hold a deadman (keyboard, --gamepad, "
                "--page, --ros2), or start the virtual robot first"
            )
        source = Unattended()
    elif page is not None:
        source = page
    elif options.gamepad:
        source = _gamepad(config, top_rad_s)
    else:
        source = Keyboard(STANDARD_INPUT, KeyHold(top_rad_s), MonotonicClock())
    if script is None:
        return source
    if not config.fence.is_set:
        return ScriptSource(script, source)
    robot = RobotModel(odometry_parameters(setup.model), config.robot.max_wheel_acceleration_rad_s2)
    room = room_needed(script, config.robot)
    return FittedScriptSource(script, source, robot, Boundaries(config.robot.footprint, config.fence), room)


def _gamepad(config: RobotConfig, top_rad_s: float) -> GamepadSource:
    settings = config.drive
    mapping = GamepadMapping(
        forward_axis=settings.gamepad_forward_axis,
        left_axis=settings.gamepad_left_axis,
        deadman_button=settings.gamepad_deadman,
        dead_zone=settings.gamepad_dead_zone,
    )

    def open_pad(now_ns: int) -> Gamepad:
        return open_gamepad(mapping, now_ns, settings.gamepad_device)

    try:
        pad = open_pad(MonotonicClock().now_ns())
    except GamepadError as error:
        raise InputError(f"--gamepad: {error}") from None
    return GamepadSource(pad, open_pad, top_rad_s, settings.turn_share, settings.gamepad_silence_s)


@contextmanager
def _display(socket: Path, shown: bool) -> Iterator[Any]:
    """Show the drive in a process of its own; yields what the daemon says its sentences to.

    In a terminal the table has the newest of them, so they are printed once it is gone.
    """
    if not shown:
        with closing(AsyncPrinter(STANDARD_ERROR, in_text)) as printer:
            yield printer
        return
    later: deque[str] = deque(maxlen=20)

    def keep(topic: str, text: str) -> None:
        later.append(in_text(topic, text))

    # Started before the daemon takes on real time, and in a session of its own: Ctrl-C is for the daemon alone.
    process = subprocess.Popen(
        [sys.executable, "-m", "disco_hw.drive.terminal", str(socket)], start_new_session=True, stdin=subprocess.DEVNULL
    )
    try:
        if sys.stdout.isatty():
            yield keep
        else:
            with closing(AsyncPrinter(STANDARD_OUTPUT, in_text)) as printer:
                yield printer
    except InputError:
        # Nothing was driven, so there is nothing to wait for.
        process.kill()
        raise
    finally:
        try:
            process.wait(_DISPLAY_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for text in later:
            print(text)
