"""A short drive made with the model itself, so that what is right is known exactly: straights, spins, arcs, rests."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.data.free_runs import read_angles, run_wheels
from disco_hw.gap.data.gridded_drive import GriddedDrive, GridSamples
from disco_hw.gap.noise.body_noise import BodyNoise
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.search.selection import Selector, Thresholds, body_moves, wheel_moves
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
    block = np.floor(t_s / DEFAULT_SETTINGS.grid.block_s).astype(np.int64)
    encoder, pose = (
        GridSamples(nodes, np.zeros(nodes.size), t_s[nodes], block[nodes])
        for nodes in (np.arange(0, count - 1, 2), np.arange(4, count - 2, 4))
    )
    return GriddedDrive(
        t_s, np.arange(count) == 0, speed.copy(), np.zeros(count), angle, speed, encoder, angle[encoder.node],
        2 * GRID_STEP_S, 0.0, 0.0, pose, np.zeros((pose.node.size, 3)),
    )  # fmt: skip


def vector_of(layout=BODY, **values):
    """A channel's vector of a robot as drawn, with these entries: `effect__parameter`, or an effect's first."""
    vector = layout.neutral.copy()
    if layout is BODY:
        vector[:3] = GEOMETRY
    for name, value in values.items():
        start = name.replace("__", ".")
        vector[next(at for column, at in layout.place.items() if f"{column}.".startswith(f"{start}."))] = value
    return vector


def answered(command, added=None, **effects):
    """A drive whose wheels answer commands (M, 2), with what is added to them, by these effects; read exactly."""
    line, still = line_of(command), np.zeros_like(command)
    truth, added = vector_of(WHEEL, **effects), still if added is None else added
    angle = run_wheels(truth, np.array(GEOMETRY), command, added, line.first, line.t_s, still)
    speed = np.gradient(angle, GRID_STEP_S, axis=0)
    return replace(line, angle_rad=angle, speed_rad_s=speed, encoder_angle_rad=angle[line.encoder.node])


def wheels_on(line, noise=WheelNoise()):  # noqa: B008  (it is frozen)
    """The wheel channel of a drive."""
    return WheelChannel.build(line, noise, np.array(GEOMETRY))


def body_on(line, poses, use=None):
    """The body channel of a drive with these poses (P, 3)."""
    return BodyChannel.build(replace(line, pose_values=poses), NOISE, vector_of(), use)


def poses_of(line, vector, perturbation=None, seed=None):
    """Poses (P, 3) of a robot with this vector and perturbation of its motion; with a seed, seen with noise."""
    poses = np.empty((line.pose.t_s.size, 3))
    track = body_on(line, line.pose_values).track(vector, perturbation)
    read_angles(track, line.pose.node, line.pose.fraction, poses)
    if seed is None:
        return poses
    return poses + np.random.default_rng(seed).standard_normal(poses.shape) * (0.004, 0.004, 0.006)


def moved_by(channel, perturbation):
    """The body channel of a robot that moves by this (M, 3) too: m/s forward and left, rad/s."""
    moved = channel.track(channel.neutral, perturbation) - channel.track(channel.neutral)
    return body_on(channel.drive, channel.measured + moved[channel.samples.node])


def selector_of(channel, limits=LIMITS, **chosen):
    """The selector of a channel of wheels or of a body."""
    is_body = isinstance(channel, BodyChannel)
    moves = body_moves(channel) if is_body else wheel_moves(channel, channel.geometry)
    return Selector(channel, moves, limits, **chosen)


def searched(channel, names=(), limits=LIMITS):
    """A search of a channel that found these names."""
    return ChannelResult(selector_of(channel, limits), names, channel)


def fit_at(cost, vector=(0.0,), active=()):
    """A fit that ended at this cost, in nats."""
    return Fit(np.asarray(vector, dtype=float), active, cost, np.empty(0), np.empty((0, len(active))))


def is_accepted(smaller, larger, proof, costs=(500.0, 450.0), layout=BODY, limits=LIMITS, moved_m=1.0, count=1000):
    """Whether what one set has more than another is accepted, as its proof, the costs and what it moves are."""
    channel = SimpleNamespace(
        settings=DEFAULT_SETTINGS, count=count, split=lambda vector: (vector, None), layout=layout
    )
    chosen = Selector(channel, lambda small, big: moved_m, limits)
    chosen.fits = {frozenset(names): fit_at(cost) for names, cost in zip((smaller, larger), costs, strict=True)}
    chosen.proofs[frozenset(smaller), frozenset(larger)] = proof
    return chosen.acceptable(smaller, larger)


def body_channel(seed=0, drive=DRIVE * 3, **effects):
    """A body channel and its drive; its poses are the model's with these first parameters of motion effects."""
    line = line_of(np.repeat(np.array(drive, dtype=float), 200, axis=0))
    channel = body_on(line, poses_of(line, vector_of(**effects), seed=seed))
    return channel, channel.drive


def errors_of_size(position_m, yaw_rad, squares=None, **more):
    """Errors of predictions of this size, with their squares in stretches of time."""
    return PredictionErrors(position_m, (0.0, 1.0), yaw_rad, (0.0, 1.0), 0.0, {}, squares, **more)


def errors_in_stretches(squares_m2, squares_rad2):
    """Errors of predictions whose squares in stretches of time are these."""
    squares = np.column_stack([squares_m2, squares_rad2]).astype(float)
    return errors_of_size(*np.sqrt(squares.mean(axis=0)), squares)


def of_regression(columns, measured):
    """Minus the log likelihood of a sample, of a regression by Huber's weights whose steps are decompositions."""
    weight = np.ones(measured.size)
    for _ in range(4):
        fitted = np.linalg.lstsq(columns * weight[:, None], measured * weight, rcond=None)[0]
        left = np.abs(measured - columns @ fitted)
        limit = 2.0 * 1.4826 * np.median(left) + 1e-9
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-12)))
    return 0.5 * np.log(np.where(left < limit, left**2, limit * (2.0 * left - limit)).mean() + 1e-10)
