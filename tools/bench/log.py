"""Benchmark of recording: what it costs the loop, what the writer does with it, and how fast a log opens."""

from __future__ import annotations

import random
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from disco_hw.log import batch_encoder
from disco_hw.log.log_command import recover_log
from disco_hw.log.mcap_log import McapLog
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.reader import open_log
from disco_hw.log.records import Command, Estimate, FrameIn, FrameOut, Innovation, LoopTiming, Plan, Record
from disco_hw.log.writer import LogFile, Start
from drivers.types import PoseSample, WheelSample
from tools.bench.step_times import summary

HORIZON = 50
RATE_HZ = 50
LIVE_S = 10.0
PLAN_NS = 2_000_000
LONG_S = 600.0


def run() -> dict[str, float]:
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        return _live(directory / "live.mcap") | _long(directory)


def _tick(k: int, now_ns: int) -> list[Record]:
    """Return the thirteen records of one tick of a drive at 50 Hz, with a plan in every tick."""
    number = random.random
    speeds = tuple(number() for _ in range(HORIZON))
    return [
        *(FrameIn(now_ns, 0x101 + i, bytes(8)) for i in range(4)),
        *(FrameOut(now_ns, 0x80 + i, bytes(8), now_ns + 10**8) for i in range(2)),
        WheelSample(now_ns, now_ns, number(), number(), number(), number()),
        PoseSample(now_ns, now_ns, number(), number(), number(), 0.01, 0.02),
        Innovation(now_ns, (number(), number(), number()), (number(), number(), number()), 0.1, True),
        Estimate(now_ns, number(), number(), number(), tuple(number() for _ in range(9)), 0.2, 0.1, 2.0, 2.0),
        Plan(now_ns, now_ns, 0.1, speeds, speeds, 100.0, 1.0, 0.1, 0.2, speeds, speeds, speeds),
        Command(now_ns, number(), number(), number(), number(), 0.1, True, "plan", ("acceleration",), 20_000_000),
        LoopTiming(now_ns, k, now_ns, 50_000, {"receive": 40_000, "estimate": 90_000, "plan": 3_000_000}),
    ]


def _live(path: Path) -> dict[str, float]:
    """The recorder as the loop uses it, in real time, with the writer's process beside it."""
    recorder = ProcessRecorder(RecordingSettings(path, "bench"))
    # Linux gives the processor time of a child when it is waited for.
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    put_us, poll_us = [], []
    planned = np.ones(4000)
    started_ns = time.monotonic_ns()
    for k in range(round(LIVE_S * RATE_HZ)):
        records = _tick(k, time.monotonic_ns())
        # The planner works just before a tick is recorded; without it the figure is that of cold caches.
        plan_until_ns = time.monotonic_ns() + PLAN_NS
        while time.monotonic_ns() < plan_until_ns:
            planned = np.tanh(planned)
        begin = time.perf_counter_ns()
        recorder.put(time.monotonic_ns(), records)
        put_us.append((time.perf_counter_ns() - begin) * 1e-3)
        if k % RATE_HZ == 0:
            begin = time.perf_counter_ns()
            recorder.poll()
            poll_us.append((time.perf_counter_ns() - begin) * 1e-3)
        time.sleep(max(0.0, (started_ns - time.monotonic_ns()) * 1e-9 + (k + 1) / RATE_HZ))
    stats = recorder.close()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    writer_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        **summary("log.put_tick_us", np.array(put_us)),
        "log.records_per_tick": stats.records / stats.ticks,
        "log.poll_us.p50": float(np.median(poll_us)),
        "log.dropped_ticks": float(stats.dropped_ticks),
        "log.writer_cpu_share": writer_s / LIVE_S,
        "log.mb_per_minute": stats.bytes / 1e6 * 60.0 / LIVE_S,
    }


def _long(directory: Path) -> dict[str, float]:
    """Ten minutes of driving, written as fast as it goes, then read."""
    path = directory / "long.mcap"
    ticks = round(LONG_S * RATE_HZ)
    encode = batch_encoder()
    messages = [encode(k, k * 10**9 // RATE_HZ, _tick(k, k * 10**9 // RATE_HZ)) for k in range(1, 501)]
    file = LogFile(path)
    log = McapLog(file, Start(str(path), "bench", "", 0, 0))
    begin = time.perf_counter()
    for k in range(ticks):
        log.write(messages[k % len(messages)])
    log.finish()
    write_s = time.perf_counter() - begin
    file.close()
    cut = directory / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-1000])
    figures = {
        "log.write_us_per_record": write_s * 1e6 / log.records,
        "log.ten_minutes_mb": path.stat().st_size / 1e6,
        "log.open_ten_minutes_ms": _milliseconds(lambda: open_log(path).close()),
        "log.open_cut_ten_minutes_ms": _milliseconds(lambda: open_log(cut).close()),
        "log.recover_ten_minutes_ms": _milliseconds(lambda: recover_log(cut, directory / "mended.mcap")),
    }
    with open_log(path) as opened:
        figures["log.columns_ten_minutes_ms"] = _milliseconds(lambda: opened.columns("/estimate"))
        figures["log.summary_ten_minutes_ms"] = _milliseconds(opened.summary)
    return figures


def _milliseconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return (time.perf_counter() - begin) * 1e3
