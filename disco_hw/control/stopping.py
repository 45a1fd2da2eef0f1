"""The fallback of a planner that finds nothing valid: a ramp to zero for a while, then no plan at all."""

from __future__ import annotations

import numpy as np

from disco_hw.control.plan import Array, CommandLimits, DiscoSettings, NoValidControl

TRAPPED = (
    "no way past the fence or an obstacle was found, and the robot stops before it; clear the way, or "
    "drive it away from there"
)


def ramp_to_zero(start: Array, limits: CommandLimits, step_s: float, steps: int) -> Array:
    """Return commands (steps, 2) from `start` (2,) to zero (rad/s), as fast as the acceleration limit allows."""
    change = limits.acceleration_rad_s2 * step_s
    size = np.maximum(np.abs(start) - np.minimum(change, np.abs(start)) * np.arange(1, steps + 1)[:, None], 0.0)
    ramp: Array = np.sign(start) * size
    return ramp


class Stopping:
    """Ramps commands to zero within the limits, for at most `decay_s` on end."""

    def __init__(self, settings: DiscoSettings, limits: CommandLimits) -> None:
        self._settings, self._limits = settings, limits
        self._since_ns: int | None = None

    def end(self) -> None:
        """Note that there is a valid plan again, or none is asked for."""
        self._since_ns = None

    def ramp(self, now_ns: int, before: tuple[float, float], is_trapped: bool) -> Array:
        """Commands (T, 2) from those `before` to zero; raises NoValidControl when that has gone on for `decay_s`.

        `is_trapped`: whether it stops because everything in reach touches the fence or an obstacle.
        """
        decay_s = self._settings.decay_s
        if self._since_ns is None:
            self._since_ns = now_ns
        if (now_ns - self._since_ns) * 1e-9 >= decay_s:
            if is_trapped:
                raise NoValidControl(TRAPPED)
            raise NoValidControl(
                f"no command sequence had a finite cost for {decay_s} s, in spite of retries and a "
                "restart; check the pose, the wheel speeds and the model"
            )
        start = np.nan_to_num(np.clip(np.array(before), -self._limits.speed_rad_s, self._limits.speed_rad_s))
        return ramp_to_zero(start, self._limits, self._settings.step_s, self._settings.sampler.horizon)
