"""Goes through the whole tick once before it matters.

What runs for the first time loads code and allocates buffers: with all memory locked, the first matrix product alone
was seen to hold the loop for 10 to 90 ms.
"""

from __future__ import annotations

import math

from disco_hw.runtime.pipeline import FollowTask, Off, Pipeline, Stand
from drivers.types import PoseSample, Readings, WheelSample

_PERIOD_NS = 20_000_000
_POSE_DELAY_NS = 30_000_000
_TICKS = 60
_WHEEL_RAD_S = 2.0
_ON_THE_WAY = 20


def warm_up(pipeline: Pipeline) -> None:
    """Drive a pipeline that is thrown away afterwards through standing, driving, late and absurd poses."""
    pipeline.step(0, Readings(), Off())
    for tick in range(1, _TICKS):
        now_ns = tick * _PERIOD_NS
        pipeline.step(now_ns, _readings(now_ns, tick), FollowTask() if tick > _ON_THE_WAY else Stand())
        pipeline.rollouts(1)


def _readings(now_ns: int, tick: int) -> Readings:
    speed = _WHEEL_RAD_S if tick > _ON_THE_WAY else 0.0
    angle = _WHEEL_RAD_S * max(0, tick - _ON_THE_WAY) * _PERIOD_NS * 1e-9
    wheels = WheelSample(now_ns, now_ns, angle, 1.5 * angle, speed, 1.5 * speed)
    far_off = math.nan if tick == _TICKS - 2 else 1.0 if tick == _TICKS - 3 else 0.0
    pose = PoseSample(now_ns - _POSE_DELAY_NS, now_ns, far_off, 0.06 * angle, 0.5 * math.pi, 0.005, 0.01)
    return Readings(wheels=(wheels,), poses=(pose,) if tick > 1 else ())
