"""Laps: sign, wrap, and a new count for each run."""

from __future__ import annotations

import math

import pytest

from disco_hw.tasks.circle import LapCounter


def drive(counter: LapCounter, laps: float, steps: int = 200) -> None:
    for k in range(steps + 1):
        angle = 2.0 * math.pi * laps * k / steps + 3.0
        counter.add(0, 1.0 + math.cos(angle), -2.0 + math.sin(angle), 0.0)


@pytest.mark.parametrize("laps", [0.5, 2.25, -1.75])
def test_counts_turns_in_both_directions(laps):
    counter = LapCounter(1.0, -2.0)
    drive(counter, laps)
    assert counter.laps == pytest.approx(laps)


def test_a_new_run_starts_a_new_count_and_a_pause_keeps_the_old_one():
    counter = LapCounter(1.0, -2.0)
    drive(counter, 1.0)
    counter.pause()
    assert counter.laps == pytest.approx(1.0)
    drive(counter, 0.5)
    assert counter.laps == pytest.approx(0.5)
