"""The last half minute of samples as a drive that inference can read."""

from __future__ import annotations

from bisect import insort

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.link import PoseReading, Samples, WheelAngles
from disco_hw.inference.excitation import Excitation, UnusableDriveError, excitation
from disco_hw.log.drive import Commands, DriveLog, Gyro, Poses
from disco_hw.log.drive import Wheels as WheelArrays

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LONGEST_GAP_NS = 500_000_000
_NOTHING: Array = np.empty(0)
_NO_SEGMENT: Index = np.empty(0, dtype=np.int64)


class SampleWindow:
    """Samples of the last `length_s`, in the order of their stamps; times in seconds since the first sample."""

    def __init__(self, length_s: float) -> None:
        self._length_ns = round(length_s * 1e9)
        self._wheels: list[WheelAngles] = []
        self._poses: list[PoseReading] = []
        self._zero_ns: int | None = None

    def add(self, samples: Samples) -> None:
        """Take in what came with one tick; repeated stamps and values that are not finite are left out."""
        for wheels in samples.wheels:
            if np.isfinite([wheels.left_rad, wheels.right_rad]).all():
                _insert(self._wheels, wheels)
        for pose in samples.poses:
            if np.isfinite([pose.x_m, pose.y_m, pose.yaw_rad]).all():
                _insert(self._poses, pose)
        if self._zero_ns is None and self._wheels:
            self._zero_ns = self._wheels[0].t_ns
        oldest_ns = samples.now_ns - self._length_ns
        _trim(self._wheels, oldest_ns)
        _trim(self._poses, oldest_ns)

    def seconds(self, t_ns: int) -> float:
        """A time as in the drive."""
        return 0.0 if self._zero_ns is None else (t_ns - self._zero_ns) * 1e-9

    def newest_ns(self) -> int:
        """Stamp of the newest pose; 0 without one."""
        return self._poses[-1].t_ns if self._poses else 0

    def drive(self, since_s: float = -np.inf) -> Excitation:
        """The drive from `since_s` on; raises UnusableDriveError where it says nothing."""
        wheels = [w for w in self._wheels if self.seconds(w.t_ns) >= since_s]
        poses = [p for p in self._poses if self.seconds(p.t_ns) >= since_s]
        if len(wheels) < 2 or len(poses) < 2:
            raise UnusableDriveError("no wheel samples or poses")
        wheel_ns = np.array([w.t_ns for w in wheels])
        pose_ns = np.array([p.t_ns for p in poses])
        breaks = wheel_ns[1:][np.diff(wheel_ns) > _LONGEST_GAP_NS]
        return drive_of(
            np.array([self.seconds(w.t_ns) for w in wheels]),
            np.array([(w.left_rad, w.right_rad) for w in wheels]),
            np.searchsorted(breaks, wheel_ns, side="right"),
            np.array([self.seconds(p.t_ns) for p in poses]),
            np.array([(p.x_m, p.y_m, p.yaw_rad) for p in poses]),
            np.searchsorted(breaks, pose_ns, side="right"),
        )


def drive_of(
    wheel_s: Array, angle_rad: Array, wheel_segment: Index, pose_s: Array, pose: Array, pose_segment: Index
) -> Excitation:
    """A drive of wheel angles (W, 2) and poses (P, 3), each with its times and segments; raises UnusableDriveError."""
    speed = np.gradient(angle_rad, wheel_s, axis=0)
    log = DriveLog(
        ("the running drive",),
        Commands(_NOTHING, _NOTHING, _NOTHING, _NO_SEGMENT),
        WheelArrays(wheel_s, angle_rad[:, 0], angle_rad[:, 1], speed[:, 0], speed[:, 1], wheel_segment, True, True),
        Poses(pose_s, pose[:, 0], pose[:, 1], pose[:, 2], pose_segment),
        Gyro(_NOTHING, _NOTHING, _NO_SEGMENT),
    )
    return excitation(log, "encoders")


def _insert(samples: list, sample: WheelAngles | PoseReading) -> None:  # type: ignore[type-arg]
    if not samples or sample.t_ns > samples[-1].t_ns:
        samples.append(sample)
    elif all(sample.t_ns != other.t_ns for other in samples[-20:]):
        insort(samples, sample, key=lambda each: each.t_ns)


def _trim(samples: list, oldest_ns: int) -> None:  # type: ignore[type-arg]
    count = 0
    while count < len(samples) and samples[count].t_ns < oldest_ns:
        count += 1
    del samples[:count]
