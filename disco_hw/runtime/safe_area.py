"""Pure state of fence, obstacles and override in the daemon's tick, with what to report of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from disco_hw.fence import Fence, Footprint, fence_fault
from disco_hw.fence.clearance import Boundaries
from disco_hw.log import records
from disco_hw.runtime import IN_USE, State
from disco_hw.runtime.fence_guard import IDLE, STOPS_MOTION, FenceGuard, FenceState, FenceVerdict
from disco_hw.runtime.obstacles import ENTERED_AGE_LIMIT_S, ObstacleRefused, ObstacleReport, Obstacles, report_from

OVERRIDE_NS = 60_000_000_000
"""How long a manual override of the fence holds."""
# Chosen: every fifth tick moves smoothly enough on the page, with a fifth of the records.
_PATH_EVERY = 5


class FenceRefused(Exception):  # noqa: N818
    """The fence is not changed; the message says why and what to do."""


class SafeArea:
    """Fence, obstacles and override of one daemon, around the guard that its pipeline asks."""

    def __init__(self, guard: FenceGuard, fence: Fence, footprint: Footprint) -> None:
        self.guard = guard
        self.fence = fence
        self._is_planned_around = fence != Fence()
        self.footprint = footprint
        self.obstacles = Obstacles()
        self._override_until_ns: int | None = None
        self._pending: list[records.Record] = []
        self._events: list[str] = []
        self._last_verdict = FenceVerdict.IDLE
        self._ticks = 0
        self.last: FenceState = IDLE

    def begin(self, now_ns: int, by_hand: bool) -> bool:
        """Bring guard and obstacles up to this tick; returns whether the fence is overridden in it."""
        self._events += self.obstacles.step(now_ns)
        self.guard.set_obstacles(self.obstacles.circles(now_ns), self.obstacles.lost)
        if self._override_until_ns is not None and now_ns >= self._override_until_ns:
            self._override_until_ns = None
            self._events.append("fence: the manual override has ended; the fence is in force again")
        return self._override_until_ns is not None and by_hand

    def end(self, now_ns: int, found: FenceState, overridden: bool) -> tuple[tuple[str, ...], list[records.Record]]:
        """Take in what the guard found; returns what to say and what to record of this tick."""
        self.last = found
        verdict = found.verdict
        if verdict is not self._last_verdict:
            if verdict in STOPS_MOTION:
                self._events.append(f"fence: stopped: {found.reason}")
            elif self._last_verdict in STOPS_MOTION and verdict is not FenceVerdict.IDLE:
                self._events.append("fence: motion is allowed again")
        changed, self._last_verdict = verdict is not self._last_verdict, verdict
        events, self._events = tuple(self._events), []
        written, self._pending = self._pending, []
        if verdict is not FenceVerdict.IDLE:
            self._ticks += 1
            is_shown = changed or self._ticks % _PATH_EVERY == 0
            x, y, yaw = zip(*found.path, strict=True) if is_shown and found.path else ((), (), ())
            circles = self.obstacles.circles(now_ns) if is_shown else ()
            obstacles = tuple(value for one in circles for value in (one.x_m, one.y_m, one.radius_m))
            written.append(
                records.GuardVerdict(
                    now_ns,
                    verdict.value,
                    found.scale,
                    found.clearance_m,
                    overridden,
                    found.reason,
                    x,
                    y,
                    yaw,
                    obstacles,
                )
            )
        return events, written

    @property
    def task_fault(self) -> str:
        """Reason why no task may go on, in words; empty if nothing of the fence speaks against it."""
        return f"fence: {self.last.reason}" if self.last.verdict in STOPS_MOTION else ""

    def override(self, now_ns: int, on: bool) -> str:
        """Let a person drive in spite of the fence for a minute, or end that; returns the answer in words."""
        if not on:
            self._override_until_ns = None
            self._events.append("fence: the operator ended the manual override; the fence is in force again")
            return "the fence is in force again"
        self._override_until_ns = now_ns + OVERRIDE_NS
        text = f"manual driving may leave the fence for {OVERRIDE_NS // 1_000_000_000} s"
        self._events.append(f"fence: OVERRIDDEN by the operator: {text}")
        return text

    def report(self, now_ns: int, report: ObstacleReport) -> None:
        """Take in one obstacle, or that it is gone. Raises ObstacleRefused."""
        if report.removed:
            # Senders repeat it, as a datagram can be lost.
            with contextlib.suppress(ObstacleRefused):
                self._remove(now_ns, report.name)
            return
        self.obstacles.report(now_ns, report)
        self._pending.append(records.Obstacle(now_ns, *msgspec.structs.astuple(report)))

    def _remove(self, now_ns: int, name: str) -> None:
        self.obstacles.remove(name)
        self._pending.append(records.Obstacle(now_ns, name, removed=True))

    def notify(self, messages: Iterable[str]) -> None:
        """Have these sentences on obstacles reported as events of this tick."""
        self._events += [f"fence: {text}" for text in messages]

    def handle_request(self, now_ns: int, requested: Mapping[str, Any]) -> str:
        """Add or remove the obstacle that a person names; returns the answer in words. Raises ObstacleRefused."""
        fields = dict(requested)
        match fields.pop("change", None):
            case "add" if "removed" not in fields:
                report = report_from(fields, ENTERED_AGE_LIMIT_S)
                self.report(now_ns, report)
                return (
                    f"obstacle {report.name}: valid for {report.age_limit_s:g} s; without a newer report the robot "
                    "then stops"
                )
            case "remove" if set(fields) == {"name"}:
                name = str(fields["name"])
                self._remove(now_ns, name)
                return f"obstacle {name}: removed"
        raise ObstacleRefused("obstacle: write add or remove, such as obstacle remove name=pillar")

    def change_fence(self, now_ns: int, requested: Mapping[str, Any], state: State) -> str:
        """Put another fence in force, with the fields of [fence] in `requested`; returns the answer in words.

        Raises FenceRefused while the robot is armed or stopping, and for a fence that is none.
        """
        if state in IN_USE:
            raise FenceRefused(
                f"the fence can be changed only while the robot is disarmed (it is {state.name}); disarm first"
            )
        try:
            fence = msgspec.convert({**msgspec.to_builtins(self.fence), **requested}, Fence)
        except msgspec.ValidationError as error:
            raise FenceRefused(f"fence: {str(error).replace('`', '')}; correct the value") from None
        fault = fence_fault(fence, self.footprint)
        if fault is not None:
            raise FenceRefused(f"fence.{fault.field}: {fault.fault}; {fault.hint}")
        self.fence = fence
        self.guard.set_boundaries(Boundaries(self.footprint, fence), fence.margin_m)
        self._pending.append(record_of_fence(now_ns, fence))
        self._events.append("fence: changed until the daemon ends; robot.toml is not changed")
        text = "the fence is changed until the daemon ends; write it into robot.toml to keep it"
        if self._is_planned_around:
            return text
        return f"{text}, and to have plans avoid it: now only the guard keeps the robot inside"

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return the entries for fence and obstacles of the daemon's status."""
        return {
            "fence": msgspec.to_builtins(self.fence),
            "footprint_m": msgspec.to_builtins(self.footprint),
            "verdict": self.last.verdict.value,
            "reason": self.last.reason,
            "scale": self.last.scale,
            "clearance_m": self.last.clearance_m if self.last.verdict is not FenceVerdict.IDLE else None,
            "stopping_path": [list(pose) for pose in self.last.path],
            "overridden_s": self._left_s(now_ns),
            "obstacles": self.obstacles.status(now_ns),
        }

    def _left_s(self, now_ns: int) -> float:
        return 0.0 if self._override_until_ns is None else max(0, self._override_until_ns - now_ns) * 1e-9


def record_of_fence(t_ns: int, fence: Fence) -> records.FenceChange:
    """Return the record of a fence that is in force from `t_ns` on."""
    return records.FenceChange(t_ns, msgspec.json.encode(fence).decode())


def fence_of_record(record: records.FenceChange) -> Fence:
    """Return the fence of a record."""
    return msgspec.json.decode(record.fence, type=Fence)


def report_of_record(record: records.Obstacle) -> ObstacleReport:
    """Return the report that a record of an obstacle keeps."""
    return msgspec.convert(record, ObstacleReport, from_attributes=True)
