"""Text of the panel that describes the robot's state, for a live page and for a replay."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from disco_hw.daemon import describe_recording
from disco_hw.runtime import describe, fault_sentence, headline
from disco_hw.runtime.pipeline import Source
from disco_hw.tasks import RobotTask
from disco_hw.viewer.recording import Snapshot

_NO_NUMBER = "—"
Rows = list[tuple[str, str]]


def live_summary(status: Mapping[str, Any] | None, snapshot: Snapshot | None, knows_task: bool = True) -> str:
    """Markdown of what matters first: distance, speed, battery, loop, and what is wrong with task or recording.

    Without `knows_task` it says that the daemon follows another path than this page could draw.
    """
    rows: Rows = []
    if not knows_task:
        rows.append(("TASK NOT DRAWN", "the path's file has changed since the daemon read it; restart the daemon"))
    if status is not None and status.get("ok"):
        recorder = status["recorder"]
        if recorder["fault"] or recorder["last_error"]:
            what = "RECORDING FAILS" if recorder["fault"] else "recording failed"
            rows.append((what, recorder["fault"] or recorder["last_error"]))
        rows += [tuple(status["task"]["progress"]), ("distance", f"{number(status['task']['distance_m'], 3)} m")]
    if snapshot is not None:
        rows += [_speed(snapshot), _battery(snapshot)]
    if status is not None and status.get("ok"):
        loop = status["loop"]
        lateness = f"{number(loop['lateness_us']['p99'], 0)} us late (99 %), {_overruns(loop['overruns'])}"
        rows.append(("loop", lateness))
    return _table(rows)


def live_details(
    status: Mapping[str, Any] | None,
    snapshot: Snapshot | None,
    missed: int,
    behind_ms: float | None,
) -> str:
    """Markdown of the other figures: robot, link, loop, motion.

    `missed` batches of the feed did not reach this page; what it shows is `behind_ms` old.
    """
    rows: Rows = [] if status is None or not status.get("ok") else _status_rows(status)
    rows.append(("page is behind", f"{number(behind_ms, 0)} ms, {missed} batches missed"))
    if snapshot is not None:
        rows += [*health_rows(snapshot), *motion_rows(snapshot)]
    return _table(rows)


def _status_rows(status: Mapping[str, Any]) -> Rows:
    loop = status["loop"]
    robot = _robot(status["robot_state"], status["fault"], status["stop_cause"])
    link = status["link"] + (f": {status['link_error']}" if status["link_error"] else "")
    transport, driver = status["transport"], status["driver"]
    rejected = sum(count for name, count in driver.items() if name.startswith("rejected"))
    rows: Rows = [
        ("robot", robot),
        ("link", link),
        ("frames", f"{transport['frames_received']} in, {transport['frames_sent']} out"),
        ("rejected, lost", f"{rejected + transport['malformed']}, {driver['lost_frames']}"),
        ("loop late p99, max", f"{number(loop['lateness_us']['p99'], 0)}, {number(loop['lateness_us']['max'], 0)} us"),
        ("overruns, skipped", f"{loop['overruns']}, {loop['skipped']}"),
    ]
    recorder = status["recorder"]
    if recorder["path"]:
        rows.append(("recording", describe_recording(recorder)))
    if len(status.get("poses", ())) > 1:
        rows += [(f"poses {which}", _source(one)) for which, one in enumerate(status["poses"], 1)]
    return rows


def _source(one: Mapping[str, Any]) -> str:
    """Describe the standing of one of several pose sources."""
    age = "none received" if one["age_s"] is None else f"the last {one['age_s']:.2f} s ago"
    return f"{one['source']}: {one['standing']}, {age}, {one['outliers']} outliers"


def replay_text(snapshot: Snapshot, first_ns: int, task: RobotTask) -> str:
    """Markdown of what matters first at one instant of a log."""
    state, status = snapshot.state, snapshot.status
    head, detail = status.state if status is not None else "state not recorded", ""
    if state is not None:
        by_hand = snapshot.in_force and snapshot.source == Source.MANUAL.value
        head, detail = headline(state.state, state.reason, state.running, state.estop, by_hand)
    lines = [f"### {head}", ""]
    if detail:
        lines += [escaped(detail), ""]
    if status is not None and status.fault != "NONE":
        lines += [f"**{escaped(fault_sentence(status.fault))}**", ""]
    rows: Rows = [("time", f"{(snapshot.t_ns - first_ns) * 1e-9:.3f} s")]
    if snapshot.pose is not None:
        off_m = task.course().off_m(np.array([snapshot.pose[:2]]))[0]
        rows.append(("distance", f"{number(off_m, 3)} m"))
    rows += [_speed(snapshot), _battery(snapshot)]
    rows.append(("loop", f"{number(snapshot.lateness_us, 0)} us late, {_overruns(snapshot.overruns)}"))
    return "\n".join([*lines, _table(rows)])


def replay_details(snapshot: Snapshot) -> str:
    """Markdown of the other figures at one instant of a log."""
    status = snapshot.status
    rows: Rows = [] if status is None else [("robot", _robot(status.state, status.fault, status.stop_cause))]
    rows.append(("ticks skipped", str(snapshot.skipped)))
    return _table([*rows, *health_rows(snapshot), *motion_rows(snapshot)])


def _overruns(count: int) -> str:
    return f"{count} overrun{'' if count == 1 else 's'}"


def _speed(snapshot: Snapshot) -> tuple[str, str]:
    return "speed", f"{number(snapshot.speed_m_s, 3)} m/s, {number(snapshot.yaw_rate_rad_s, 2)} rad/s"


def _battery(snapshot: Snapshot) -> tuple[str, str]:
    current, warmth = number(snapshot.current_a, 1), number(snapshot.battery_c, 0)
    return "battery", f"{number(snapshot.voltage_v, 1)} V, {current} A, {warmth} °C"


def motion_rows(snapshot: Snapshot) -> Rows:
    """Return the panel's rows about the motion, as (label, value)."""
    rows: Rows = []
    if snapshot.pose is not None:
        x_m, y_m, yaw_rad = snapshot.pose
        trust = "" if snapshot.pose_healthy else " (no fresh pose)"
        rows.append(("pose", f"{x_m:.3f}, {y_m:.3f} m, {math.degrees(yaw_rad):.1f}°{trust}"))
    rows.append(("wheels", _pair(snapshot.wheel_speeds)))
    commanded = _pair(snapshot.command) if snapshot.in_force else "none in force"
    rows.append(("commanded", f"{commanded} ({snapshot.source})" if snapshot.source else commanded))
    if snapshot.plan is not None:
        plan = snapshot.plan
        rows.append(("effective samples", number(plan.effective_samples, 1)))
        rows.append(("temperature", number(plan.temperature, 4)))
    return rows


