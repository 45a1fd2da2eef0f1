"""Synthetic drives for adaptation: the plant's own kinematics, written out here, with noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from disco_hw.adaptation.adapter_link import PoseReading, Samples, Triple, WheelAngles
from disco_hw.adaptation.recursive import SampleWindow
from disco_hw.inference.excitation import Excitation

TRUTH = (0.238, 0.061, 0.415)
TICK_NS = 20_000_000


def messages(
    seconds: float,
    seed: int = 1,
    truth: Triple = TRUTH,
    change_s: float = math.inf,
    changed: Triple = TRUTH,
    wheels: Callable[[float], tuple[float, float]] = lambda t_s: (
        2.5 + 0.8 * math.sin(0.9 * t_s),
        4.0 + 0.5 * math.sin(0.5 * t_s),
    ),
) -> list[Samples]:
    """What the daemon would hand on, tick by tick: wheel angles at 50 Hz, poses at 25 Hz with 5 mm and 10 mrad."""
    rng = np.random.default_rng(seed)
    x = y = yaw = left = right = 0.0
    found = []
    steps = 4
    for tick in range(1, round(seconds * 50) + 1):
        t_s = tick * 0.02
        x_icr, radius, axial = changed if t_s > change_s else truth
        speed_left, speed_right = wheels(t_s)
        for _ in range(steps):
            dt = 0.02 / steps
            v = 0.5 * radius * (speed_left + speed_right)
            omega = radius * (speed_right - speed_left) / axial
            moving = 1.0 if abs(v) + abs(omega) > 1e-3 else 0.0
            slip = moving * math.sqrt(dt) * rng.standard_normal(3) * (0.004, 0.004, 0.012)
            x += dt * (v * math.cos(yaw) + omega * x_icr * math.sin(yaw)) + slip[0]
            y += dt * (v * math.sin(yaw) - omega * x_icr * math.cos(yaw)) + slip[1]
            yaw += dt * omega + slip[2]
        left, right = left + 0.02 * speed_left, right + 0.02 * speed_right
        now_ns = tick * TICK_NS
        poses: tuple[PoseReading, ...] = ()
        if tick % 2 == 0:
            noise = rng.standard_normal(3) * (0.005, 0.005, 0.01)
            measured_yaw = math.remainder(yaw + noise[2], 2.0 * math.pi)
            poses = (PoseReading(now_ns, x + noise[0], y + noise[1], measured_yaw),)
        found.append(Samples(now_ns, (WheelAngles(now_ns, left, right),), poses))
    return found


def excited(seconds: float, **options: Any) -> Excitation:
    """The same as a drive."""
    window = SampleWindow(1e4)
    for message in messages(seconds, **options):
        window.add(message)
    return window.drive()
