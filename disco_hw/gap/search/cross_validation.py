"""The gap on data not used for fitting: nominal, refitted, amended and what the noise alone makes, by horizon.

A log without poses is judged by its wheels, from commands alone (`wheel_table`): their turns are given as the way and
the heading that they make on the robot's geometry, in the units of the whole gap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from disco_hw.gap.data import BASE_COUNT, ENCODER_COLUMNS
from disco_hw.gap.data.free_runs import displacement, read_angles, rotated, run_body, starts_of
from disco_hw.gap.noise import SensorNoise
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel, total_perturbation
from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.channel_search import responding
from disco_hw.gap.search.least_squares import Fit, by_block, inverse, known
from disco_hw.gap.search.richest_model import DELAY_NAMES
from disco_hw.gap.settings import GRID_STEP_S, GapSettings, PredictionSettings

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PredictionErrors:
    """Root mean square at one horizon with 95 % bootstrap intervals over blocks of time.

    `squares` (B, 2): sums of squares of position and of yaw by block, for a comparison block by block;
    `regime_squares`: sums of squares by what the robot was doing.
    """

    position_m: float
    position_ci: tuple[float, float]
    yaw_rad: float
    yaw_ci: tuple[float, float]
    wheel_rad_s: float
    by_regime_m: dict[str, float]
    squares: Array | None = field(default=None, repr=False, compare=False)
    regime_squares: Mapping[str, tuple[float, float]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def by_stretch(self) -> Array:
        """Sums of squares of position and of yaw by stretch of time (B, 2); all of it as one where that is not kept."""
        if self.squares is None:
            return np.array([[self.position_m**2, self.yaw_rad**2]])
        return self.squares


def worse_by(before: PredictionErrors, after: PredictionErrors) -> float:
    """Ratio of errors after to before, the larger one of position and heading."""
    return max(after.position_m / before.position_m, after.yaw_rad / before.yaw_rad)


@dataclass(frozen=True)
class Starts:
    """Start of each of K predictions: node (K,), smoothed pose there (K, 3), pose measured at its end (K, 3)."""

    node: Index
    pose: Array
    end: Array
    block: Index
    regime: tuple[str, ...]

    @property
    def way(self) -> Array:
        """Measured displacements (K, 2) in the frame of the start: forward, left."""
        return rotated(self.end[:, :2] - self.pose[:, :2], -self.pose[:, 2])


@dataclass(frozen=True)
class Chain:
    """Chain of both channels, a parameter vector each, from commands to poses; without `wheels` from measured wheels.

    The perturbations are what unnamed terms add at the nodes.
    """

    body: Array
    wheels: Array | None
    body_perturbation: Array | None = None
    wheels_perturbation: Array | None = None


def smoothed_poses(channel: BodyChannel, p: Array) -> tuple[Array, Array]:
    """Return the poses at all nodes, smoothed along the wheels' path, and those from the nearest sample alone.

    Both are (M, 3) in m, m and rad, and NaN where no sample is near. Smoothing averages over `pose_reach_s` on
    either side.
    """
    drive, samples = channel.drive, channel.samples
    reach_s = channel.settings.prediction.pose_reach_s
    track = channel.track(p)
    at = np.empty((samples.t_s.size, 3))
    read_angles(track, samples.node, samples.fraction, at)
    good = channel.use
    t, at, measured = samples.t_s[good], at[good], channel.measured[good]
    run_of = np.cumsum(drive.first)
    run_sample = run_of[samples.node[good]]
    turned = measured[:, 2] - at[:, 2]
    centre = np.minimum(np.searchsorted(t, drive.t_s), t.size - 1)
    reach = max(int(reach_s / max(float(np.median(np.diff(t))), 1e-3)), 1)
    near = np.arange(-reach, reach + 1)
    places = centre[:, None] + near[None, :]
    members = np.clip(places, 0, t.size - 1)
    valid = (np.abs(t[members] - drive.t_s[:, None]) <= reach_s) & (run_sample[members] == run_of[:, None])
    # Beyond either end the outermost sample stands in, and counts once.
    valid &= members == places
    weight = valid / np.maximum(valid.sum(axis=1, keepdims=True), 1)
    angle = (turned[members] * weight).sum(axis=1)
    cosine, sine = np.cos(angle), np.sin(angle)

    def carried(member: Index, share: Array, turn_c: Array, turn_s: Array) -> Array:
        dx, dy = track[:, None, 0] - at[member, 0], track[:, None, 1] - at[member, 1]
        x = measured[member, 0] + turn_c[:, None] * dx - turn_s[:, None] * dy
        y = measured[member, 1] + turn_s[:, None] * dx + turn_c[:, None] * dy
        return np.column_stack([(x * share).sum(axis=1), (y * share).sum(axis=1)])

    smooth = np.column_stack([carried(members, weight, cosine, sine), angle + track[:, 2]])
    before = np.maximum(centre - 1, 0)
    nearest = np.where(np.abs(t[before] - drive.t_s) < np.abs(t[centre] - drive.t_s), before, centre)[:, None]
    alone = np.column_stack(
        [carried(nearest, np.ones_like(nearest, dtype=float), cosine, sine), turned[nearest[:, 0]] + track[:, 2]]
    )
    far = ~valid.any(axis=1) | (np.abs(t[nearest[:, 0]] - drive.t_s) > 0.1)
    smooth[far], alone[far] = np.nan, np.nan
    return smooth, alone


def find_starts(channel: BodyChannel, poses: tuple[Array, Array], ahead_s: float) -> Starts:
    """Return the starts of predictions, `start_every_s` apart, where poses and commands are known."""
    drive = channel.drive
    known = np.isfinite(drive.command_rad_s[:, 0]) if drive.has_commands else np.ones(drive.t_s.size, dtype=bool)
    smooth, alone = poses
    node = starts_of(drive.first, known, ahead_s, drive.settings.grid)
    ahead = round(ahead_s / GRID_STEP_S)
    node = node[np.isfinite(smooth[node, 0]) & np.isfinite(alone[node + ahead, 0])]
    block = drive.stretch(drive.t_s[node])
    return Starts(node, smooth[node], alone[node + ahead], block, tuple(regimes_driven(channel, node, ahead)))


def scored_horizon_s(channel: BodyChannel, poses: tuple[Array, Array]) -> float:
    """Return the horizon at which stages are compared (s): that of the report, or the longest that runs reach."""
    settings = channel.settings.prediction
    shorter = sorted((each for each in settings.horizons_s if each <= settings.reported_horizon_s), reverse=True)
    reached = (ahead_s for ahead_s in shorter if find_starts(channel, poses, ahead_s).node.size)
    return next(reached, settings.reported_horizon_s)


def regimes_driven(channel: BodyChannel | WheelChannel, node: Index, ahead: int) -> list[str]:
    """Return the regime of the robot's motion from each node to `ahead` nodes later."""
    if not node.size:
        return []
    drive, p, settings = channel.drive, channel.geometry, channel.settings.prediction
    v = 0.5 * p[0] * drive.speed_rad_s.sum(axis=1)
    omega = p[0] / p[1] * (drive.speed_rad_s[:, 1] - drive.speed_rad_s[:, 0])
    size = np.concatenate([[0.0], np.cumsum(np.abs(v))])
    turn = np.concatenate([[0.0], np.cumsum(np.abs(omega))])
    signed = np.concatenate([[0.0], np.cumsum(v)])
    mean, mean_turn = (size[node + ahead] - size[node]) / ahead, (turn[node + ahead] - turn[node]) / ahead
    changed = np.ptp(sliding_window_view(v, ahead)[node], axis=1)
    regimes = {
        "standstill": (mean < settings.standing_m_s) & (mean_turn < settings.spinning_rad_s),
        "turning on the spot": (mean < settings.standing_m_s * 3) & (mean_turn > settings.spinning_rad_s),
        "speeding up and braking": changed > settings.speeding_m_s2 * ahead * GRID_STEP_S * 0.5,
        "curves": mean_turn > settings.turning_rad_s,
        "straight back": signed[node + ahead] < signed[node],
    }
    return [str(name) for name in np.select(list(regimes.values()), list(regimes), "straight ahead")]


