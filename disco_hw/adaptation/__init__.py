"""The daemon's part of adaptation: samples out, proposals in, checks, and the belief that the robot drives by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from disco_hw.adaptation.adapter_link import (
    NAMES,
    AdapterLink,
    InForce,
    PoseReading,
    Proposal,
    Range,
    Report,
    Samples,
    WheelAngles,
)
from disco_hw.adaptation.guard import BeliefGuard, Geometry, Outcome
from disco_hw.errors import WorkError
from disco_hw.log import records
from drivers.types import Readings

WORSE_LOG_ODDS = -5.0
"""At these odds that the model file's belief explains the recent driving better, it comes back: 150 to 1."""

_SILENT_S = 5.0
_STARTING_S = 60.0


@dataclass(frozen=True, slots=True)
class Learnt:
    """What adaptation reports of a tick: records for the log, sentences for a person."""

    records: tuple[records.Record, ...] = ()
    events: tuple[str, ...] = ()


_NOTHING = Learnt()


class GeometryAdaptation(Protocol):
    """Called before and after each tick of the core; no call waits for anything."""

    def step(self, now_ns: int) -> Learnt:
        """Take in what was learnt, and put in force what passed the checks."""

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Hand on what the tick received."""

    def ask(self, action: str) -> tuple[bool, str]:
        """Obey "revert" (back to the model file's belief, and stay there) or "adapt" (go on); whether, and a text."""

    def tend(self) -> None:
        """Start a dead adapter again; takes milliseconds, so call it only while the robot is not armed."""

    def status(self) -> dict[str, Any] | None:
        """For the control socket; None without adaptation."""

    def counts(self) -> dict[str, int]:
        """Counters for the log."""

    def close(self) -> None:
        """End the adapter."""


class NoAdaptation:
    """The belief stays what the model file says."""

    def step(self, now_ns: int) -> Learnt:
        """Nothing is learnt."""
        return _NOTHING

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Nobody listens."""

    def ask(self, action: str) -> tuple[bool, str]:
        """Refuse."""
        return False, "this daemon does not adapt; start it with `disco-hw run ROBOT.toml --adapt`"

    def tend(self) -> None:
        """Nothing runs."""

    def status(self) -> dict[str, Any] | None:
        """Nothing."""
        return None

    def counts(self) -> dict[str, int]:
        """Nothing."""
        return {}

    def close(self) -> None:
        """Nothing is open."""


class CheckedAdaptation:
    """Adaptation through a link to an adapter.

    `put_in_force` makes planner and estimator use a geometry, None for the model file's; it raises ValueError for one
    that they cannot take. `wheel_rad_s` is the wheels' largest speed. What goes into force is recorded in the same
    tick, before that tick plans.
    """

    def __init__(
        self,
        link: AdapterLink,
        guard: BeliefGuard,
        model: Geometry,
        put_in_force: Callable[[Geometry | None], None],
        wheel_rad_s: float,
    ) -> None:
        self._link, self._guard, self._model, self._put_in_force = link, guard, model, put_in_force
        self._wheel_rad_s = wheel_rad_s
        self._paused = False
        self._asked: str | None = None
        self._counts = dict.fromkeys(("published", "confirming", "agrees", "refused", "reverted", "losses"), 0)
        self._text = "starting"
        self._advantage = 0.0
        self._heard_ns: int | None = None
        self._begun_ns: int | None = None
        self._quiet = False
        self._data_s = 0.0

    def step(self, now_ns: int) -> Learnt:
        """Take in what was learnt, and put in force what passed the checks."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
            self._begin(now_ns)
        found: list[records.Record] = []
        events: list[str] = []
        asked, self._asked = self._asked, None
        if asked == "revert":
            self._paused = True
            self._revert(now_ns, "asked for", found, events)
        elif asked == "adapt" and self._paused:
            self._paused = False
            self._tell(now_ns, self._model, adapted=False, relearn=True)
            events.append("adapt: learning again")
        for report in self._link.receive():
            self._heard_ns = now_ns
            self._take(now_ns, report, found, events)
        self._watch(now_ns, found, events)
        return Learnt(tuple(found), tuple(events))

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Hand on what the tick received; a message goes with every tick, as it also carries the time."""
        self._link.send(
            Samples(
                now_ns,
                tuple(WheelAngles(w.t_ns, w.left_angle_rad, w.right_angle_rad) for w in readings.wheels),
                tuple(PoseReading(p.t_ns, p.x_m, p.y_m, p.yaw_rad) for p in readings.poses),
            )
        )

    def ask(self, action: str) -> tuple[bool, str]:
        """Obey at the next step."""
        self._asked = action
        if action == "revert":
            return True, "back to the model file's belief; `ctl adapt` learns again"
        return True, "learning" if self._paused else "was learning already"

    def tend(self) -> None:
        """Start a dead adapter again; it begins from the belief in force."""
        try:
            restarted = self._link.restart()
        except WorkError as error:
            self._text = str(error)
            return
        if restarted:
            self._begun_ns = self._heard_ns = None
            self._text, self._quiet = "starting again", False

    def status(self) -> dict[str, Any]:
        """What is in force and how learning goes."""
        guard = self._guard
        return {
            "belief": "adapted" if guard.adapted else "model",
            "paused": self._paused,
            "silent": self._quiet,
            "text": self._text,
            "mean": dict(zip(NAMES, guard.in_force.mean.tolist(), strict=True)),
            "std": dict(zip(NAMES, guard.in_force.std.tolist(), strict=True)),
            "covariance": guard.in_force.covariance.ravel().tolist(),
            "advantage": self._advantage,
            **self._counts,
            "link": asdict(self._link.stats),
        }

    def counts(self) -> dict[str, int]:
        """Counters for the log."""
        stats = self._link.stats
        return {**self._counts, "sent": stats.sent, "dropped": stats.dropped, "deaths": stats.deaths}

    def close(self) -> None:
        """End the adapter."""
        self._link.close()

    def _begin(self, now_ns: int) -> None:
        """Send a new adapter the settings and the belief that it starts from."""
        mean, low, high = (tuple(values.tolist()) for values in (self._model.mean, self._guard.low, self._guard.high))
        self._link.send(Range(mean, low, high, self._wheel_rad_s))
        self._tell(now_ns, self._model, adapted=False)
        if self._guard.adapted:
            self._tell(now_ns, self._guard.in_force, adapted=True, relearn=True)

    def _take(self, now_ns: int, report: Report, found: list[records.Record], events: list[str]) -> None:
        self._text, self._advantage = report.text, report.advantage
        if self._paused:
            return
        # Not (x >= limit), so that odds which are no number count as bad ones.
        if self._guard.adapted and not report.advantage >= WORSE_LOG_ODDS:
            self._revert(now_ns, f"it explains the driving worse ({report.advantage:.1f} log odds)", found, events)
            return
        if not report.proposals:
            found.append(records.Adaptation(now_ns, "idle", report.text))
        for proposal in report.proposals:
            self._judge(now_ns, proposal, report.text, found, events)

    def _judge(
        self, now_ns: int, proposal: Proposal, words: str, found: list[records.Record], events: list[str]
    ) -> None:
        before, adapted = self._guard.in_force, self._guard.adapted
        verdict = self._guard.judge(now_ns, proposal)
        outcome, text = verdict.outcome, verdict.text
        if verdict.belief is not None:
            try:
                self._put_in_force(verdict.belief)
            except ValueError as error:
                self._guard.take_back(before, adapted)
                outcome, text = Outcome.REFUSED, f"the planner cannot take it: {error}"
            else:
                self._tell(now_ns, verdict.belief, adapted=True)
                found.append(change_record(now_ns, "adapted", verdict.belief, text))
        self._counts[outcome.value] += 1
        if outcome in (Outcome.PUBLISHED, Outcome.CONFIRMING):
            events.append(f"adapt: {text}")
        std = np.sqrt(np.abs(np.array(proposal.covariance).reshape(3, 3).diagonal())).tolist()
        found.append(
            records.Adaptation(
                now_ns, outcome.value, f"{text}; {words}", proposal.estimator, NAMES, proposal.mean, tuple(std),
                proposal.data_s,
            )
        )  # fmt: skip

    def _revert(self, now_ns: int, why: str, found: list[records.Record], events: list[str]) -> None:
        if self._guard.adapted:
            self._counts["reverted"] += 1
            self._guard.restore()
            self._put_in_force(None)
            found.append(change_record(now_ns, "model", None, why))
        found.append(records.Adaptation(now_ns, "reverted", f"the model file's belief is in force: {why}"))
        events.append(f"adapt: back to the model file's belief, as {why}")
        self._tell(now_ns, self._model, adapted=False, relearn=True)

    def _tell(self, now_ns: int, geometry: Geometry, *, adapted: bool, relearn: bool = False) -> None:
        x_icr, radius, axial = geometry.mean.tolist()
        a, b, c, d, e, f, g, h, i = geometry.covariance.ravel().tolist()
        self._link.send(InForce(now_ns, (x_icr, radius, axial), (a, b, c, d, e, f, g, h, i), adapted, relearn))

    def _watch(self, now_ns: int, found: list[records.Record], events: list[str]) -> None:
        """Notice an adapter that has died or says nothing; the belief in force stays."""
        assert self._begun_ns is not None
        if self._heard_ns is None:
            silent = now_ns - self._begun_ns > _STARTING_S * 1e9
        else:
            silent = now_ns - self._heard_ns > _SILENT_S * 1e9
        quiet = silent or not self._link.stats.alive
        if quiet and not self._quiet:
            self._counts["losses"] += 1
            words = "says nothing" if self._link.stats.alive else "has ended"
            self._text = f"the adapter {words}; the last checked belief stays in force"
            found.append(records.Adaptation(now_ns, "lost", self._text))
            events.append(f"adapt: {self._text}")
        elif self._quiet and not quiet:
            events.append("adapt: the adapter is back")
        self._quiet = quiet


def change_record(now_ns: int, source: str, geometry: Geometry | None, why: str) -> records.Record:
    """The record of a belief that goes into force; None is the model file's."""
    if geometry is None:
        return records.BeliefChange(now_ns, source, reason=why)
    mean, covariance = tuple(geometry.mean.tolist()), tuple(geometry.covariance.ravel().tolist())
    return records.BeliefChange(now_ns, source, NAMES, mean, covariance, why)
