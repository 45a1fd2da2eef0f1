"""Simulation of the physical robot: wheel setpoints in, encoder ticks, poses and motor readings out; and the truth.

Command -> wheels -> encoders and body -> pose sensor, integrated on an absolute time grid of `integration_step_us`.
Everything random comes from the seed; disturbances belong to cells of that grid, so that the trajectory does not depend
on how a run is cut into calls of `step`.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from operator import attrgetter

import msgspec
import numpy as np
import numpy.typing as npt

from drivers.kernel_cache import compiled
from sim.body_dynamics import Body, BodyPose
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters
from sim.sensors import Electrics, Encoders, PoseMeasurement, SampledPoseSensor, wrapped
from sim.wheel_dynamics import WheelMotors

# Chosen: random numbers are drawn for so many cells at once; more wait longer for each block.
CELLS = 1024
Array = npt.NDArray[np.float64]
# Chosen: voltages and temperatures change slowly beside it.
ELECTRICS_STEP_US = 10_000
_available_us = attrgetter("available_us")


class TrueState(msgspec.Struct, frozen=True, gc=False):
    """True state of the robot at plant time `t_us`, which nothing on board knows.

    Pose of the tracked point in the world frame (m, rad; yaw in (-pi, pi]); wheel speeds (rad/s); velocity of the
    tracked point in the body frame: forward, left (m/s), yaw rate (rad/s).
    """

    t_us: int
    x_m: float
    y_m: float
    yaw_rad: float
    left_speed_rad_s: float
    right_speed_rad_s: float
    speed_m_s: float
    yaw_rate_rad_s: float


class Plant:
    """A skid-steer robot with hidden effects; `electrics` are the readings of its battery and motors.

    `effects`: from `sim.effects.hidden_effects`. `seed` decides all disturbances and noise. Plant time starts at 0 us
    with the robot at rest at `start`.
    """

    def __init__(
        self,
        parameters: PlantParameters | None = None,
        effects: HiddenEffects | None = None,
        seed: int = 0,
        start: BodyPose | None = None,
    ) -> None:
        self.parameters = parameters or PlantParameters()
        self.effects = effects or HiddenEffects()
        disturbance_seed, pose_seed = np.random.SeedSequence(seed).spawn(2)
        self._disturbances = Disturbances(self.parameters, disturbance_seed)
        self._wheels = WheelMotors(self.parameters, self.effects, capacity=CELLS)
        self._encoders = Encoders(self.parameters, self.effects)
        self._body = Body(self.parameters, self.effects, start or BodyPose())
        self._pose_sensor = SampledPoseSensor(self.parameters, self.effects, pose_seed)
        self.electrics = Electrics(self.parameters, self.effects)
        self._step_us = self.parameters.integration_step_us
        self._delay_us = round(self.effects.values("command_delay")[0] * 1e6)
        self._now_us = 0
        self._commanded = (0.0, 0.0)
        self._in_force = (0.0, 0.0)
        self._delayed: deque[tuple[int, tuple[float, float]]] = deque()
        self._poses: list[PoseMeasurement] = []

    @property
    def now_us(self) -> int:
        """Plant time in us, from the start."""
        return self._now_us

    @property
    def encoder_ticks(self) -> tuple[int, int]:
        """Cumulative encoder ticks, left and right; never wrapped here."""
        return self._encoders.ticks

    @property
    def measured_wheel_speeds_rad_s(self) -> tuple[float, float]:
        """Wheel speeds that the controller makes of the ticks, left and right."""
        return self._encoders.speeds_rad_s

    @property
    def wheel_speeds_rad_s(self) -> tuple[float, float]:
        """True wheel speeds now, left and right."""
        return self._wheels.speeds_rad_s

    @property
    def truth(self) -> TrueState:
        """The true state now."""
        pose = self._body.pose
        left, right = self._wheels.speeds_rad_s
        speed, _, yaw_rate = self._body.velocity
        return TrueState(self._now_us, pose.x_m, pose.y_m, wrapped(pose.yaw_rad), left, right, speed, yaw_rate)

    def step(
        self,
        until_us: int,
        left_setpoint_rad_s: float,
        right_setpoint_rad_s: float,
        enabled: bool = True,
        brake: bool = False,
    ) -> list[PoseMeasurement]:
        """Move on to plant time `until_us` with these wheel-speed setpoints held.

        Without `enabled` the wheels coast; `brake` shorts the motors and wins over `enabled`. Returns the poses that
        have become available, by the time they did. Raises ValueError if time would go backwards.
        """
        if until_us < self._now_us:
            raise ValueError(f"plant time is {self._now_us} us and cannot go back to {until_us} us")
        self._set_command((left_setpoint_rad_s, right_setpoint_rad_s))
        while self._now_us < until_us:
            self._advance(self._apply_due(until_us), enabled, brake)
        if not self._poses:
            return []
        ready = bisect.bisect_right(self._poses, until_us, key=_available_us)
        poses, self._poses[:ready] = self._poses[:ready], []
        return poses

    def kidnap(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Carry the robot off: a step in the world frame and a turn about the tracked point, wheels untouched."""
        self._body.displace(dx_m, dy_m, dyaw_rad)

    def _set_command(self, setpoints: tuple[float, float]) -> None:
        if setpoints != self._commanded:
            self._commanded = setpoints
            self._delayed.append((self._now_us + self._delay_us, setpoints))

    def _apply_due(self, until_us: int) -> int:
        """Put the command in force that is due now; return until when nothing changes."""
        while self._delayed and self._delayed[0][0] <= self._now_us:
            self._in_force = self._delayed.popleft()[1]
        next_us = self._delayed[0][0] if self._delayed else until_us
        electrics_us = (self._now_us // ELECTRICS_STEP_US + 1) * ELECTRICS_STEP_US
        cell = self._now_us // self._step_us
        self._disturbances.move_to(cell)
        block_us = (self._disturbances.first_cell + CELLS) * self._step_us
        return min(until_us, next_us, electrics_us, block_us)

    def _advance(self, until_us: int, enabled: bool, brake: bool) -> None:
        now_us = self._now_us
        noise = self._disturbances
        wheels = self._wheels
        left, right = self._in_force
        count = wheels.advance(now_us, until_us, left, right, enabled, brake, noise.wheel, noise.first_cell)
        self._encoders.advance(now_us, wheels.pieces, count)
        sensor = self._pose_sensor
        piece = 0
        while piece < count:
            piece = self._body.advance(
                wheels.pieces, piece, count, sensor.next_true_us, noise.slip, noise.first_cell, self._step_us
            )
            reached_us = until_us if piece == count else wheels.pieces.times_us[piece - 1]
            while sensor.next_true_us <= reached_us:
                measurement = sensor.sample(self._body.pose_at(sensor.next_true_us))
                if measurement is not None:
                    bisect.insort(self._poses, measurement, key=_available_us)
        if until_us % ELECTRICS_STEP_US == 0:
            self.electrics.advance(until_us * 1e-6, ELECTRICS_STEP_US * 1e-6, wheels.torques_nm, wheels.speeds_rad_s)
        self._now_us = until_us


class Disturbances:
    """Blocks of `CELLS` grid cells, each `integration_step_us` long.

    `wheel`: shape (CELLS, 2), relative error of the left and right wheel speed. `slip`: shape (CELLS, 3), velocity of
    the body that the wheels do not cause: forward (m/s), left (m/s), yaw rate (rad/s). Row 0 is cell `first_cell`.

    Each is an Ornstein-Uhlenbeck process; `volatility` > 0 multiplies it by exp(volatility q - volatility^2) with q
    another such process of unit variance, which keeps the variance and makes the tails heavy and bursty.
    """

    def __init__(self, parameters: PlantParameters, seed: np.random.SeedSequence) -> None:
        wheel_seed, slip_seed = seed.spawn(2)
        self._wheel_generator = np.random.default_rng(wheel_seed)
        self._slip_generator = np.random.default_rng(slip_seed)
        p = parameters
        dt = p.integration_step_us * 1e-6
        fast = math.exp(-dt / p.wheel_disturbance_correlation_s)
        slow = math.exp(-dt / p.wheel_drift_correlation_s)
        slip = math.exp(-dt / p.slip_correlation_s)
        burst = math.exp(-dt / p.volatility_correlation_s)
        self._wheel_decay = np.array([fast, fast, slow, slow, burst])
        self._slip_decay = np.array([slip, slip, slip, burst])
        self._wheel_std = p.wheel_disturbance_std
        self._drift_std = p.wheel_drift_std
        self._slip_std = np.array([p.slip_std_x_m_s, p.slip_std_y_m_s, p.slip_std_yaw_rad_s])
        self._volatility = p.volatility
        self._wheel_last = self._wheel_generator.standard_normal(len(self._wheel_decay))
        self._slip_last = self._slip_generator.standard_normal(len(self._slip_decay))
        self.first_cell = 0
        self.wheel = self._wheel_block()
        self.slip = self._slip_block()

    def move_to(self, cell: int) -> None:
        """Make the block hold this cell; cells may only go up."""
        while cell >= self.first_cell + CELLS:
            self.first_cell += CELLS
            self.wheel = self._wheel_block()
            self.slip = self._slip_block()

    def _wheel_block(self) -> Array:
        unit = _correlated(self._wheel_generator, self._wheel_decay, self._wheel_last)
        fast = self._wheel_std * unit[:, :2] * self._bursts(unit[:, 4:])
        return np.ascontiguousarray(fast + self._drift_std * unit[:, 2:4])

    def _slip_block(self) -> Array:
        unit = _correlated(self._slip_generator, self._slip_decay, self._slip_last)
        return np.ascontiguousarray(self._slip_std * unit[:, :3] * self._bursts(unit[:, 3:]))

    def _bursts(self, unit: Array) -> Array:
        return np.exp(self._volatility * unit - self._volatility**2)


def _correlated(generator: np.random.Generator, decay: Array, last: Array) -> Array:
    """Continue unit-variance AR(1) processes by one block, shape (CELLS, len(decay)); `last` is moved on in place."""
    block = generator.standard_normal((CELLS, len(decay)))
    _filter(block, decay, np.sqrt(1.0 - decay**2), last)
    return block


@compiled
def _filter(block: Array, decay: Array, gain: Array, last: Array) -> None:
    for row in range(block.shape[0]):
        for column in range(block.shape[1]):
            last[column] = decay[column] * last[column] + gain[column] * block[row, column]
            block[row, column] = last[column]
