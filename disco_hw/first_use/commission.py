"""Guided first drive of `disco-hw commission` over the daemon's own path, its findings, and robot.toml corrected."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from disco_hw.config import Robot, load_robot_config
from disco_hw.daemon.loop import MonotonicClock
from disco_hw.daemon.process import STANDARD_ERROR, STANDARD_INPUT, AsyncPrinter
from disco_hw.daemon.run import in_text, new_log, serve
from disco_hw.drive.terminal import Keyboard, KeyHold
from disco_hw.errors import InputError, WorkError
from disco_hw.fence import Fence
from disco_hw.files import ROBOT_TOML, read_bytes
from disco_hw.first_use import in_toml, with_fields
from disco_hw.first_use.judgement import Findings, evaluate_floor, evaluate_sides, evaluate_turns
from disco_hw.first_use.procedure import CommissionPilot, Procedure, Steps, floor, sides, turns
from disco_hw.reports import refuse_directory
from disco_hw.runtime.robot_setup import Setup, link_key, load_setup
from drivers.motor import find_driver
from drivers.pose import AS_OURS

# Chosen: a fault may hide another; what is not mended by then needs a person who looks.
_MOST_TRIES = 3
_UP = "wheels off the ground"
_DOWN = "on the floor, with 1.5 m free around it"


@dataclass(frozen=True, slots=True)
class GuidedStage:
    """A part of the drive: where the robot is, what is driven, and what that says of a robot."""

    name: str
    where: str
    steps: Callable[[Robot, float], Steps]
    evaluate: Callable[[Any, Setup], Findings]
    raw_poses: bool = False


def _evaluate_turns(seen: Any, setup: Setup) -> Findings:
    link = setup.config.link
    card = find_driver(link.driver).safety_card(link.settings())
    return evaluate_turns(seen, setup.config.wheels, card.reaction_s, card.brakes)


STAGES = (
    GuidedStage("sides", _UP, sides, lambda seen, of: evaluate_sides(seen, of.config.wheels, of.config.robot)),
    GuidedStage("turns", _UP, turns, _evaluate_turns),
    GuidedStage(
        "floor",
        _DOWN,
        floor,
        lambda seen, of: evaluate_floor(seen, of.config.pose.convention(), of.config.robot),
        raw_poses=True,
    ),
)


@dataclass(frozen=True, slots=True)
class CommissionOptions:
    """Options of `disco-hw commission`; `write`: mend robot.toml, None asks; `stages`: names of `STAGES`."""

    robot: Path
    link: str | None = None
    stages: tuple[str, ...] = tuple(stage.name for stage in STAGES)
    write: bool | None = None
    log_directory: Path | None = None


@dataclass(frozen=True, slots=True)
class CommissionResult:
    """Result of commissioning by stage: figures, faults with whether they were corrected, and the logs."""

    stages: tuple[dict[str, Any], ...]
    ok: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict."""
        return {"ok": self.ok, "stages": list(self.stages)}

    def as_text(self) -> str:
        """Return the result as text."""
        lines = []
        for stage in self.stages:
            lines += [f"{stage['name']}: {figure}" for figure in stage["figures"]]
            for fault in stage["faults"]:
                lines.append(f"{stage['name']}: {fault['name']}: {'corrected' if fault['mended'] else fault['text']}")
        return "\n".join([*lines, "commissioned" if self.ok else "not commissioned: correct what is named above"])


def as_sent(setup: Setup) -> Setup:
    """Return the robot with its poses as the first source sends them, without those of others and without the fence.

    While their units, axes and frame are in question, a fence would stop the robot anywhere, or nowhere.
    """
    pose = msgspec.structs.replace(setup.config.pose, also=(), **msgspec.structs.asdict(AS_OURS))
    return replace(setup, config=msgspec.structs.replace(setup.config, pose=pose, fence=Fence()))


def run_commission(options: CommissionOptions, ask: Callable[[str], str] = input) -> CommissionResult:
    """Guide a person through the stages; each is driven again after robot.toml was mended.

    A stage begins only when the ones before it found nothing, or what they found was mended. `ask`: how a person is
    asked between the drives. Raises InputError for wrong options and files, or without a terminal.
    """
    known = {stage.name: stage for stage in STAGES}
    for name in options.stages:
        if name not in known:
            raise InputError(f"--stage {name}: no such stage; write one of {', '.join(known)}")
    setup = load_setup(options.robot, None, options.link)
    refuse_directory(options.log_directory or Path(setup.config.log.directory))
    link_key(setup)
    if not os.isatty(STANDARD_INPUT):
        raise InputError(
            "commission: standard input is not a terminal; it needs an operator at the robot: use a terminal"
        )
    if setup.config.pose.also:
        _print("poses", "only the first source is examined; `disco-hw check` compares those of [[pose.also]] with it")
    fence = setup.config.fence
    has_fence = fence.is_set or fence.obstacles_port is not None
    if has_fence and any(known[name].raw_poses for name in options.stages):
        _print("fence", f"not in force in the stage floor, which takes poses as they are sent; put the robot {_DOWN}")
    reports: list[dict[str, Any]] = []
    for name in options.stages:
        if not _through(known[name], options, ask, reports):
            return CommissionResult(tuple(reports), ok=False)
    return CommissionResult(tuple(reports), ok=True)


