"""Records to test with: plain ones, a driven tick, and logs made of them in memory."""

import io
import math
import struct
from pathlib import Path

import msgspec
from mcap.reader import make_reader

from disco_hw.log import Attachment, Start, batch_encoder
from disco_hw.log.mcap_log import McapLog
from disco_hw.log.records import Command, Counters, Estimate, Event, FrameIn, FrameOut, LoopTiming, Plan
from drivers.types import PoseSample, WheelSample

WALL_OFFSET_NS = 1_700_000_000_000_000_000
PERIOD_NS = 20_000_000
ROBOT_TOML = b'[robot]\nname = "wombot"\nticks_per_rev = 2048\n'
ATTACHMENTS = (
    Attachment("robot.toml", "application/toml", ROBOT_TOML),
    Attachment("disco_robot.dbc", "text/plain", b"VERSION"),
)


def tick(k, t_ns=None):
    """The records of tick k of a steady drive: a wheel turns by 0.04 rad a tick, a pose comes with every fifth."""
    t_ns = k * PERIOD_NS if t_ns is None else t_ns
    angle = 0.04 * k
    records = [
        FrameIn(t_ns - 300, 0x101, bytes([k & 0xFF, 1, 2, 3])),
        FrameOut(t_ns, 0x80, b"\x01\x02", t_ns + 10**8),
        WheelSample(t_ns - 10**6, t_ns - 300, angle, 1.1 * angle, 2.0, 2.2),
        Estimate(
            t_ns, 0.002 * k, 0.1, 0.01 * k, (1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-4), 0.12, 0.01, 2.0, 2.2
        ),
        Plan(
            t_ns, t_ns, 0.1, (2.0, 2.1), (2.2, 2.3), path_x_m=(0.0, 0.1), path_y_m=(0.0, 0.0), path_yaw_rad=(0.0, 0.1)
        ),
        Command(t_ns, 2.5, 2.7, 2.0, 2.2, 0.1, True, "plan", ("acceleration",), PERIOD_NS),
        LoopTiming(t_ns, k, t_ns + 50_000, 50_000, {"receive": 40_000, "plan": 3_000_000}),
    ]
    if k % 5 == 0:
        records.append(PoseSample(t_ns - 5 * 10**6, t_ns, 0.002 * k, 0.1, 0.01 * k, 0.01, 0.02))
    if k % 50 == 0:
        records.append(Counters(t_ns, transport={"frames_sent": k}, loop={"ticks": k}))
        records.append(Event(t_ns, "info", "tick", f"tick {k}"))
    return records


def start(path=Path("memory"), **changes):
    given = {
        "path": str(path),
        "robot": "wombot",
        "version": "1.2.3",
        "part": 1,
        "start_ns": 5,
        "wall_offset_ns": WALL_OFFSET_NS,
        "attachments": ATTACHMENTS,
    }
    return Start(**(given | changes))


def log_bytes(ticks, finish=True, flush_every=None, numbers=False, end=None, **changes):
    """A log in memory: `ticks` are (now_ns, records); `flush_every` ends a chunk after so many ticks.

    With `numbers` a tick's number is its time in periods, so that a missing one leaves a gap.
    """
    sink = io.BytesIO()
    log = McapLog(sink, start(**changes))
    encode = batch_encoder()
    for number, (now_ns, records) in enumerate(ticks, start=1):
        log.write(encode(now_ns // PERIOD_NS if numbers else number, now_ns, records))
        if flush_every and number % flush_every == 0:
            log.flush()
    log.flush()
    if end is not None:
        log.end(end)
    if finish:
        log.finish()
    return sink.getvalue()


def with_damaged_chunk(content):
    """The log with one bit of the data of its middle chunk turned over."""
    chunks = make_reader(io.BytesIO(content)).get_summary().chunk_indexes
    chunk = chunks[len(chunks) // 2]
    damaged = bytearray(content)
    damaged[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    return bytes(damaged)


def drive_ticks(count):
    return [(k * PERIOD_NS, tick(k)) for k in range(1, count + 1)]


def write_log(path, ticks, **changes):
    path.write_bytes(log_bytes(ticks, **changes))
    return path


def bits(value):
    """A value with its floats replaced by their bits; every NaN is the same."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else struct.pack("<d", value)
    if isinstance(value, list | tuple):
        return tuple(bits(item) for item in value)
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if hasattr(value, "t_ns"):
        return (type(value), bits(msgspec.to_builtins(value)))
    return value
