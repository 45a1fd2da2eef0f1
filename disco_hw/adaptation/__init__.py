"""Learning the robot's geometry while it drives: what the daemon's core calls before and after each tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from disco_hw.log import records
from drivers.types import Readings


@dataclass(frozen=True, slots=True)
class AdaptationUpdate:
    """Result of one step of adaptation: records for the log, and sentences for the operator."""

    records: tuple[records.Record, ...] = ()
    events: tuple[str, ...] = ()


class GeometryAdaptation(Protocol):
    """A learner of the geometry that the core calls before and after each tick; no call waits for anything."""

    def step(self, now_ns: int) -> AdaptationUpdate:
        """Put the newest estimate in force if it passes the checks, and report what changed."""

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Take in the wheel and pose samples that the tick received."""

    def handle_request(self, action: str) -> tuple[bool, str]:
        """Handle "revert" (back to the model file's belief, and stay there) or "adapt" (learn again).

        Returns whether the request is accepted, and a sentence for the operator.
        """

    def status(self) -> dict[str, Any] | None:
        """Return the belief in force and the progress of learning as a JSON-serialisable dict, or None."""

    def counts(self) -> dict[str, int]:
        """Return the counters that are written to the log."""


class NoAdaptation:
    """An adaptation that leaves the model file's belief in force."""

    def step(self, now_ns: int) -> AdaptationUpdate:
        """Return an empty update: nothing is adapted."""
        return AdaptationUpdate()

    def feed(self, now_ns: int, readings: Readings) -> None:
        """Do nothing: no samples are needed."""

    def handle_request(self, action: str) -> tuple[bool, str]:
        """Refuse the request, with what starts adaptation."""
        return False, "this daemon does not adapt; start it with `disco-hw run ROBOT.toml --adapt`"

    def status(self) -> dict[str, Any] | None:
        """Return None, because nothing is learnt."""
        return None

    def counts(self) -> dict[str, int]:
        """Return an empty dict: nothing is counted."""
        return {}
