"""Reports when the estimate of the pose has jumped, and when poses in a row do not fit what the wheels did."""

from __future__ import annotations

import math
from collections.abc import Sequence

from disco_hw.estimation import PoseEstimate
from disco_hw.estimation.correction import PoseReason, PoseUpdate

MISFITS = 3
"""So many poses in a row outside the gate are reported; by chance that happens once in a billion poses."""
FITS = 10
"""So many that fit, one after the other, end that."""


class PoseJumps:
    """Compares each tick's estimate with the one before, and counts what the gate refuses; pure."""

    def __init__(self) -> None:
        self._before: PoseEstimate | None = None
        self._in_a_row = 0
        self._is_mismatch = False
        self._messages: list[str] = []

    def step(self, estimate: PoseEstimate, updates: Sequence[PoseUpdate]) -> str:
        """Return in words how the estimate has jumped since the tick before; empty if it followed the wheels."""
        for update in updates:
            self._count(update)
        before, self._before = self._before, estimate
        if before is None or estimate.reinitialisations == before.reinitialisations:
            return ""
        moved_m = math.hypot(estimate.x_m - before.x_m, estimate.y_m - before.y_m)
        if not (before.heading_known and estimate.heading_known):
            text = f"the pose jumped by {moved_m:.2f} m, and the heading is no longer known"
        else:
            turned_rad = abs(math.remainder(estimate.yaw_rad - before.yaw_rad, math.tau))
            text = (
                f"the pose jumped by {moved_m:.2f} m and {turned_rad:.2f} rad, which the motion of the wheels does "
                "not explain"
            )
        self._messages.append(
            f"{text}: the robot was carried or has slipped, or the measured poses are wrong; check the pose sensor"
        )
        return text

    def new_messages(self) -> list[str]:
        """Return sentences for the operator since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def _count(self, update: PoseUpdate) -> None:
        if update.reason is PoseReason.GATED and update.innovation is not None:
            self._in_a_row = min(self._in_a_row, 0) - 1
            if self._in_a_row == -MISFITS and not self._is_mismatch:
                self._is_mismatch = True
                off_m = math.hypot(*update.innovation[:2])
                self._messages.append(
                    f"{MISFITS} poses in a row disagree with the wheels, by {off_m:.2f} m, and are not used; check "
                    "the pose sensor"
                )
        elif update.accepted:
            self._in_a_row = max(self._in_a_row, 0) + 1
            self._is_mismatch = self._is_mismatch and self._in_a_row < FITS
