"""The filter in the tick, audited by the density network in a process of its own, which takes over when the two part.

The filter follows a change within seconds, and rests on one description of slip and noise; the network is slow, and
was trained on drives of all kinds. Where their estimates go on to differ by more than both allow, the filter is not
trusted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from disco_hw.adaptation.adaptation import CheckedAdaptation, Learnt, change_record
from disco_hw.adaptation.fast import FastAdaptation
from disco_hw.adaptation.guard import BeliefGuard, Geometry, Outcome
from disco_hw.adaptation.link import NAMES, AdapterLink
from disco_hw.log import records
from drivers.types import Readings

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
