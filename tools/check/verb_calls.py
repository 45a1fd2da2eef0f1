"""The verbs that read files, called in this process up to where their work begins.

What follows the reading (a link, a page, a search of minutes) is replaced by the end of the call, so that thousands of
files can be tried on the very code that a user's file goes through.
"""

from __future__ import annotations

import importlib
import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import typer.main

from disco_hw import cli
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.log import Attachment
from disco_hw.runtime.pipeline import NoPlanner
from drivers.motor import find_driver
from drivers.types import PoseSample
from firmware_protocol.codec import Codec
from tools.log_samples import drive_ticks, log_bytes

ROBOTS = SHIPPED_ROBOT.parent
CSV = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad,segment\n"
FAULTS = 'seed = 3\n[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 2.5\nto = "host"\nid = 0x100\nprobability = 0.5\n'
OUT = "out"


class WorkBeginsError(BaseException):
    """The input has been read and found good; nothing that catches errors of the work may catch it."""


@dataclass(frozen=True, slots=True)
class Call:
    """A verb with its arguments, files among them, and which files of `good_files` it reads."""

    verb: str
    arguments: str
    reads: tuple[str, ...]

    def argv(self, directory: Path) -> list[str]:
        """The arguments with the files where they are."""
        known = {*good_files(), OUT}
        return [
            str(directory / argument) if argument in known else argument
            for argument in (self.verb + " " + self.arguments).split()
        ]


_SETUP = ("robot.toml", "model.toml", "path.csv")
CALLS = (
    Call("run", "robot.toml --model model.toml --accept-missing-effects", (*_SETUP, "robot.key")),
    Call("drive", "robot.toml --model model.toml --script steps --unattended", (*_SETUP, "robot.key")),
    Call("check", "robot.toml", (*_SETUP, "robot.key")),
    Call("commission", "robot.toml --log-directory out", (*_SETUP, "robot.key")),
    Call("ctl", "robot.toml status", ("robot.toml",)),
    Call("estop", "robot.toml", ("robot.toml",)),
    Call("bridge ros2", "robot.toml --model model.toml", _SETUP),
    Call("bridge ros2-base", "base.toml", ("base.toml", "model.toml")),
    Call("infer", "drive.csv --robot robot.toml", ("robot.toml", "drive.csv")),
    Call("infer", "run.mcap --robot robot.toml", ("robot.toml", "run.mcap")),
    Call("gap", "drive.csv --robot robot.toml --model model.toml -o out", ("robot.toml", "model.toml", "drive.csv")),
    Call("gap", "run.mcap --robot robot.toml --model model.toml -o out", ("robot.toml", "model.toml", "run.mcap")),
    Call("import", "drive.csv --robot robot.toml -o out", ("robot.toml", "drive.csv")),
    Call("import", "bus.log --robot robot.toml -o out", ("robot.toml", "bus.log")),
    Call("log info", "run.mcap", ("run.mcap",)),
    Call("log fence", "run.mcap", ("run.mcap",)),
    Call("log recover", "run.mcap -o out", ("run.mcap",)),
    Call("log export", "run.mcap -o out", ("run.mcap",)),
    Call("view", "run.mcap", ("run.mcap",)),
    Call("view", "run.mcap --robot robot.toml", ("robot.toml", "model.toml", "path.csv", "run.mcap")),
    Call("view", "--live --robot robot.toml --model model.toml", _SETUP),
    Call("replay", "run.mcap", ("run.mcap",)),
    Call("sim", "robot.toml --model model.toml --faults faults.toml", (*_SETUP, "robot.key", "faults.toml")),
    Call("experiment adapt", "--robot robot.toml -o out", _SETUP),
    Call("experiment gap", "--robot robot.toml -o out", ("robot.toml", "model.toml", "path.csv")),
    Call("experiment circle", "--robot robot.toml -o out", _SETUP),
)


def good_files() -> dict[str, bytes]:
    """One sound file of each kind; robot.toml names the model, the path and the key beside it."""
    return dict(_GOOD or _build_good_files())


_GOOD: dict[str, bytes] = {}
_ON_ROS = f'driver = "ros2_base"\n{find_driver("ros2_base").example}'


def _as_the_wheels_turn(ticks: list[tuple[int, list[Any]]]) -> list[tuple[int, list[Any]]]:
    """The ticks with headings that turn as slowly as the wheels do: no verb refuses a log that contradicts itself."""
    found = []
    for now_ns, records in ticks:
        turned = [
            msgspec.structs.replace(one, yaw_rad=0.06 * one.yaw_rad) if isinstance(one, PoseSample) else one
            for one in records
        ]
        found.append((now_ns, turned))
    return found


