"""Logs that a host would have of a plant under a drive, in simulated time, and the same as CSV.

One row per event, sorted by time stamp; empty cells mean "no sample at that time". The truth stays out of the log.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt

from disco_hw.log.drive import DriveLog
from disco_hw.log.load import load_drive
from sim.effects import HiddenEffects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.sensors import PoseMeasurement
from tools.simulated_drives import ScriptedDrive

COLUMNS = (
    "t_s",
    "cmd_left_rad_s",
    "cmd_right_rad_s",
    "enc_left_ticks",
    "enc_right_ticks",
    "pose_x_m",
    "pose_y_m",
    "pose_yaw_rad",
)
DIGITS = (6, 5, 5, 0, 0, 5, 5, 6)
"""Digits behind the point of each column."""
LARGEST_JITTER_PERIODS = 0.4
SETTLING_S = 0.5

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LogOptions:
    """Options of how the host samples and stamps.

    `lateness_s`: mean (exponential) of how late commands and encoder readings happen; `stamp_jitter_s`: standard
    deviation of the error of every time stamp.
    """

    encoder_rate_hz: float = 50.0
    lateness_s: float = 0.0005
    stamp_jitter_s: float = 0.0003


def dirty_log_options() -> LogOptions:
    """Options of a busy host, with time stamps off by milliseconds."""
    return LogOptions(lateness_s=0.002, stamp_jitter_s=0.004)


def dirty_parameters(parameters: PlantParameters) -> PlantParameters:
    """Return the same robot in a worse world: bursts and drift in the disturbances, poses that jump and drop out."""
    return replace(
        parameters,
        volatility=0.5,
        wheel_drift_std=0.01,
        pose_noise_correlation_s=0.1,
        pose_noise_volatility=0.4,
        pose_sample_jitter_s=0.005,
        pose_dropout_probability=0.02,
        pose_gap_interval_s=60.0,
        pose_outlier_probability=0.005,
    )


def varied_parameters(parameters: PlantParameters, seed: int) -> PlantParameters:
    """A robot off its drawing: radius by 2 %, axial distance by 4 % (standard deviation), x_icr by 30 mm."""
    radius, axial, x_icr = np.random.default_rng(seed).standard_normal(3).clip(-2.5, 2.5)
    return replace(
        parameters,
        wheel_radius_m=parameters.wheel_radius_m * (1.0 + 0.02 * float(radius)),
        axial_distance_m=parameters.axial_distance_m * (1.0 + 0.04 * float(axial)),
        x_icr_m=parameters.x_icr_m + 0.03 * float(x_icr),
    )


def simulated_log(
    drive: ScriptedDrive,
    parameters: PlantParameters | None = None,
    effects: HiddenEffects | None = None,
    seed: int = 0,
    options: LogOptions | None = None,
) -> Floats:
    """Rows (N, 8) of the log in the order of `COLUMNS`, sorted by time stamp, as exact as its file; NaN: no sample.

    Encoder counters start anywhere. `seed` decides the plant's noise and the time stamps, not the drive.
    """
    options = options or LogOptions()
    plant_seed, host_seed = (int(child.generate_state(1)[0]) for child in np.random.SeedSequence(seed).spawn(2))
    generator = np.random.default_rng(host_seed)
    left_start, right_start = (int(start) for start in generator.integers(-(2**20), 2**20, size=2))
    parameters = replace(
        parameters or PlantParameters(), encoder_start_left_ticks=left_start, encoder_start_right_ticks=right_start
    )
    plant = Plant(parameters, effects, plant_seed)
    command_s = _delayed(drive.t_s, drive.period_s, options, generator)
    reading_period_s = 1.0 / options.encoder_rate_hz
    reading_s = _delayed(np.arange(0.0, drive.duration_s, reading_period_s), reading_period_s, options, generator)
    stamps = _stamped(command_s, drive.period_s, options, generator)
    ticks, poses = _run(plant, drive, command_s, reading_s)
    stamps += _stamped(reading_s, reading_period_s, options, generator)
    pose_s = np.array([pose.sample_us for pose in poses], dtype=np.float64) * 1e-6
    stamps += _stamped(pose_s, 1.0 / parameters.pose_rate_hz, options, generator)
    rows = np.full((len(stamps), len(COLUMNS)), np.nan)
    first_reading, first_pose = len(command_s), len(command_s) + len(reading_s)
    rows[:, 0] = stamps
    rows[:first_reading, 1], rows[:first_reading, 2] = drive.left_rad_s, drive.right_rad_s
    rows[first_reading:first_pose, 3:5] = ticks
    rows[first_pose:, 5:] = np.reshape([(pose.x_m, pose.y_m, pose.yaw_rad) for pose in poses], (-1, 3))
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    rows[:, 0] = _apart(rows[:, 0])
    for column, digits in enumerate(DIGITS[1:], 1):
        rows[:, column] = [round(value, digits) for value in rows[:, column].tolist()]
    return rows


def _apart(t_s: Floats) -> list[float]:
    """Sorted times in whole microseconds, those moved on by one that would be the same as the time before."""
    separate: list[float] = []
    last_us = -1
    for value in t_s.tolist():
        last_us = max(round(value * 1e6), last_us + 1)
        separate.append(last_us * 1e-6)
    return separate


def write_csv(path: Path, rows: Floats) -> None:
    """Write rows under a header of `COLUMNS`. Raises OSError."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows.tolist():
            writer.writerow("" if math.isnan(v) else f"{v:.{digits}f}" for v, digits in zip(row, DIGITS, strict=True))


