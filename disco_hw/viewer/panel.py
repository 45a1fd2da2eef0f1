"""What the panel says of the robot's state, in words; pure text for a live page and for a replay."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from typing import Any

from disco_hw.config import CircleTask
from disco_hw.viewer.snapshot import Snapshot

_NO_NUMBER = "—"
Rows = list[tuple[str, str]]


def live_details(
    status: Mapping[str, Any] | None, snapshot: Snapshot | None, missed: int, behind_ms: float | None
) -> str:
    """Markdown of the figures: robot, link, loop, motion.

    `missed` batches of the feed did not reach this page; what it shows is `behind_ms` old.
    """
    rows: Rows = [] if status is None or not status.get("ok") else _status_rows(status)
    rows.append(("page is behind", f"{number(behind_ms, 0)} ms, {missed} batches missed"))
    if snapshot is not None:
        rows += motion_rows(snapshot)
    return _table(rows)


def _status_rows(status: Mapping[str, Any]) -> Rows:
    task, loop = status["task"], status["loop"]
    robot = f"{status['robot_state']}, fault {status['fault']}, last stop {status['stop_cause']}"
    link = status["link"] + (f": {status['link_error']}" if status["link_error"] else "")
    transport, driver = status["transport"], status["driver"]
    rejected = sum(count for name, count in driver.items() if name.startswith("rejected"))
    rows: Rows = [
        ("robot", robot),
        ("link", link),
        ("frames", f"{transport['frames_received']} in, {transport['frames_sent']} out"),
        ("rejected, lost", f"{rejected + transport['malformed']}, {driver['lost_frames']}"),
        ("laps", f"{task['laps']:.2f}"),
        ("loop late p99, max", f"{number(loop['lateness_us']['p99'], 0)}, {number(loop['lateness_us']['max'], 0)} us"),
        ("overruns, skipped", f"{loop['overruns']}, {loop['skipped']}"),
    ]
    recorder = status["recorder"]
    if recorder["last_error"]:
        rows.append(("recording", str(recorder["last_error"])))
    return rows


def replay_text(snapshot: Snapshot, first_ns: int, task: CircleTask) -> str:
    """Markdown for one instant of a log."""
    state, status = snapshot.state, snapshot.status
    head = state.state if state is not None else (status.state if status is not None else "state not recorded")
    lines = [f"### {head}", ""]
    if state is not None and state.reason:
        lines += [escaped(state.reason), ""]
    rows: Rows = [("time", f"{(snapshot.t_ns - first_ns) * 1e-9:.3f} s")]
    if status is not None:
        rows.append(("robot", f"{status.state}, fault {status.fault}, last stop {status.stop_cause}"))
    rows += [
        ("loop late", f"{number(snapshot.lateness_us, 0)} us"),
        ("overruns, skipped", f"{snapshot.overruns}, {snapshot.skipped}"),
    ]
    if snapshot.pose is not None:
        distance = math.hypot(snapshot.pose[0] - task.center_x_m, snapshot.pose[1] - task.center_y_m) - task.radius_m
        rows.append(("distance", f"{number(distance * 1e3, 0)} mm"))
    rows += motion_rows(snapshot)
    return "\n".join([*lines, _table(rows)])


def motion_rows(snapshot: Snapshot) -> Rows:
    """What a snapshot says of the motion, as (what, how much)."""
    rows: Rows = []
    if snapshot.pose is not None:
        x_m, y_m, yaw_rad = snapshot.pose
        trust = "" if snapshot.pose_healthy else " (no fresh pose)"
        rows.append(("pose", f"{x_m:.3f}, {y_m:.3f} m, {math.degrees(yaw_rad):.1f}°{trust}"))
    rows.append(("speed", f"{number(snapshot.speed_m_s, 3)} m/s, {number(snapshot.yaw_rate_rad_s, 2)} rad/s"))
    rows.append(("wheels", _pair(snapshot.wheel_speeds)))
    commanded = _pair(snapshot.command) if snapshot.in_force else "nothing in force"
    rows.append(("commanded", f"{commanded} ({snapshot.source})" if snapshot.source else commanded))
    if snapshot.plan is not None:
        plan = snapshot.plan
        rows.append(("effective samples", number(plan.effective_samples, 1)))
        rows.append(("temperature", number(plan.temperature, 4)))
    rows.append(("battery", f"{number(snapshot.voltage_v, 1)} V"))
    return rows


def events_text(snapshot: Snapshot | None, first_ns: int | None) -> str:
    """Markdown of the newest events, newest first."""
    if snapshot is None or first_ns is None or not snapshot.events:
        return "nothing yet"
    return "\n".join(
        f"- `{(t_ns - first_ns) * 1e-9:8.2f} s` {escaped(event.text)}" for t_ns, event in reversed(snapshot.events)
    )


def number(value: float | None, digits: int) -> str:
    """A number, or a dash where there is none."""
    return _NO_NUMBER if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def escaped(text: str) -> str:
    """Text from elsewhere, so that it can be no markup of the page."""
    plain = html.escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{letter}" if letter in "\\`*_[]{}#|!~$" else letter for letter in plain)


def _pair(values: tuple[float, float] | None) -> str:
    return _NO_NUMBER if values is None else f"{values[0]:.2f}, {values[1]:.2f} rad/s"


def _table(rows: Rows) -> str:
    return "\n".join(["| | |", "|---|---|", *(f"| {what} | {escaped(text)} |" for what, text in rows)])
