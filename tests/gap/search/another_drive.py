"""What a model that was written predicts of another drive of the same robot of `tools/gap/strange_robot.py`.

Errors of free runs of the model's own step, 2 s ahead from single poses and readings of the wheels, with what the
runtime keeps of the past, or with nothing remembered, or without the model's terms.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.control import PlannerState, SentCommand
from disco_hw.control.past_motion import DriveMeans, PastMotion
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from disco_hw.model.step import FreeRun
from disco_hw.model.terms import TERMS
from tools.gap import strange_robot
from tools.joystick import joystick

Array = NDArray[np.float64]
AHEAD_S, STEP_S, BEFORE_STEPS = 2.0, 0.02, 50
FIRST_S = 3.0
OTHER_SEED = 5000


class Past:
    """What is remembered along a log, from one time to a later one."""

    def __init__(self, model: Model, log: DriveLog) -> None:
        point, asked = model.point()[None], log.commands
        self._motion, self._means = PastMotion.of(model, point, point), DriveMeans.of(model)
        rows = zip(asked.t_s.tolist(), asked.left_rad_s.tolist(), asked.right_rad_s.tolist(), strict=True)
        self._sent = [SentCommand(round(1e9 * t_s), left, right) for t_s, left, right in rows]
        self._wheels, self._taken = log.wheels, 0

    def means(self, t_s: float, reading: int) -> Array | None:
        """The means at a time, at which this was the last reading of the wheels; None for a model without memory."""
        if self._motion is None or self._means is None:
            return None
        wheels = self._wheels
        for k in range(self._taken, reading):
            held_s = float(wheels.t_s[k + 1] - wheels.t_s[k])
            self._means.add_wheels(float(wheels.left_speed_rad_s[k]), float(wheels.right_speed_rad_s[k]), held_s)
        self._taken, now_ns = reading, round(1e9 * t_s)
        speeds = float(wheels.left_speed_rad_s[reading]), float(wheels.right_speed_rad_s[reading])
        sent = tuple(one for one in self._sent if one.t_ns <= now_ns)
        state = PlannerState(now_ns, 0.0, 0.0, 0.0, *speeds, sent=sent, body_means=self._means.body)
        return self._motion.of_mean(state, now_ns)


def errors_ahead(model: Model, log: DriveLog, remembers: bool = True) -> tuple[float, float]:
    """Root mean square errors of position (m) and heading (rad) of free runs of a model from the commands alone."""
    run, past = FreeRun(model, model.point()[None], STEP_S), Past(model, log)
    asked, wheels, poses, squares = log.commands, log.wheels, log.poses, []
    for near_s in np.arange(FIRST_S, poses.t_s[-1] - AHEAD_S - 1.0, 1.0):
        begin, end = (int(np.argmin(np.abs(poses.t_s - t_s))) for t_s in (near_s, near_s + AHEAD_S))
        begin_s = float(poses.t_s[begin])
        grid_s = begin_s + STEP_S * np.arange(-BEFORE_STEPS, round(AHEAD_S / STEP_S) + 2)
        index = np.clip(np.searchsorted(asked.t_s, grid_s + 1e-3, side="right") - 1, 0, None)
        commands = np.column_stack([asked.left_rad_s[index], asked.right_rad_s[index]])
        now = int(np.argmin(np.abs(wheels.t_s - begin_s)))
        speeds = wheels.left_speed_rad_s[now], wheels.right_speed_rad_s[now]
        start = np.array([poses.x_m[begin], poses.y_m[begin], poses.yaw_rad[begin], *speeds])
        means = past.means(begin_s, now) if remembers else None
        states = run.states(start, commands, BEFORE_STEPS, begin_s, means=means)
        steps = (poses.t_s[end] - begin_s) / STEP_S
        x, y, yaw = (float(np.interp(steps, np.arange(len(states)), states[:, axis])) for axis in range(3))
        off_rad = math.remainder(yaw - poses.yaw_rad[end], 2.0 * math.pi)
        squares.append(((x - poses.x_m[end]) ** 2 + (y - poses.y_m[end]) ** 2, off_rad**2))
    position_m, yaw_rad = np.sqrt(np.mean(squares, axis=0)).tolist()
    return position_m, yaw_rad


def another_drive(form: str, seed: int) -> DriveLog:
    """The same robot, driven by another joystick."""
    return strange_robot.record(form, seed, joystick(seed + OTHER_SEED, strange_robot.DURATION_S)).log


def without_terms(model: Model) -> Model:
    """A model without its terms, the other values as they are."""
    return replace(model, belief=None, effects=tuple(one for one in model.effects if one.name not in TERMS))