def _through(
    stage: GuidedStage, options: CommissionOptions, ask: Callable[[str], str], reports: list[dict[str, Any]]
) -> bool:
    """Drive one stage until it finds nothing; whether it did."""
    ask(f"\n{stage.name}: put the robot {stage.where}, with somebody at its stop button; then press Enter ")
    for _ in range(_MOST_TRIES):
        setup = load_setup(options.robot, None, options.link)
        findings = stage.evaluate(_drive(stage, setup, options), setup)
        for line in (*findings.figures, *(f"{fault.name.upper()}: {fault.text}" for fault in findings.faults)):
            _print("found", line)
        mended = bool(findings.edits) and all(fault.edits for fault in findings.faults)
        if mended:
            mended = write_fields(options, findings.edits, ask)
        faults = [{"name": f.name, "text": f.text, "mended": mended} for f in findings.faults]
        reports.append({"name": stage.name, "figures": list(findings.figures), "faults": faults})
        if not findings.faults:
            return True
        if not mended:
            return False
        ask("corrected; press Enter to test it again ")
    return False


def is_yes(reply: str) -> bool:
    """Whether an operator's reply says yes."""
    return reply.strip().lower() in {"y", "yes"}


def write_fields(
    options: CommissionOptions, edits: dict[tuple[str, str], Any], ask: Callable[[str], str] = input
) -> bool:
    """Offer to write fields into robot.toml, and write them, the file of before kept beside it; whether it was done.

    What `load_robot_config` would refuse, or what cannot be written, raises WorkError; robot.toml is as it was.
    """
    for (section, name), value in edits.items():
        print(f"  [{section}] {name} = {in_toml(value)}", file=sys.stderr)
    write = options.write
    if write is None:
        write = is_yes(ask(f"write this into {options.robot}? [y/n] "))
    if not write:
        return False
    old, _ = read_bytes(options.robot, ROBOT_TOML)
    trial = options.robot.with_name(f".{options.robot.name}.new")
    try:
        trial.write_text(with_fields(old.decode("utf-8-sig"), edits), encoding="utf-8")
        load_robot_config(trial)
        options.robot.with_name(f"{options.robot.name}.before").write_bytes(old)
        trial.replace(options.robot)
    except InputError as error:
        trial.unlink()
        raise WorkError(
            f"{options.robot}: not changed, as the corrected file would be refused ({error}); edit it by hand"
        ) from None
    except OSError as error:
        trial.unlink(missing_ok=True)
        raise WorkError(f"{options.robot}: not changed ({error.strerror}); edit it by hand") from None
    return True


def _drive(stage: GuidedStage, setup: Setup, options: CommissionOptions) -> Any:
    """One drive through the daemon; what its procedure returned. Raises WorkError if the person gave up."""
    log = new_log(setup.config, f"commission-{stage.name}-", options.log_directory)
    keyboard = Keyboard(STANDARD_INPUT, KeyHold(0.0), MonotonicClock())
    procedure = Procedure(stage.steps(setup.config.robot, setup.config.slowest_wheel_rad_s))
    pilot = CommissionPilot(procedure, keyboard, keyboard.typed, lambda: keyboard.is_ignored)
    try:
        _print("keys", "hold the space bar to drive, let go to stop; Ctrl-D gives up")
        with closing(AsyncPrinter(STANDARD_ERROR, in_text)) as show:
            serve(as_sent(setup) if stage.raw_poses else setup, log, show, pilot)
    finally:
        keyboard.close()
    if pilot.fault_text is not None:
        raise WorkError(f"commission: stopped in the stage {stage.name}: {pilot.fault_text}")
    if pilot.procedure.action is not None:
        raise WorkError(f"commission: ended in the stage {stage.name}; continue with --stage {stage.name}")
    return pilot.procedure.result


def _print(topic: str, text: str) -> None:
    print(in_text(topic, text), file=sys.stderr, flush=True)