def chain_wheels(body: BodyChannel, wheels: WheelChannel | None, chain: Chain) -> tuple[Array, Array]:
    """Wheel angles and speeds (M, 2) of a free run from commands; without wheels the measured ones."""
    drive = body.drive
    if wheels is None or chain.wheels is None:
        return drive.angle_rad, drive.speed_rad_s
    q = chain.wheels.copy()
    q[[wheels.layout.place[column] for column in ENCODER_COLUMNS]] = 0.0
    # Limits of turning are of the robot's motion: with other wheels they are reached at other wheel speeds.
    angle = replace(wheels, geometry=chain.body[:BASE_COUNT]).angles(q, chain.wheels_perturbation)
    speed = np.gradient(angle, GRID_STEP_S, axis=0)
    speed[drive.first] = 0.0
    return angle, speed


def chain_track(
    body: BodyChannel, wheels: WheelChannel | None, chain: Chain, turned: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """Path (M, 3) of a free run and its wheel speeds (M, 2); `turned`: what `chain_wheels` gives, if that is known."""
    drive = body.drive
    p = chain.body.copy()
    angle, speed = chain_wheels(body, wheels, chain) if turned is None else turned
    if wheels is not None and chain.wheels is not None:
        p[[body.layout.place[column] for column in ENCODER_COLUMNS]] = 0.0
    perturbation = total_perturbation(drive, 3, drive.known_motion, chain.body_perturbation)
    return run_body(p, angle, speed, perturbation, drive.first, drive.t_s), speed


def prediction_error(body: BodyChannel, starts: Starts, p: Array, track: Array, ahead_s: float) -> Array:
    """Measured minus predicted pose (K, 3) at the end, in the frame of the start: forward, left, yaw."""
    drive = body.drive
    moved = displacement(
        p, drive.first, track, body.carried(p), starts.node, starts.pose[:, 2], ahead_s, drive.poses_moved_s
    )
    return displacement_error(starts, moved)


def displacement_error(starts: Starts, moved: Array) -> Array:
    """Measured minus predicted displacement (K, 3) of any predictor, in the frame of the start: forward, left, yaw."""
    yaw = starts.end[:, 2] - starts.pose[:, 2] - moved[:, 2]
    yaw = np.mod(yaw + np.pi, 2.0 * np.pi) - np.pi
    return np.column_stack([starts.way - moved[:, :2], yaw])


def fold_of(channel: BodyChannel | WheelChannel) -> Index:
    """Return the fold (n,) of each residual of a channel."""
    middle_s = (channel.block.astype(np.float64) + 0.5) * channel.settings.grid.block_s
    return channel.drive.stretch(middle_s) % channel.drive.folds.count


def fold_vectors(found: Fit, fold: Index, count: int, neutral: Array, settings: GapSettings) -> dict[int, Array]:
    """For each of `count` folds (n,) of a fit's residuals the vector fitted on the data of the others, to second order.

    What the others' data say next to nothing about is as in `neutral`: a limit that was reached, or a patch of the
    floor that was crossed, in one fold only is not known in the other, unless its few data fix the value by themselves.
    """
    present = np.unique(fold)
    if not found.active or present.size < 2:
        return dict.fromkeys(range(count), found.vector)
    normal, gradient = by_block(found, fold)
    out = dict.fromkeys(range(count), found.vector)
    active = np.array(found.active)
    # What was expected before any log was looked at is expected of each fold.
    precision = np.zeros(active.size) if found.precision is None else found.precision
    pull = precision * (found.vector[active] - neutral[active])
    for place, left_out in enumerate(present.tolist()):
        vector, others = found.vector.copy(), np.delete(normal, place, axis=0).sum(axis=0)
        pulled = np.delete(gradient, place, axis=0).sum(axis=0) + pull
        determined = known(others, normal.sum(axis=0), settings.fit)
        determined |= np.diag(others) * vector[active] ** 2 > settings.prediction.fixed_sigmas**2
        here = (others + np.diag(precision))[np.ix_(determined, determined)]
        vector[active[determined]] -= inverse(here) @ pulled[determined]
        vector[active[~determined]] = neutral[active[~determined]]
        out[left_out] = vector
    return out


def errors_of(
    body: BodyChannel, wheels: WheelChannel | None, chains: dict[int, Chain], ahead_s: float, poses: tuple[Array, Array]
) -> PredictionErrors:
    """Errors at one horizon, each start predicted by the chain of its fold."""
    starts = find_starts(body, poses, ahead_s)
    error = np.zeros((starts.node.size, 3))
    speed_error = np.zeros(starts.node.size)
    ahead = round(ahead_s / GRID_STEP_S)
    for left_out, chain in chains.items():
        inside = starts.block % len(chains) == left_out
        track, speed = chain_track(body, wheels, chain)
        error[inside] = prediction_error(body, starts, chain.body, track, ahead_s)[inside]
        there = starts.node[inside] + ahead
        speed_error[inside] = (body.drive.speed_rad_s[there] - speed[there]).mean(axis=1)
    return summarise(error, speed_error, starts, body.settings.prediction)


def summarise(error: Array, speed_error: Array, starts: Starts, settings: PredictionSettings) -> PredictionErrors:
    """Root mean squares, their bootstrap intervals over blocks, and position by regime."""
    position, yaw = error[:, 0] ** 2 + error[:, 1] ** 2, error[:, 2] ** 2
    if not position.size:
        nan = float("nan")
        return PredictionErrors(nan, (nan, nan), nan, (nan, nan), nan, {})
    regimes = np.array(starts.regime)
    label = np.unique(starts.block, return_inverse=True)[1]
    squares = np.column_stack([np.bincount(label, position), np.bincount(label, yaw)]).astype(np.float64)
    inside = {str(name): regimes == name for name in np.unique(regimes)}
    return PredictionErrors(
        float(np.sqrt(position.mean())),
        _interval(position, starts.block, settings.resamples),
        float(np.sqrt(yaw.mean())),
        _interval(yaw, starts.block, settings.resamples),
        float(np.sqrt((speed_error**2).mean())),
        {name: float(np.sqrt(position[of].mean())) for name, of in inside.items()},
        squares,
        {name: (float(position[of].sum()), float(yaw[of].sum())) for name, of in inside.items()},
    )


def _interval(squares: Array, block: Index, resamples: int) -> tuple[float, float]:
    label = np.unique(block, return_inverse=True)[1]
    sums, counts = np.bincount(label, squares), np.bincount(label)
    draws = np.random.default_rng(0).integers(0, sums.size, (resamples, sums.size))
    means = np.sqrt(sums[draws].sum(axis=1) / counts[draws].sum(axis=1))
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def floor_errors(body: BodyChannel, noise: SensorNoise, ahead_s: float, poses: tuple[Array, Array]) -> PredictionErrors:
    """Return the errors of an exactly right model at a horizon, from the sensors' noise alone."""
    starts = find_starts(body, poses, ahead_s)
    settings = body.settings.prediction
    period_s = max(float(np.median(np.diff(body.samples.t_s))), 1e-3)
    # The start is a mean over all poses within reach, the end a single one.
    averaged = max(2.0 * settings.pose_reach_s / period_s, 1.0)
    size = np.array([noise.position_m, noise.position_m, noise.yaw_rad])
    squares = np.tile(size**2 * (1.0 + 1.0 / averaged), (starts.node.size, 1))
    # What the heading errs by at the start moves the end aside.
    squares[:, :2] += starts.way[:, ::-1] ** 2 * noise.yaw_rad**2 / averaged
    return summarise(np.sqrt(squares), np.full(starts.node.size, noise.wheel_rad_s), starts, settings)


Angles = dict[int, Array]


def only_timed(found: ChannelResult) -> ChannelResult:
    """Return the wheels with only a delay and a lag of what was found: what a careful engineer fits by hand."""
    plain = found.plain or found.selector
    names = tuple(dict.fromkeys((*plain.given, *DELAY_NAMES)))
    selector = replace(plain, fits=dict(plain.fits), proofs={})
    selector.fits.pop(frozenset(names), None)
    responding(selector, names)
    return replace(found, selector=selector, names=names, unnamed=(), plain=None)


def wheel_table(analysis: GapAnalysis) -> dict[str, dict[float, PredictionErrors]]:
    """Errors by stage and horizon of the way (m) and heading (rad) that wheels make; empty if they were not judged.

    Each stretch is predicted by what was fitted on the others, as in the gap. `nominal`: the model as given; `timed`: a
    command delay and a motor lag; `amended`: all that was found.
    """
    found = analysis.wheels
    if found is None:
        return {}
    channel = found.channel
    assert isinstance(channel, WheelChannel)
    nominal = channel.angles(analysis.nominal_wheels)
    tracks: dict[str, Angles] = {
        "nominal": dict.fromkeys(range(channel.drive.folds.count), nominal),
        "timed": _by_fold(only_timed(found)),
        "amended": _by_fold(found),
    }
    horizons = channel.settings.prediction.horizons_s
    return {stage: {ahead_s: _errors(channel, of, ahead_s) for ahead_s in horizons} for stage, of in tracks.items()}


def _by_fold(found: ChannelResult) -> Angles:
    """Angles (M, 2) of a free run for each fold, fitted on the data of the others."""
    channel, selector = found.channel, found.selector
    assert isinstance(channel, WheelChannel)
    folds = channel.drive.folds.count
    vectors = fold_vectors(found.reported, fold_of(channel), folds, selector.channel.neutral, channel.settings)
    return {fold: channel.angles(*selector.channel.split(vector)) for fold, vector in vectors.items()}


def _errors(channel: WheelChannel, of: Angles, ahead_s: float) -> PredictionErrors:
    drive, settings = channel.drive, channel.settings
    node = starts_of(drive.first, np.isfinite(drive.command_rad_s[:, 0]), ahead_s, settings.grid)
    ahead = round(ahead_s / GRID_STEP_S)
    block = drive.stretch(drive.t_s[node])
    turned, speed = np.zeros((node.size, 2)), np.zeros(node.size)
    for fold, angle in of.items():
        inside = block % len(of) == fold
        off = drive.angle_rad - angle
        turned[inside] = (off[node + ahead] - off[node])[inside]
        faster = drive.speed_rad_s[node + ahead] - np.gradient(angle, GRID_STEP_S, axis=0)[node + ahead]
        speed[inside] = faster.mean(axis=1)[inside]
    radius, axial = float(channel.geometry[0]), float(channel.geometry[1])
    way, heading = 0.5 * radius * turned.sum(axis=1), radius / axial * (turned[:, 1] - turned[:, 0])
    poses = np.zeros((node.size, 3))
    starts = Starts(node, poses, poses, block, tuple(regimes_driven(channel, node, ahead)))
    return summarise(np.column_stack([way, np.zeros(node.size), heading]), speed, starts, settings.prediction)
