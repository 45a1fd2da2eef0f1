"""Fits a script into the fence: manoeuvres turned round, mirrored, in another order, and slower where they must be.

Pure. It takes a little time, so it is done a manoeuvre at a time while the robot stands. No robot is as its model says:
before a manoeuvre that would lead from its true place too near to the fence, what remains is fitted anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from disco_hw.drive import INPUT_LIMIT_NS, ManualInput, ManualSource, RobotView
from disco_hw.drive.script import (
    STANDING,
    Array,
    Manoeuvre,
    Pose,
    RobotModel,
    Room,
    Script,
    ScriptSource,
    Wheels,
    driven_path,
    end_of,
    stopping_path,
)
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime import State

SCALES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3)
"""Parts of a script's speeds that are tried, the largest first."""
SPARE_M = 0.08
"""Distance kept from the fence beyond its margin, for what the robot does otherwise than its model."""
# Chosen: more finds a manoeuvre that fits sooner, and leaves the script's order further.
_LOOK_AHEAD = 8
# As it is, mirrored, backward, and both.
_VARIANTS = (("", 1.0, False), ("mirrored", 1.0, True), ("backward", -1.0, False), ("mirrored, backward", -1.0, True))


class ScriptDoesNotFit(Exception):  # noqa: N818
    """No order and no speed brings the script into the fence; the message says how much room it needs."""


def fit_script(
    script: Script, start: Pose, robot: RobotModel, bounds: Boundaries, room: Room
) -> Iterator[Script | None]:
    """Yield None while it works, and at last a script that stays inside from this pose. Raises ScriptDoesNotFit.

    The robot stands there. `room`: what the script takes as it is, for the message.
    """
    keep_m = bounds.fence.margin_m + SPARE_M
    # All at one speed, the largest that there is; else each as fast as it can be.
    for scales in (*((scale,) for scale in SCALES), SCALES):
        remaining, chosen, pose, running = list(script.manoeuvres), list[Manoeuvre](), start, STANDING
        while remaining:
            each = (_next_that_fits(remaining, scale, pose, running, robot, bounds, keep_m) for scale in scales)
            found = next((one for one in each if one is not None), None)
            if found is None:
                break
            index, manoeuvre, pose, running = found
            chosen.append(manoeuvre)
            del remaining[index]
            yield None
        if not remaining:
            yield Script(script.name, tuple(chosen))
            return
    slowest = f"at {SCALES[-1]:.0%} of its speed either"
    raise ScriptDoesNotFit(
        f"script {script.name} does not fit into the fence from here, {slowest}; at its own speed it needs "
        f"{room.describe()}. Make room, or put the robot in the middle"
    )


def _next_that_fits(
    remaining: list[Manoeuvre],
    scale: float,
    pose: Pose,
    running: Wheels,
    robot: RobotModel,
    bounds: Boundaries,
    keep_m: float,
) -> tuple[int, Manoeuvre, Pose, Wheels] | None:
    """Return the first of the next manoeuvres that stays inside in some variant, and the pose and speeds at its end."""
    finds_limits = any(one.finds_limits for one in remaining)
    for index, manoeuvre in enumerate(remaining[:_LOOK_AHEAD]):
        if manoeuvre.within_limits and finds_limits:
            # The limits that it is scaled into are not found yet.
            continue
        for description, sign, mirrored in _VARIANTS:
            changed = _changed(manoeuvre, scale, description, sign, mirrored)
            path, reached = driven_path(changed, pose, robot, running)
            if _keeps(path, bounds, keep_m):
                return index, changed, end_of(path), reached
    return None


def _keeps(path: Array, bounds: Boundaries, keep_m: float) -> bool:
    """Whether a path stays so far from the fence; one that begins inside but nearer must not come nearer still."""
    clearance_m = bounds.clearance_m(path)
    return bool(clearance_m.min() >= min(keep_m, max(float(clearance_m[0]), 0.0)))


def _changed(manoeuvre: Manoeuvre, scale: float, description: str, sign: float, mirrored: bool) -> Manoeuvre:
    if scale == 1.0 and not description:
        return manoeuvre
    original = manoeuvre.wheels

    def wheels(t_s: float) -> Wheels:
        left, right = original(t_s)
        left, right = (right, left) if mirrored else (left, right)
        return sign * scale * left, sign * scale * right

    slower = "" if scale == 1.0 else f"at {scale:.0%}"
    note = ", ".join(part for part in (description, slower) if part)
    return replace(manoeuvre, wheels=wheels, purpose=f"{manoeuvre.purpose} ({note})")