def health_rows(snapshot: Snapshot) -> Rows:
    """Return the panel's rows about link and belief, as (label, value)."""
    rows: Rows = []
    if snapshot.link is not None:
        it = snapshot.link
        rows.append(
            ("bus errors", f"{it.tx_error_count} sent, {it.rx_error_count} received, {it.bus_off_count} bus-off")
        )
        rows.append(
            ("robot refused", f"{it.crc_error_count} CRC, {it.sequence_error_count} sequence, {it.watchdog_count} late")
        )
    if snapshot.belief is not None:
        rows.append(("belief", "adapted" if snapshot.belief.source == "adapted" else "model file's again"))
    if snapshot.adaptation is not None:
        rows.append(("adaptation", snapshot.adaptation.text))
    return rows


def coverage_text(items: Sequence[Mapping[str, Any]]) -> str:
    """Markdown of what a drive has excited, what is missing first."""
    rows = []
    for item in sorted(items, key=lambda item: bool(item["covered"])):
        found = f"{min(item['found'], item['wanted']):.0f} of {item['wanted']:.0f} {item['unit']}"
        rows.append((f"{'✔' if item['covered'] else '○'} {item['name']}", found))
    missing = sum(not item["covered"] for item in items)
    head = f"{missing} of {len(items)} still missing" if missing else "nothing is missing"
    return f"**{head}**\n\n{_table(rows)}"


def events_text(snapshot: Snapshot | None, first_ns: int | None) -> str:
    """Markdown of the newest events, newest first."""
    if snapshot is None or first_ns is None or not snapshot.events:
        return "nothing yet"
    return "\n".join(
        f"- `{(t_ns - first_ns) * 1e-9:8.2f} s` {escaped(event.text)}" for t_ns, event in reversed(snapshot.events)
    )


def number(value: float | None, digits: int) -> str:
    """Return a number, or a dash where there is none."""
    return _NO_NUMBER if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def escaped(text: str) -> str:
    """Text from elsewhere, so that it can be no markup of the page."""
    plain = html.escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{letter}" if letter in "\\`*_[]{}#|!~$" else letter for letter in plain)


def _robot(state: str, fault: str, stop_cause: str) -> str:
    fault_text = "no fault" if fault == "NONE" else f"fault: {describe(fault).lower()}"
    return f"{state}, {fault_text}" + ("" if stop_cause == "NONE" else f", last stop: {describe(stop_cause).lower()}")


def _pair(values: tuple[float, float] | None) -> str:
    return _NO_NUMBER if values is None else f"{values[0]:.2f}, {values[1]:.2f} rad/s"


def _table(rows: Rows) -> str:
    return "\n".join(["| | |", "|---|---|", *(f"| {what} | {escaped(text)} |" for what, text in rows)])
