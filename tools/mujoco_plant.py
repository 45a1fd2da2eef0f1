"""The skid-steer robot of `tools/mujoco_robot.py` under a controller: contact and servos are MuJoCo's.

What is tracked is a point BEHIND_M behind its middle, so that it has a centre of rotation to be learnt. Its sensors are
those of the foreign plant: ticks of the motors, poses with the same noise, as late.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tools.foreign_plant import ForeignPlant, ForeignRobot
from tools.mujoco_robot import STEPS_PER_S, WHEEL_RADIUS_M, mjcf

BEHIND_M = 0.2
# What turning at the speed and radius of the circle shows, and how the wheels rise to a command.
AXLE_M, LAG_S = 1.1, 0.08
_SETTLES_S = 1
_FORWARD, _ANGLES = 3, slice(10, 12)
"""Columns of the plant's state."""


def mujoco_robots(first: int, count: int, spread: float = 0.15) -> list[ForeignRobot]:
    """The one robot as it is believed by `count` controllers: its three lengths within `spread` of what they are."""
    truth = np.array([WHEEL_RADIUS_M, AXLE_M, BEHIND_M])
    found = []
    for number in range(first, first + count):
        factors = 1.0 + spread * np.random.default_rng([number, 78]).uniform(-1.0, 1.0, 3)
        radius_m, axle_m, x_icr_m = (truth * factors).tolist()
        believed = (radius_m, axle_m, x_icr_m)
        found.append(ForeignRobot(WHEEL_RADIUS_M, AXLE_M, BEHIND_M, lag_s=LAG_S, dead_rad_s=0.0, believed=believed))
    return found


def mujoco_plant(robot: ForeignRobot, start: tuple[float, float, float], seed: int) -> ForeignPlant:
    """A robot at rest with its tracked point at a pose (x, y, yaw); all noise comes from the seed."""
    heading_rad = start[2] + (math.pi if robot.turned else 0.0)
    return ForeignPlant(robot, start, seed, _MujocoBody((start[0], start[1], heading_rad)))


class _MujocoBody:
    """The robot in MuJoCo, settled on its floor."""

    def __init__(self, start: tuple[float, float, float]) -> None:
        import mujoco  # noqa: PLC0415  (of those who drive it only)

        self._step = mujoco.mj_step
        self._model: Any = mujoco.MjModel.from_xml_string(mjcf({}))
        self._data: Any = mujoco.MjData(self._model)
        x_m, y_m, yaw_rad = start
        place = x_m + BEHIND_M * math.cos(yaw_rad), y_m + BEHIND_M * math.sin(yaw_rad)
        self._data.qpos[:2] = place
        self._data.qpos[3:7] = math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)
        for _ in range(_SETTLES_S * STEPS_PER_S):
            self._step(self._model, self._data)
        self._motors = [self._model.joint(name).qposadr[0] for name in ("fl", "fr", "rl", "rr")]
        self._turned = self._data.qpos[self._motors].copy()
        self._steps = 0

    def advance(self, state: np.ndarray, left_rad_s: float, right_rad_s: float, until_ms: int) -> None:
        """Hold these wheel commands until a time; write pose, forward speed and the wheels' angles into the state."""
        data = self._data
        data.ctrl[:] = left_rad_s, right_rad_s, left_rad_s, right_rad_s
        while self._steps < round(until_ms * STEPS_PER_S / 1000):
            self._step(self._model, data)
            self._steps += 1
        w, x, y, z = data.qpos[3:7].tolist()
        before = float(state[2])
        yaw_rad = before + math.remainder(
            math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) - before, math.tau
        )
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        state[:3] = data.qpos[0] - BEHIND_M * cosine, data.qpos[1] - BEHIND_M * sine, yaw_rad
        state[_FORWARD] = data.qvel[0] * cosine + data.qvel[1] * sine
        turned = data.qpos[self._motors] - self._turned
        state[_ANGLES] = 0.5 * (turned[:2] + turned[2:])