class FittedScriptSource:
    """Plays a script, fitted into the fence from where the robot stands, while another source's deadman is held."""

    def __init__(
        self, script: Script, deadman: ManualSource, robot: RobotModel, bounds: Boundaries, room: Room
    ) -> None:
        self._script, self._deadman = script, deadman
        self._robot, self._bounds, self._room = robot, bounds, room
        self._fitting: Iterator[Script | None] | None = None
        self._playing: ScriptSource | None = None
        self._refused: str | None = None
        self._checked: tuple[int, int] | None = None

    @property
    def ended(self) -> str | None:
        """Reason why the drive has ended, or None: the script does not fit or is over, or the deadman ended."""
        return self._refused or (self._deadman.ended if self._playing is None else self._playing.ended)

    @property
    def completed(self) -> bool:
        """Whether the script was played to its end."""
        return self._playing is not None and self._playing.completed

    @property
    def status_text(self) -> str:
        """Text for the operator on the script's progress, and on what to do where nothing moves."""
        if self._playing is not None:
            return self._playing.status_text
        return "waiting for a pose, to fit the script into the fence" if self._fitting is None else "fitting the script"

    @property
    def task(self) -> str:
        """The manoeuvre under way, or next."""
        return "" if self._playing is None else self._playing.task

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """Fit one manoeuvre, and hold still meanwhile; once all are, play."""
        playing = self._playing
        if playing is None:
            self._fit(self._script, robot)
            # One that presses by itself once the robot is ready must wait for the script, too.
            held = self._deadman.poll(now_ns, replace(robot, state=State.HANDSHAKE))
            if held is None:
                return None
            # Held now, it is neither pressed nor open: too old an input is no release, after which a press would count.
            t_ns = held.t_ns - INPUT_LIMIT_NS - 1 if held.deadman else held.t_ns
            return ManualInput(t_ns, 0.0, 0.0, deadman=False)
        if self._fitting is None and self._leads_out(playing, robot):
            self._fitting = self._begin_fit(Script(self._script.name, playing.remaining), robot)
        if self._fitting is not None:
            self._fit(self._script, robot)
            held = self._deadman.poll(now_ns, robot)
            deadman = held is not None and held.deadman and self._refused is None
            return None if held is None else ManualInput(held.t_ns, 0.0, 0.0, deadman)
        return playing.poll(now_ns, robot)

    def close(self) -> None:
        """Close the source of the deadman."""
        self._deadman.close()

    def _leads_out(self, playing: ScriptSource, robot: RobotView) -> bool:
        """Whether a manoeuvre that begins now would lead from where the robot is into the fence's margin."""
        # Not before it is armed, as until then it may be moved.
        if playing.begun == self._checked or robot.state is not State.ARMED:
            return False
        if robot.pose is None or not playing.remaining:
            return False
        self._checked = playing.begun
        path, _ = driven_path(playing.remaining[0], robot.pose, self._robot, robot.wheels or STANDING)
        return not _keeps(path, self._bounds, self._bounds.fence.margin_m + 0.5 * SPARE_M)

    def _begin_fit(self, script: Script, robot: RobotView) -> Iterator[Script | None] | None:
        """Fit the script from where the robot comes to stand."""
        if robot.pose is None:
            return None
        start = end_of(stopping_path(robot.pose, self._robot, robot.wheels or STANDING))
        return fit_script(script, start, self._robot, self._bounds, self._room)

    def _fit(self, script: Script, robot: RobotView) -> None:
        """Go on fitting, or begin to; what comes out is played."""
        if self._refused is not None:
            return
        if self._fitting is None:
            self._fitting = self._begin_fit(script, robot)
        if self._fitting is None:
            return
        try:
            fitted = next(self._fitting)
        except ScriptDoesNotFit as refusal:
            self._refused = str(refusal)
            return
        if fitted is None:
            return
        self._fitting, self._checked = None, None
        if self._playing is None:
            self._playing = ScriptSource(fitted, self._deadman)
        else:
            self._playing.replace_remaining(fitted.manoeuvres)
