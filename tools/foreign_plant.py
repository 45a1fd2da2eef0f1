"""A skid-steer robot to judge controllers on, written apart from this project's simulator and model: nothing is shared.

Two rows of tyres push a body that has mass and inertia, with a force that grows with their slip and then saturates, and
build it up over a relaxation length; motors lag and have a dead band; grip varies slowly and by itself on either side.
Wheels are known through ticks, the pose with noise and late. In steady motion the robot has a wheel radius, an axle and
a centre of rotation; between steady motions it has none. Another body can take the place of this one behind the same
sensors (`tools/mujoco_plant.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from drivers.kernel_cache import compiled
from drivers.types import PoseSample, Readings, WheelSample

STEP_S = 0.001
_SAMPLES_EVERY, _POSES_EVERY = 20, 40
# Columns of the state.
_X, _Y, _YAW, _V, _SIDE, _OMEGA, _LEFT, _RIGHT, _FORCE_L, _FORCE_R, _ANGLE_L, _ANGLE_R, _GRIP_L, _GRIP_R = range(14)


NOMINAL = (0.061, 0.415, 0.238)


@dataclass(frozen=True, slots=True)
class ForeignRobot:
    """Parameters of the plant in SI units: `grip_std` is slip as a part of the speed, correlated over `grip_s`.

    `believed`: the wheel radius, axle and x_icr that controllers are given. `turned`: its back is called its front.
    """

    radius_m: float
    axle_m: float
    x_icr_m: float
    lag_s: float = 0.15
    dead_rad_s: float = 0.3
    mass_kg: float = 68.0
    inertia_kg_m2: float = 4.9
    push_n: float = 260.0
    push_at_m_s: float = 0.07
    relaxation_m: float = 0.012
    side_s: float = 0.04
    grip_std: float = 0.04
    grip_s: float = 0.12
    ticks: int = 1860
    pose_std_m: float = 0.003
    yaw_std_rad: float = 0.004
    pose_delay_s: float = 0.02
    slope_m_s: float = 0.0
    left_gain: float = 1.0
    believed: tuple[float, float, float] = NOMINAL
    turned: bool = False


def turned_robot(robot: ForeignRobot) -> ForeignRobot:
    """The same machine under a controller that drives it the other way round.

    Left is right, ahead is behind, and the centre of rotation lies on the other side of the tracked point. Which end of
    a skid-steer robot is called its front is up to its owner, and following a line is easier for a tracked point that
    lies ahead of the centre of rotation.
    """
    radius_m, axle_m, x_icr_m = robot.believed
    return replace(robot, x_icr_m=-robot.x_icr_m, believed=(radius_m, axle_m, -x_icr_m), turned=not robot.turned)


def robots(first: int, count: int, spread: float = 0.15, **changes: Any) -> list[ForeignRobot]:
    """Robots `first` to `first + count` - 1: wheel radius, axle and centre of rotation within `spread` of nominal."""
    found = []
    for number in range(first, first + count):
        factors = 1.0 + spread * np.random.default_rng([number, 77]).uniform(-1.0, 1.0, 3)
        found.append(ForeignRobot(*(np.array(NOMINAL) * factors).tolist(), **changes))
    return found


@compiled
def _advance(state: Any, left: float, right: float, numbers: Any, noise: Any) -> None:
    (radius, axle, x_icr, lag, dead, mass, inertia, push, push_at, relaxation, side, grip_std, grip_s, slope, gain) = (
        numbers
    )
    for one in noise:
        for wheel, command in ((0, left * gain), (1, right)):
            target = math.copysign(max(abs(command) - dead, 0.0), command)
            state[_LEFT + wheel] += (target - state[_LEFT + wheel]) * STEP_S / lag
            state[_ANGLE_L + wheel] += state[_LEFT + wheel] * STEP_S
            keep = STEP_S / grip_s
            state[_GRIP_L + wheel] += -state[_GRIP_L + wheel] * keep + grip_std * math.sqrt(2.0 * keep) * one[wheel]
            out = axle * (0.5 if wheel else -0.5)
            rolling = radius * state[_LEFT + wheel]
            slip = rolling * (1.0 - state[_GRIP_L + wheel]) - (state[_V] + out * state[_OMEGA])
            steady = push * math.tanh(slip / push_at)
            build = min(STEP_S * (abs(rolling) + 0.3) / relaxation, 1.0)
            state[_FORCE_L + wheel] += (steady - state[_FORCE_L + wheel]) * build
        force, moment = state[_FORCE_L] + state[_FORCE_R], 0.5 * axle * (state[_FORCE_R] - state[_FORCE_L])
        state[_V] += STEP_S * force / mass
        state[_OMEGA] += STEP_S * moment / inertia
        state[_SIDE] += (-x_icr * state[_OMEGA] - state[_SIDE]) * STEP_S / side
        cosine, sine = math.cos(state[_YAW]), math.sin(state[_YAW])
        state[_X] += STEP_S * (state[_V] * cosine - state[_SIDE] * sine)
        # The ground carries a robot that moves downhill: to negative y.
        moving = min((abs(state[_LEFT]) + abs(state[_RIGHT])) * 2.0, 1.0)
        state[_Y] += STEP_S * (state[_V] * sine + state[_SIDE] * cosine - slope * moving)
        state[_YAW] += STEP_S * state[_OMEGA]


class Body(Protocol):
    """A body in the place of this plant's own, at rest where the plant begins."""

    def advance(self, state: np.ndarray, left_rad_s: float, right_rad_s: float, until_ms: int) -> None:
        """Hold these wheel commands until a time; write pose, forward speed and the wheels' angles into the state."""


