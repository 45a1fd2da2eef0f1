"""What `disco-hw log info`, `recover` and `export` do; each returns the text to print."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import cast

import msgspec

from disco_hw.log.importing.csv_drive import write_csv
from disco_hw.log.load import drive_from_log, nominal_geometry, ticks_per_rev
from disco_hw.log.reader import LogSummary, open_log
from disco_hw.log.records import Controller
from disco_hw.log.recovery import recover as recover_log
from disco_hw.log.rosbag.export import write_rosbag
from drivers.types import SAID_BY_WORDS, Identity, SaidBy


def info(path: Path, as_json: bool) -> str:
    """What a log holds and what of it is lost; raises LogError."""
    with open_log(path) as log:
        summary = log.summary()
        if as_json:
            return msgspec.json.encode(summary).decode()
        answered = list(log.records(("/controller",))) if "/controller" in summary.topics else []
    said = [_controller(entry.record) for entry in answered if isinstance(entry.record, Controller)]
    return "\n".join([_in_words(summary), *dict.fromkeys(said)])


def recover(path: Path, out: Path, as_json: bool) -> str:
    """Copy everything whole from a damaged log into a new one; raises LogError."""
    recovered = recover_log(path, out)
    if as_json:
        return json.dumps({"out": str(out)} | asdict(recovered))
    lines = [f"{out}: {recovered.messages} messages in {recovered.chunks} chunks, {recovered.attachments} attachments"]
    lines += [f"lost: {loss}" for loss in recovered.lost] or ["nothing was lost"]
    return "\n".join(lines)


def export(path: Path, out: Path, as_json: bool) -> str:
    """Write commands, encoders and poses of a log as CSV; raises LogError."""
    with open_log(path) as log:
        drive = drive_from_log(log)
        rows = write_csv(drive, out, ticks_per_rev(log))
    if as_json:
        return json.dumps({"out": str(out), "rows": rows, "segments": drive.segments, "notes": drive.notes})
    return "\n".join([f"{out}: {rows} rows, {drive.segments} segments", *drive.notes])


def export_rosbag(path: Path, out: Path, as_json: bool) -> str:
    """Write commands, wheels and poses of a log as a bag of ROS 2; raises LogError, InputError without `rosbags`."""
    with open_log(path) as log:
        drive = drive_from_log(log)
        times = (log.columns(topic).get("t_ns") for topic in ("/command", "/wheels", "/pose"))
        first_ns = min(int(t_ns.min()) for t_ns in times if t_ns is not None and t_ns.size)
        messages = write_rosbag(drive, out, first_ns + log.metadata.wall_offset_ns, nominal_geometry(log))
    if as_json:
        return json.dumps({"out": str(out), "messages": messages, "segments": drive.segments, "notes": drive.notes})
    return "\n".join([f"{out}: {messages} messages, {drive.segments} segments", *drive.notes])


def _controller(record: Controller) -> str:
    """Which controller answered, and its limits by who says them."""
    identity = Identity(record.controller, record.firmware, cast(SaidBy, record.said_by), record.details)
    limits: dict[SaidBy, dict[str, float]] = {
        "device": record.told,
        "fixed": record.fixed,
        "robot.toml": record.declared,
    }
    words = [
        f"{', '.join(f'{name} {value:g}' for name, value in values.items())} ({SAID_BY_WORDS[said_by]})"
        for said_by, values in limits.items()
        if values
    ]
    return f"controller: {identity.in_words()}; {'; '.join(words)}"


def _end_in_words(summary: LogSummary) -> str:
    """What the file proves of its end."""
    if summary.ended:
        return "ended properly" if summary.complete else "ended by its recorder, but the file is not whole"
    if summary.ended is None:
        index = "whole" if summary.complete else "without its end"
        return f"the file is {index}, and its version did not record whether its recorder ended it"
    return f"nothing after {summary.end}: the daemon or its recorder was gone then, or the log is still being written"


def _in_words(summary: LogSummary) -> str:
    size_mb = summary.bytes / 1e6
    lines = [
        f"{summary.path}: {summary.robot}, {summary.duration_s:.1f} s from {summary.start}, {size_mb:.2f} MB",
        f"recorded by disco-hw {summary.version or 'of unknown version'}, part {summary.part}",
        f"{summary.ticks} ticks, {summary.missing_ticks} missing; {_end_in_words(summary)}",
    ]
    lines += [f"continues {summary.continues}"] if summary.continues else []
    lines += [
        f"  {topic:<24} {item.count:>9}  {item.rate_hz:8.1f} Hz" for topic, item in sorted(summary.topics.items())
    ]
    lines += [f"  attached: {name}, {size} bytes" for name, size in summary.attachments.items()]
    lines += [f"lost: {loss}" for loss in summary.damage]
    return "\n".join(lines)
