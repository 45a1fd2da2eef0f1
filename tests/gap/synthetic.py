"""A short drive made with the model itself, so that what is right is known exactly: straights, spins, arcs, rests."""

from dataclasses import replace

import numpy as np

from disco_hw.gap.data import BODY
from disco_hw.gap.data.free_runs import read_angles
from disco_hw.gap.data.gridded_drive import GriddedDrive, GridSamples
from disco_hw.gap.noise.body_noise import BodyNoise
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.selection import Thresholds
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S

GEOMETRY = (0.06, 0.4, 0.1)
LIMITS = Thresholds(score=20.0, moves_m=0.001, unnamed_score=20.0)
NOISE = BodyNoise(0.004, 0.006, 1e-4, 1e-4, 1e-4, 1e-4, 0.3, 1e-4, 1e-3)
DRIVE = ((4, 4), (0, 0), (-3, 3), (4, -4), (6, 6), (2, 5), (5, 2), (-4, -4), (-1.5, 1.5), (1.5, -1.5), (3, 6), (0, 0))


def line_of(speed_rad_s):
    """A gridded drive of wheels at these speeds (M, 2), read without error every 2 cells, commands as the speeds."""
    speed = np.asarray(speed_rad_s, dtype=float)
    count = speed.shape[0]
    t_s = GRID_STEP_S * np.arange(count)
    angle = np.concatenate([np.zeros((1, 2)), GRID_STEP_S * np.cumsum(speed[:-1], axis=0)])
    nodes = np.arange(0, count - 1, 2)
    encoder = GridSamples(
        nodes, np.zeros(nodes.size), t_s[nodes], np.floor(t_s[nodes] / DEFAULT_SETTINGS.grid.block_s).astype(np.int64)
    )
    poses = np.arange(4, count - 2, 4)
    pose = GridSamples(
        poses, np.zeros(poses.size), t_s[poses], np.floor(t_s[poses] / DEFAULT_SETTINGS.grid.block_s).astype(np.int64)
    )
    return GriddedDrive(
        t_s, np.arange(count) == 0, speed.copy(), np.zeros(count), angle, speed, encoder, angle[nodes],
        2 * GRID_STEP_S, 0.0, 0.0, pose, np.zeros((poses.size, 3)),
    )  # fmt: skip


def body_channel(seed=0, **effects):
    """A body channel and its drive; its poses are the model's with these first parameters of motion effects."""
    line = line_of(np.repeat(np.array(DRIVE * 3, dtype=float), 200, axis=0))
    truth = BODY.neutral.copy()
    truth[:3] = GEOMETRY
    for name, value in effects.items():
        truth[next(place for column, place in BODY.place.items() if column.startswith(f"{name}."))] = value
    plain = BODY.neutral.copy()
    plain[:3] = GEOMETRY
    channel = BodyChannel.build(line, NOISE, plain)
    clean = np.empty((line.pose.t_s.size, 3))
    read_angles(channel.track(truth), line.pose.node, line.pose.fraction, clean)
    noise = np.random.default_rng(seed).standard_normal(clean.shape) * (0.004, 0.004, 0.006)
    line = replace(line, pose_values=clean + noise)
    return BodyChannel.build(line, NOISE, plain), line


def of_regression(columns, measured):
    """Minus the log likelihood of a sample, of a regression by Huber's weights whose steps are decompositions."""
    weight = np.ones(measured.size)
    for _ in range(4):
        fitted = np.linalg.lstsq(columns * weight[:, None], measured * weight, rcond=None)[0]
        left = np.abs(measured - columns @ fitted)
        limit = 2.0 * 1.4826 * np.median(left) + 1e-9
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-12)))
    return 0.5 * np.log(np.where(left < limit, left**2, limit * (2.0 * left - limit)).mean() + 1e-10)