class ForeignPlant:
    """A robot at rest at a pose (x, y, yaw); all noise comes from the seed."""

    def __init__(
        self, robot: ForeignRobot, start: tuple[float, float, float], seed: int, body: Body | None = None
    ) -> None:
        self.state = np.zeros(14)
        self.state[:3] = start[0], start[1], start[2] + (math.pi if robot.turned else 0.0)
        self.now_ms = 0
        self._body = body
        self._rng = np.random.default_rng([seed, 5])
        self._delayed: list[tuple[int, PoseSample]] = []
        self._past = [(0, 0)] * 3
        self.become(robot)

    def become(self, robot: ForeignRobot) -> None:
        """Go on as another robot from now on."""
        self.robot = r = robot
        x_icr_m = -r.x_icr_m if r.turned else r.x_icr_m
        self._numbers = (
            r.radius_m, r.axle_m, x_icr_m, r.lag_s, r.dead_rad_s, r.mass_kg, r.inertia_kg_m2, r.push_n, r.push_at_m_s,
            r.relaxation_m, r.side_s, r.grip_std, r.grip_s, r.slope_m_s, r.left_gain,
        )  # fmt: skip

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose of the robot: x, y (m), yaw (rad)."""
        x, y, yaw = self.state[:3].tolist()
        return x, y, yaw + math.pi if self.robot.turned else yaw

    @property
    def forward_m_s(self) -> float:
        """True speed along the body."""
        return float(-self.state[_V] if self.robot.turned else self.state[_V])

    @property
    def wheels_rad_s(self) -> tuple[float, float]:
        """True speeds of the wheels."""
        left, right = self.state[_LEFT : _RIGHT + 1].tolist()
        return left, right

    @property
    def now_ns(self) -> int:
        """Time of the plant, ns."""
        return self.now_ms * 1_000_000

    def readings(self) -> Readings:
        """Return the sensors' samples at this time.

        Wheels every 20 ms, poses every 40 ms, some time after they were true.
        """
        wheels, poses = [], []
        if self.now_ms % _SAMPLES_EVERY == 0:
            tick = 2.0 * math.pi / self.robot.ticks
            left, right = (math.floor(angle / tick) for angle in self.state[_ANGLE_L : _ANGLE_R + 1].tolist())
            span = tick / (len(self._past) * _SAMPLES_EVERY * STEP_S)
            speeds = (left - self._past[0][0]) * span, (right - self._past[0][1]) * span
            self._past = [*self._past[1:], (left, right)]
            values = (left * tick, right * tick, *speeds)
            if self.robot.turned:
                values = (-right * tick, -left * tick, -speeds[1], -speeds[0])
            wheels.append(WheelSample(self.now_ns, self.now_ns, *values))
        if self.now_ms % _POSES_EVERY == 0:
            x, y, yaw = self.pose + self._rng.standard_normal(3) * self._pose_std()
            due = self.now_ms + round(self.robot.pose_delay_s / STEP_S)
            stamp = self.now_ns
            sample = PoseSample(
                stamp, due * 1_000_000, float(x), float(y), math.remainder(float(yaw), 2.0 * math.pi),
                self.robot.pose_std_m, self.robot.yaw_std_rad,
            )  # fmt: skip
            self._delayed.append((due, sample))
        while self._delayed and self._delayed[0][0] <= self.now_ms:
            poses.append(self._delayed.pop(0)[1])
        return Readings(wheels=tuple(wheels), poses=tuple(poses))

    def advance(self, left_rad_s: float, right_rad_s: float, count: int, /) -> None:
        """Hold these wheel commands for `count` milliseconds."""
        if self.robot.turned:
            left_rad_s, right_rad_s = -right_rad_s, -left_rad_s
        self.now_ms += count
        if self._body is None:
            _advance(self.state, left_rad_s, right_rad_s, self._numbers, self._rng.standard_normal((count, 2)))
        else:
            self._body.advance(self.state, left_rad_s, right_rad_s, self.now_ms)

    def _pose_std(self) -> np.ndarray:
        return np.array([self.robot.pose_std_m, self.robot.pose_std_m, self.robot.yaw_std_rad])
