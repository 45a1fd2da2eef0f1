"""Adaptation by the filter in the daemon's own thread, twice a second, alone or audited by the density network.

The filter takes a fraction of a millisecond for a pose, so that no process is needed; what goes into force is recorded
in the same tick, and a replay reads it from the log.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from disco_hw.adaptation import CheckedAdaptation, Learnt, change_record
from disco_hw.adaptation.adapter_link import NAMES, AdapterLink
from disco_hw.adaptation.geometry_filter import GeometryFilter
from disco_hw.adaptation.guard import BeliefGuard, Geometry, Outcome
from disco_hw.log import records
from drivers.types import Readings

PERIOD_S = 0.5
NEWS_STD, NEWS_WIDTH = 0.1, 0.97
"""A belief goes into force when its mean has moved by so many standard deviations, or its width by this factor."""
LEAST_POSES = 10
"""Poses taken before the first belief goes into force."""
# The filter's order is wheel radius, axial distance, x_icr; that of NAMES begins with x_icr.
_TO_NAMES, _FROM_NAMES = [2, 0, 1], [1, 2, 0]


class FastAdaptation:
    """Learns from `model`, within `low` and `high` (order of NAMES).

    `put_in_force` makes planner and estimator use a geometry, None for the model file's; it raises ValueError for one
    that they cannot take.
    """

    def __init__(
        self, model: Geometry, low: np.ndarray, high: np.ndarray, put_in_force: Callable[[Geometry | None], None],
        drifts: bool = False,
    ) -> None:  # fmt: skip
        self._model, self._in_force, self._put_in_force = model, model, put_in_force
        order = np.ix_(_FROM_NAMES, _FROM_NAMES)
        self._filter = GeometryFilter(
            model.mean[_FROM_NAMES], model.covariance[order], low[_FROM_NAMES], high[_FROM_NAMES], drifts
        )
        self._next_ns: int | None = None
        self._poses = self._changes = self._carried = 0
        self._adapted = self._paused = False
        self._asked: str | None = None
        self._text = "nothing driven yet"
        self._counts = dict.fromkeys(("published", "refused", "reverted", "changes", "carried"), 0)

    @property
    def in_force(self) -> Geometry:
        """What the robot drives by."""
        return self._in_force

    @property
    def adapted(self) -> bool:
        """Whether that was learnt, and is not the model file's."""
        return self._adapted

    def stop(self) -> None:
        """Learn no more until asked to; somebody else says what is in force."""
        self._paused, self._adapted, self._in_force = True, False, self._model

    def step(self, now_ns: int) -> Learnt:
        """Put in force what was learnt, twice a second."""
        asked, self._asked = self._asked, None
        if asked == "revert":
            return self._revert(now_ns)
        if asked == "adapt" and self._paused:
            self._paused = False
            self._filter.reset()
            return Learnt(events=("adapt: learning again",))
        if self._next_ns is None or now_ns < self._next_ns or self._paused:
            self._next_ns = now_ns if self._next_ns is None else self._next_ns
            return Learnt()
        self._next_ns = now_ns + round(PERIOD_S * 1e9)
        events = self._told()
        filtered = self._filter
        moved = filtered.poses > max(self._poses, LEAST_POSES)
        self._poses = filtered.poses
        geometry = Geometry(filtered.mean[_TO_NAMES], filtered.covariance[np.ix_(_TO_NAMES, _TO_NAMES)])
        if not moved or not self._is_news(geometry):
            return Learnt(events=events)
        try:
            self._put_in_force(geometry)
        except ValueError as error:
            self._counts["refused"] += 1
            self._text = f"the planner cannot take it: {error}"
            return Learnt((records.Adaptation(now_ns, "refused", self._text),), events)
        self._in_force, self._adapted = geometry, True
        self._counts["published"] += 1
        self._text = f"learnt from {filtered.poses} poses"
        return Learnt((change_record(now_ns, "adapted", geometry, self._text),), events)

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Hand on what the tick received."""
        self._filter.add(readings.wheels, readings.poses)

    def ask(self, action: str) -> tuple[bool, str]:
        """Obey at the next step."""
        self._asked = action
        if action == "revert":
            return True, "back to the model file's belief; `ctl adapt` learns again"
        return True, "learning" if self._paused else "was learning already"

    def tend(self) -> None:
        """Nothing runs beside the tick."""

    def status(self) -> dict[str, Any]:
        """What is in force and how learning goes."""
        return {
            "belief": "adapted" if self._adapted else "model",
            "paused": self._paused,
            "silent": False,
            "text": self._text,
            "mean": dict(zip(NAMES, self._in_force.mean.tolist(), strict=True)),
            "std": dict(zip(NAMES, self._in_force.std.tolist(), strict=True)),
            "covariance": self._in_force.covariance.ravel().tolist(),
            "misfit": self._filter.misfit,
            **self._counts,
        }

    def counts(self) -> dict[str, int]:
        """Counters for the log."""
        return dict(self._counts)

    def close(self) -> None:
        """Nothing is open."""

    def _is_news(self, geometry: Geometry) -> bool:
        old = self._in_force
        width = geometry.std / old.std
        moved = np.abs(geometry.mean - old.mean) > NEWS_STD * np.minimum(geometry.std, old.std)
        return bool(moved.any() or (width < NEWS_WIDTH).any() or (width > 1.0 / NEWS_WIDTH).any())

    def _told(self) -> tuple[str, ...]:
        """Sentences on what the filter noticed since the last time."""
        found = []
        if self._filter.changes > self._changes:
            found.append("adapt: the robot drives otherwise than learnt; learning anew")
        if self._filter.carried > self._carried:
            found.append("adapt: the robot was carried")
        self._changes, self._carried = self._filter.changes, self._filter.carried
        self._counts["changes"], self._counts["carried"] = self._changes, self._carried
        return tuple(found)

    def _revert(self, now_ns: int) -> Learnt:
        self._paused = True
        found: list[records.Record] = []
        if self._adapted:
            self._adapted, self._in_force = False, self._model
            self._counts["reverted"] += 1
            self._put_in_force(None)
            found.append(change_record(now_ns, "model", None, "asked for"))
        found.append(records.Adaptation(now_ns, "reverted", "the model file's belief is in force: asked for"))
        return Learnt(tuple(found), ("adapt: back to the model file's belief, as asked for",))


PARTED_SIGMAS, PARTED_TIMES = 3.0, 3
"""The network takes over when its estimate, one every 4 s of driving, is so many standard deviations of the difference
from the filter's so many times in a row: 12 s, so that it has seen a change that the filter saw at once."""


