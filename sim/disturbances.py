"""Random disturbances of wheels and body: stationary, correlated, seeded, a function of time alone.

The values belong to cells of an absolute time grid, so that how a run is cut into steps does not change them.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sim.compiled import compiled
from sim.plant_parameters import PlantParameters

CELLS = 1024

Array = npt.NDArray[np.float64]


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
        slow = math.exp(-dt / p.wheel_wander_correlation_s)
        slip = math.exp(-dt / p.slip_correlation_s)
        burst = math.exp(-dt / p.volatility_correlation_s)
        self._wheel_decay = np.array([fast, fast, slow, slow, burst])
        self._slip_decay = np.array([slip, slip, slip, burst])
        self._wheel_std = p.wheel_disturbance_std
        self._wander_std = p.wheel_wander_std
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
        return np.ascontiguousarray(fast + self._wander_std * unit[:, 2:4])

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