def _build_good_files() -> dict[str, bytes]:
    shipped, model = (ROBOTS / "wombot.toml").read_bytes(), (ROBOTS / "wombot_model.toml").read_bytes()
    robot = shipped.decode()
    for old, new in (
        ("wombot_model.toml", "model.toml"),
        ('kind = "circle"\nradius_m = 0.75\n', 'path = "path.csv"\n'),
        ("[link]\n", '[link]\nkey_file = "robot.key"\n'),
    ):
        robot = robot.replace(old, new)
    rows = "".join(f"{0.05 * k:.2f},2,2,2,2,{0.006 * k:.3f},0,0,0\n" for k in range(100))
    command = {"mode": "SPEED", "left_speed": 2.0, "right_speed": 3.0, "valid_for": 0.1, "session": 1}
    sent = [Codec().encode("WHEEL_COMMAND", k % 16, **command) for k in range(20)]
    frames = "".join(f"(1700000000.{k:02d}) can0 {f.can_id:03X}#{f.data.hex().upper()}\n" for k, f in enumerate(sent))
    attached = (
        Attachment("robot.toml", "application/toml", shipped),
        Attachment("model.toml", "application/toml", model),
    )
    _GOOD.update(
        {
            "robot.toml": robot.encode(),
            "base.toml": shipped.replace(b"wombot_model", b"model").replace(
                b"[link]\n", b"[link]\n" + _ON_ROS.encode()
            ),
            "model.toml": model,
            "faults.toml": FAULTS.encode(),
            "path.csv": b"x_m,y_m\n0,0\n1,0\n2,0.5\n3,1.5\n",
            "robot.key": b"000102030405060708090a0b0c0d0e0f\n",
            "drive.csv": (CSV + rows).encode(),
            "bus.log": frames.encode(),
            "run.mcap": log_bytes(_as_the_wheels_turn(drive_ticks(260)), flush_every=50, attachments=attached),
        }
    )
    return _GOOD


def write_good(directory: Path) -> None:
    """Put the sound files into a directory."""
    for name, content in good_files().items():
        (directory / name).write_bytes(content)
        (directory / name).chmod(0o600)


def _begin(*_: object, **__: object) -> Any:
    raise WorkBeginsError


def _after(name: str) -> Callable[..., Any]:
    """The function, and then the end of the call."""
    module, _, function = name.rpartition(".")
    real = getattr(importlib.import_module(module), function)

    def called(*arguments: Any, **options: Any) -> Any:
        real(*arguments, **options)
        raise WorkBeginsError

    return called


_WORK = (
    "disco_hw.bridge.ros2.join_domain",
    "disco_hw.bridge.ros2_base.Clients",
    "disco_hw.daemon.check.refuse_while_daemon_runs",
    "disco_hw.daemon.send_request",
    "disco_hw.daemon.run._create_recorder",
    "disco_hw.daemon.emergency.open_transport",
    "disco_hw.daemon.emergency.open_port",
    "disco_hw.daemon.emergency.send_request",
    "disco_hw.experiments.virtual.run_virtual_robot",
    "disco_hw.experiments.adapt.run_adapt",
    "disco_hw.experiments.circle.run_circle",
    "disco_hw.experiments.gap._record",
    "disco_hw.gap.find_gap",
    "disco_hw.viewer.commands.serving",
)
_ENDS_AFTER = (
    "disco_hw.inference.infer_command.excitation",
    "disco_hw.daemon.run.create_link",
    "disco_hw.first_use.commission.link_key",
)
_WITHOUT = {
    "disco_hw.daemon.run.planner_of": lambda *_: NoPlanner(),
    "disco_hw.runtime.replay.create_planner": lambda *_: NoPlanner(),
    "disco_hw.drive.drive_command.leads_to_virtual_robot": lambda _: True,
}


@contextmanager
def without_work() -> Iterator[None]:
    """While it lasts, a verb ends where its work would begin."""
    patches = [patch(name, _begin) for name in _WORK]
    patches += [patch(name, _after(name)) for name in _ENDS_AFTER]
    patches += [patch(name, instead) for name, instead in _WITHOUT.items()]
    # Of a call's time the command's own making is nine tenths, and the same each time.
    patches += [
        patch.object(cli, "app", cache(cli.app)),
        patch("typer.main.get_command", cache(typer.main.get_command)),
    ]
    with patch.object(sys, "argv", ["disco-hw"]):
        for one in patches:
            one.start()
        try:
            yield
        finally:
            for one in patches:
                one.stop()


@dataclass(frozen=True, slots=True)
class CallOutcome:
    """Outcome of a call: `code` is the exit code, None where its work would have begun."""

    code: int | None
    errors: str


def call(argv: list[str]) -> CallOutcome:
    """Run `disco-hw` with these arguments, inside `without_work`; an exception that it lets through comes out."""
    sys.argv = ["disco-hw", *argv]
    errors = io.StringIO()
    with redirect_stdout(io.StringIO()), redirect_stderr(errors):
        try:
            cli.main()
        except WorkBeginsError:
            return CallOutcome(None, errors.getvalue())
        except SystemExit as end:
            return CallOutcome(int(end.code or 0), errors.getvalue())
    return CallOutcome(0, errors.getvalue())