class AuditedAdaptation:
    """Learns from `model` within `low` and `high` (order of NAMES); `link` leads to the network.

    `put_in_force` makes planner and estimator use a geometry, None for the model file's; it raises ValueError for one
    that they cannot take. `wheel_rad_s` is the wheels' largest speed.
    """

    def __init__(
        self,
        model: Geometry,
        low: np.ndarray,
        high: np.ndarray,
        link: AdapterLink,
        put_in_force: Callable[[Geometry | None], None],
        wheel_rad_s: float,
    ) -> None:
        self._put_in_force = put_in_force
        self._fast = FastAdaptation(model, low, high, put_in_force)
        self._guard = BeliefGuard(model, low, high)
        self._network = CheckedAdaptation(link, self._guard, model, self._put_network_in_force, wheel_rad_s)
        self._taken_over = self._resume = False
        self._parted = self._takeovers = 0
        self._text = "not audited yet"

    def step(self, now_ns: int) -> Learnt:
        """Put in force what the filter learnt, or the network once it has taken over."""
        found: list[records.Record] = []
        events: list[str] = []
        if self._resume:
            self._taken_over = self._resume = False
            self._parted = 0
            self._put_in_force(None)
            found.append(change_record(now_ns, "model", None, "the filter begins again, as asked for"))
        network = self._network.step(now_ns)
        if self._taken_over:
            return network
        learnt = self._fast.step(now_ns)
        found += learnt.records
        events += learnt.events
        for record in network.records:
            if not isinstance(record, records.Adaptation):
                continue
            if record.outcome == "lost":
                found.append(record)
                events.append(f"adapt: {record.text}; the filter goes on without an audit")
            elif record.estimator == "network" and record.outcome != Outcome.REFUSED.value and self._fast.adapted:
                found.append(self._audit(record))
        if self._parted >= PARTED_TIMES:
            taken = self._take_over(now_ns)
            found += taken.records
            events += taken.events
        return Learnt(tuple(found), tuple(events))

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Hand on what the tick received."""
        self._network.feed(now_ns, readings)
        if not self._taken_over:
            self._fast.feed(now_ns, readings)

    def ask(self, action: str) -> tuple[bool, str]:
        """Obey at the next step; after the network has taken over, "adapt" begins with the filter again."""
        self._network.ask(action)
        answer = self._fast.ask(action)
        self._resume = self._taken_over and action == "adapt"
        return answer

    def tend(self) -> None:
        """Start a dead network again."""
        self._network.tend()

    def status(self) -> dict[str, Any]:
        """What is in force, who learns, and what the audit says."""
        network = self._network.status()
        active = network if self._taken_over else self._fast.status()
        return {**active, "link": network["link"], "audit": self._text, "takeovers": self._takeovers}

    def counts(self) -> dict[str, int]:
        """Counters for the log."""
        network = self._network.counts()
        lost = {key: network[key] for key in ("losses", "sent", "dropped", "deaths")}
        active = network if self._taken_over else self._fast.counts()
        return {**active, **lost, "takeovers": self._takeovers}

    def close(self) -> None:
        """End the network's process."""
        self._network.close()

    def _put_network_in_force(self, geometry: Geometry | None) -> None:
        if self._taken_over:
            self._put_in_force(geometry)

    def _audit(self, record: records.Adaptation) -> records.Adaptation:
        """Compare an estimate of the network with the filter's belief in force."""
        ours = self._fast.in_force
        apart = np.abs(np.array(record.mean) - ours.mean) / np.hypot(record.std, ours.std)
        worst = int(np.argmax(apart))
        parted = bool(apart[worst] > PARTED_SIGMAS)
        self._parted = self._parted + 1 if parted else 0
        self._text = (
            f"density network and filter {'part' if parted else 'agree'}: {NAMES[worst]} {record.mean[worst]:.4f} and "
            f"{ours.mean[worst]:.4f} m, {apart[worst]:.1f} standard deviations"
        )
        return records.Adaptation(
            record.t_ns, "audit", self._text, record.estimator, NAMES, record.mean, record.std, record.data_s
        )

    def _take_over(self, now_ns: int) -> Learnt:
        """Drive by what the network alone would drive by; the filter stops."""
        geometry = self._guard.in_force if self._guard.adapted else None
        try:
            self._put_in_force(geometry)
        except ValueError:
            geometry = None
            self._guard.restore()
            self._put_in_force(None)
        self._fast.stop()
        self._taken_over, self._parted = True, 0
        self._takeovers += 1
        text = f"the density network takes over, as {self._text}; `ctl adapt` begins with the filter again"
        change = change_record(now_ns, "model" if geometry is None else "adapted", geometry, text)
        return Learnt((change, records.Adaptation(now_ns, "taken_over", text)), (f"adapt: {text}",))
