"""Adaptation by an extended Kalman filter in the daemon's own thread, put in force twice a second.

The filter takes a fraction of a millisecond for a pose, so that no process is needed; what goes into force is recorded
in the same tick, and a replay reads it from the log.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from disco_hw.adaptation import AdaptationUpdate
from disco_hw.adaptation.geometry_filter import GeometryFilter
from disco_hw.adaptation.guard import NAMES, Geometry, geometry_fault
from disco_hw.log import records
from drivers.types import Readings

# Chosen: shorter follows a change sooner, and has the planner prepare its tables more often.
PERIOD_S = 0.5
SIGNIFICANT_STD, SIGNIFICANT_WIDTH = 0.1, 0.97
"""A belief goes into force when its mean or the ground's drift has moved by so many standard deviations, or its width
by this factor."""
LARGEST_MISMATCH, AGREEING_MISMATCH = 3.0, 2.0
"""Poses and wheels disagree from the first mismatch on until it is below the second (`GeometryFilter.mismatch`).
Measured: on level, sloping and slippery ground and in MuJoCo at most 2.6, also when the robot changes; with poses that
come 0.2 s late, step or wander by 5 cm, or are of a sensor 10 cm off, 3.5 to 15."""
TRUSTED_STD, TRUSTED_POSES = 2.0, 250
"""While they disagree, lengths within so many standard deviations of what was believed when they last agreed are used,
and neither another drift nor lag. After so many poses the mismatch is known."""
LEAST_POSES = 10
"""Poses taken before the first belief goes into force."""
# The filter's order is wheel radius, axial distance, x_icr; that of NAMES begins with x_icr.
_TO_NAMES, _FROM_NAMES = [2, 0, 1], [1, 2, 0]


class FastAdaptation:
    """Learns from `model`, within `low` and `high` (order of NAMES).

    `apply_geometry` makes planner and estimator use a geometry, None for the model file's; it raises ValueError for one
    that they cannot take.
    """

    def __init__(
        self, model: Geometry, low: np.ndarray, high: np.ndarray, apply_geometry: Callable[[Geometry | None], None]
    ) -> None:
        self._model, self._in_force, self._apply_geometry = model, model, apply_geometry
        self._low, self._high = low, high
        order = np.ix_(_FROM_NAMES, _FROM_NAMES)
        self._filter = GeometryFilter(
            model.mean[_FROM_NAMES], model.covariance[order], low[_FROM_NAMES], high[_FROM_NAMES]
        )
        self._next_ns: int | None = None
        self._poses = self._changes = self._carried = 0
        self._adapted = self._paused = self._on_slope = self._distrusts = False
        # What was last believed while poses and wheels agreed.
        self._trusted = model
        self._requested: str | None = None
        self._text = "nothing driven yet"
        self._counts = dict.fromkeys(("published", "refused", "reverted", "changes", "carried"), 0)

    def step(self, now_ns: int) -> AdaptationUpdate:
        """Put the newest estimate in force if it passes the checks; twice a second."""
        requested, self._requested = self._requested, None
        if requested == "revert":
            return self._revert(now_ns)
        if requested == "adapt" and self._paused:
            self._paused = False
            self._filter.reset()
            self._trusted, self._distrusts = self._model, False
            return AdaptationUpdate(events=("adapt: learning again",))
        if self._next_ns is None or now_ns < self._next_ns or self._paused:
            self._next_ns = now_ns if self._next_ns is None else self._next_ns
            return AdaptationUpdate()
        self._next_ns = now_ns + round(PERIOD_S * 1e9)
        filtered = self._filter
        moved = filtered.poses > max(self._poses, LEAST_POSES)
        self._poses = filtered.poses
        covariance = filtered.covariance[np.ix_(_TO_NAMES, _TO_NAMES)]
        # What it lags for sure: plans that count on too long a lag stay further from the line than those without.
        sure_lag_s = max(filtered.lateral_lag_s - filtered.lateral_lag_std_s, 0.0)
        geometry = Geometry(filtered.mean[_TO_NAMES], covariance, filtered.drift_m_s, sure_lag_s)
        written, events = self._follow_mismatch(now_ns)
        # What it makes of poses that disagree with the wheels is not reported.
        events = events if self._distrusts else (*events, *self._new_messages())
        if self._distrusts:
            trusted = self._trusted
            geometry = replace(geometry, drift_m_s=trusted.drift_m_s, lateral_lag_s=trusted.lateral_lag_s)
        if not moved or not self._is_significant(geometry) or (self._distrusts and self._departs(geometry)):
            return AdaptationUpdate(written, events)
        fault = geometry_fault(geometry, self._low, self._high)
        if not fault:
            try:
                self._apply_geometry(geometry)
            except ValueError as error:
                fault = f"the planner does not accept it: {error}"
        if fault:
            self._counts["refused"] += 1
            if fault != self._text:
                events = (*events, f"adapt: what was learnt is not used: {fault}")
            self._text = fault
            return AdaptationUpdate((*written, records.Adaptation(now_ns, "refused", fault)), events)
        self._in_force, self._adapted = geometry, True
        if filtered.mismatch < AGREEING_MISMATCH and filtered.poses > TRUSTED_POSES:
            self._trusted = geometry
        self._counts["published"] += 1
        self._text = f"learnt from {filtered.poses} poses"
        return AdaptationUpdate((*written, change_record(now_ns, "adapted", geometry, self._text)), events)

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Take in the wheel and pose samples that the tick received."""
        self._filter.add(readings.wheels, readings.poses)

    def handle_request(self, action: str) -> tuple[bool, str]:
        """Handle "revert" or "adapt" at the next step."""
        self._requested = action
        if action == "revert":
            return True, "back to the model file's belief; `ctl adapt` learns again"
        return True, "learning" if self._paused else "already learning"

    def status(self) -> dict[str, Any]:
        """Return the belief in force and the progress of learning as a JSON-serialisable dict."""
        return {
            "belief": "adapted" if self._adapted else "model",
            "paused": self._paused,
            "silent": False,
            "text": self._text,
            "mean": dict(zip(NAMES, self._in_force.mean.tolist(), strict=True)),
            "std": dict(zip(NAMES, self._in_force.std.tolist(), strict=True)),
            "covariance": self._in_force.covariance.ravel().tolist(),
            "drift_m_s": list(self._in_force.drift_m_s),
            "lateral_lag_s": self._in_force.lateral_lag_s,
            "misfit": self._filter.mismatch,
            **self._counts,
        }

    def counts(self) -> dict[str, int]:
        """Return the counters that are written to the log."""
        return dict(self._counts)

    def _is_significant(self, geometry: Geometry) -> bool:
        old = self._in_force
        width = geometry.std / old.std
        moved = np.abs(geometry.mean - old.mean) > SIGNIFICANT_STD * np.minimum(geometry.std, old.std)
        carried_m_s = math.dist(geometry.drift_m_s, old.drift_m_s)
        resized = (width < SIGNIFICANT_WIDTH) | (width > 1.0 / SIGNIFICANT_WIDTH)
        lags_s = abs(geometry.lateral_lag_s - old.lateral_lag_s)
        return (
            bool(moved.any() or resized.any())
            or carried_m_s > SIGNIFICANT_STD * self._filter.drift_std_m_s
            or lags_s > SIGNIFICANT_STD * self._filter.lateral_lag_std_s
        )

    def _departs(self, geometry: Geometry) -> bool:
        """Whether a length is further from what was believed when poses and wheels agreed than that allows."""
        return bool((np.abs(geometry.mean - self._trusted.mean) > TRUSTED_STD * self._trusted.std).any())

    def _follow_mismatch(self, now_ns: int) -> tuple[tuple[records.Record, ...], tuple[str, ...]]:
        """Return to what is trusted when poses and wheels begin to disagree; returns records and events."""
        mismatch, distrusted = self._filter.mismatch, self._distrusts
        self._distrusts = mismatch > (AGREEING_MISMATCH if distrusted else LARGEST_MISMATCH)
        if self._distrusts == distrusted:
            return (), ()
        if distrusted:
            return (), ("adapt: poses and wheels agree again",)
        self._text = (
            f"poses and wheels differ by {math.sqrt(mismatch):.1f} times what their noise explains; until they agree, "
            "only lengths near those believed before are used; check the pose source's delay, noise and place"
        )
        self._counts["refused"] += 1
        written: list[records.Record] = [records.Adaptation(now_ns, "refused", self._text)]
        trusted = self._trusted
        if self._departs(self._in_force) or self._in_force.drift_m_s != trusted.drift_m_s:
            found = None if trusted is self._model else trusted
            self._apply_geometry(found)
            self._in_force, self._adapted = trusted, found is not None
            written.append(change_record(now_ns, "model" if found is None else "adapted", found, self._text))
        return tuple(written), (f"adapt: {self._text}",)

    def _new_messages(self) -> tuple[str, ...]:
        """Sentences on what the filter noticed since the last time."""
        found: list[str] = []
        if self._filter.changes > self._changes:
            found.append("adapt: the robot moves differently from what was learnt; learning again")
        if self._filter.carried > self._carried:
            found.append("adapt: the robot was carried")
        if self._filter.on_slope != self._on_slope:
            by = f"by {math.hypot(*self._filter.drift_m_s):.3f} m/s, as a slope does"
            found.append(f"adapt: the ground carries the robot {by if self._filter.on_slope else 'no more'}")
        self._changes, self._carried = self._filter.changes, self._filter.carried
        self._on_slope = self._filter.on_slope
        self._counts["changes"], self._counts["carried"] = self._changes, self._carried
        return tuple(found)

    def _revert(self, now_ns: int) -> AdaptationUpdate:
        self._paused = True
        found: list[records.Record] = []
        if self._adapted:
            self._adapted, self._in_force = False, self._model
            self._counts["reverted"] += 1
            self._apply_geometry(None)
            found.append(change_record(now_ns, "model", None, "asked for"))
        found.append(records.Adaptation(now_ns, "reverted", "the model file's belief is in force, as requested"))
        return AdaptationUpdate(tuple(found), ("adapt: back to the model file's belief, as requested",))


def change_record(now_ns: int, source: str, geometry: Geometry | None, why: str) -> records.Record:
    """Return the record of a belief that goes into force; None stands for the model file's."""
    if geometry is None:
        return records.BeliefChange(now_ns, source, reason=why)
    mean, covariance = tuple(geometry.mean.tolist()), tuple(geometry.covariance.ravel().tolist())
    return records.BeliefChange(
        now_ns, source, NAMES, mean, covariance, why, *geometry.drift_m_s, geometry.lateral_lag_s
    )
