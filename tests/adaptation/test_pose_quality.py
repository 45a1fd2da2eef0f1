"""Quality of poses, measured: what is good enough to learn from, and when that is found and told."""

import math

import msgspec
import numpy as np
import pytest

from disco_hw.adaptation.pose_quality import PoseWatch, measured_quality
from drivers.types import PoseSample

S = 1_000_000_000


def stream(seconds, rate_hz=25.0, noise_m=0.004, noise_rad=0.005, stated_stds=(0.001, 0.001), delay_s=0.03, seed=0):
    """Poses of a robot on a circle of 0.75 m at 0.2 m/s."""
    generator = np.random.default_rng(seed)
    found = []
    for t_s in np.arange(0.0, seconds, 1.0 / rate_hz):
        angle = 0.2 / 0.75 * t_s
        x_m, y_m = 0.75 * np.array([math.cos(angle), math.sin(angle)]) + noise_m * generator.standard_normal(2)
        yaw_rad = math.remainder(angle + 2.9 + noise_rad * generator.standard_normal(), 2.0 * math.pi)
        stamp_ns = round(t_s * S)
        found.append(PoseSample(stamp_ns, stamp_ns + round(delay_s * S), float(x_m), float(y_m), yaw_rad, *stated_stds))
    return found


@pytest.mark.parametrize(("noise_m", "noise_rad"), [(0.001, 0.002), (0.004, 0.005), (0.03, 0.02)])
def test_the_noise_of_a_moving_robots_poses_is_measured(noise_m, noise_rad):
    quality = measured_quality(stream(60.0, noise_m=noise_m, noise_rad=noise_rad), 60.0)
    assert quality.position_std_m == pytest.approx(noise_m, rel=0.1)
    assert quality.yaw_std_rad == pytest.approx(noise_rad, rel=0.1)
    assert quality.rate_hz == pytest.approx(25.0, rel=0.01)
    assert quality.delay_s == pytest.approx(0.03)


def test_outliers_and_what_a_source_admits_are_both_heeded():
    poses = stream(20.0)
    wild = [PoseSample(p.t_ns, p.received_ns, p.x_m + 5.0, p.y_m, p.yaw_rad, 0.001, 0.001) for p in poses[::20]]
    poses[::20] = wild
    assert measured_quality(poses, 20.0).position_std_m < 0.006
    assert measured_quality(stream(20.0, stated_stds=(0.05, 0.03)), 20.0).position_std_m == 0.05
    assert measured_quality(stream(20.0, stated_stds=(0.05, 0.03)), 20.0).yaw_std_rad == 0.03


def test_without_headings_or_with_two_poses_nothing_is_good():
    bare = [PoseSample(p.t_ns, p.received_ns, p.x_m, p.y_m, math.nan, 0.001, math.nan) for p in stream(2.0)]
    assert "headings" in measured_quality(bare, 2.0).fault
    assert measured_quality(stream(2.0, rate_hz=1.0), 0.1).fault


def watched(watch, poses, tick_ns=20_000_000):
    """What is told, with its time in s."""
    reports, waiting, now_ns = [], list(poses), 0
    while waiting:
        now_ns += tick_ns
        due = [pose for pose in waiting if pose.received_ns <= now_ns]
        waiting = waiting[len(due) :]
        text = watch.step(now_ns, due)
        if text:
            reports.append((now_ns / S, text))
    return reports


def test_good_poses_are_found_in_seconds_and_told_once():
    watch = PoseWatch()
    reports = watched(watch, stream(20.0))
    assert watch.is_good
    assert len(reports) == 1
    assert 2.0 <= reports[0][0] < 2.2
    assert "estimated while driving: poses at 2" in reports[0][1]


@pytest.mark.parametrize(
    ("change", "expected_text"),
    [
        ({"rate_hz": 5.0}, "poses come at"),
        ({"noise_m": 0.03}, "positions scatter"),
        ({"noise_rad": 0.03}, "headings scatter"),
        ({"delay_s": 0.5}, "arrive 0.50 s late"),
    ],
)
def test_poses_that_are_not_good_enough_are_told_once_with_the_cause(change, expected_text):
    watch = PoseWatch()
    reports = watched(watch, stream(20.0, **change))
    assert not watch.is_good
    assert len(reports) == 1
    assert expected_text in reports[0][1]
    assert "not estimated" in reports[0][1]


def test_one_window_that_seems_worse_than_the_poses_are_is_not_reported():
    watch = PoseWatch()
    reports = watched(watch, [*stream(4.0, noise_rad=0.02), *(later(pose, 4.0) for pose in stream(6.0))])
    assert watch.is_good
    assert len(reports) == 1
    assert "estimated while driving" in reports[0][1]


def later(pose, by_s):
    """The pose of another time."""
    return msgspec.structs.replace(
        pose, t_ns=pose.t_ns + round(by_s * S), received_ns=pose.received_ns + round(by_s * S)
    )


def test_another_source_than_the_first_is_not_judged():
    watch = PoseWatch()
    others = [PoseSample(p.t_ns, p.received_ns, p.x_m, p.y_m, p.yaw_rad, 0.001, 0.001, source=1) for p in stream(6.0)]
    assert watched(watch, others) == []
    assert not watch.is_good
