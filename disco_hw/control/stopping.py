"""The fallback of a planner that finds nothing valid: a ramp to zero for a while, then no plan at all."""

from __future__ import annotations

import numpy as np

from disco_hw.control.plan import Array, CommandLimits, DiscoSettings, NoValidControl

TRAPPED = (
    "no way past the fence or an obstacle was found, and the robot stops before it; clear the way, or "
    "drive it away from there"
)


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
        steps = np.arange(1, self._settings.sampler.horizon + 1)[:, None]
        change = self._limits.acceleration_rad_s2 * self._settings.step_s
        start = np.nan_to_num(np.clip(np.array(before), -self._limits.speed_rad_s, self._limits.speed_rad_s))
        size = np.maximum(np.abs(start) - np.minimum(change, np.abs(start)) * steps, 0.0)
        ramp: Array = np.sign(start) * size
        return ramp