def read_back(rows: Floats, ticks_per_rev: int) -> DriveLog:
    """Rows as they are read from their CSV file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_csv(path, rows)
        return load_drive(path, ticks_per_rev)


def _run(
    plant: Plant, drive: ScriptedDrive, command_s: Floats, reading_s: Floats
) -> tuple[list[tuple[int, int]], list[PoseMeasurement]]:
    """Give each command at its time, read the encoders at theirs; collect ticks and poses."""
    command_us = np.round(command_s * 1e6).astype(np.int64).tolist()
    events = [(t_us, k) for k, t_us in enumerate(command_us)]
    events += [(round(t_s * 1e6), -1) for t_s in reading_s.tolist()]
    commands = list(zip(drive.left_rad_s.tolist(), drive.right_rad_s.tolist(), strict=True))
    left, right = 0.0, 0.0
    ticks: list[tuple[int, int]] = []
    poses: list[PoseMeasurement] = []
    for t_us, command in sorted(events):
        poses += plant.step(t_us, left, right)
        if command < 0:
            ticks.append(plant.encoder_ticks)
        else:
            left, right = commands[command]
    last_us = round(drive.duration_s * 1e6)
    poses += plant.step(max(last_us, plant.now_us) + round(SETTLING_S * 1e6), left, right)
    return ticks, [pose for pose in poses if pose.sample_us <= last_us]


def _delayed(t_s: Floats, period_s: float, options: LogOptions, generator: np.random.Generator) -> Floats:
    """When things due at t_s really happen."""
    delay_s = generator.exponential(options.lateness_s, size=len(t_s)) if options.lateness_s > 0.0 else 0.0
    return t_s + np.minimum(delay_s, LARGEST_JITTER_PERIODS * period_s)


def _stamped(t_s: Floats, period_s: float, options: LogOptions, generator: np.random.Generator) -> list[float]:
    """Time stamps of what happened at t_s; never before 0."""
    most_s = LARGEST_JITTER_PERIODS * period_s
    error_s = np.clip(options.stamp_jitter_s * generator.standard_normal(len(t_s)), -most_s, most_s)
    stamps: list[float] = np.maximum(t_s + error_s, 0.0).tolist()
    return stamps
