"""The filter as a pure function of its state: initialisation, motion, gated correction, recovery from lock-out.

While the heading is not known, the belief is a Gaussian mixture over the circle, which positions and motion narrow.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from disco_hw.config import Estimation
from disco_hw.estimation.correction import Correction, Measurement, PoseCorrector, PoseReason, Triple, gate_limit
from disco_hw.estimation.odometry import (
    MotionModel,
    OdometryParameters,
    Pose,
    PoseBelief,
    WheelReading,
    arc,
    belief_at,
    covariance_by_parameters,
    motion_model,
    predict,
    rebased,
    wrap,
)
from disco_hw.model.drift import NO_DRIFT, Drift

# Without newer samples the wheels are taken to keep their speeds for so long, then to stand.
MAX_EXTRAPOLATION_S = 0.2
# Standard deviation of motion that was not measured, as a part of its length: a wheel's turn since its last sample, and
# the shape of the path between two samples with a gap in between.
UNMEASURED_PART = 0.25
# Only after so many time-outs does one source take the estimate over from another: the task has stopped by then.
TAKE_OVER_TIMEOUTS = 2.0
# A heading that was known and is less certain than this counts as unknown, and positions alone find it anew.
MAX_HEADING_STD_RAD = 0.3

# Chosen: more begin nearer to the true heading, and take longer for each pose.
COMPONENTS = 16
# Gaussians at two standard deviations from one another add up to a uniform density within 1.5 %.
_COMPONENT_STD_RAD = math.pi / COMPONENTS
_LEAST_WEIGHT = 1e-5


class HeadingSearch(msgspec.Struct, frozen=True, gc=False):
    """Components and their weights, which add up to 1."""

    beliefs: tuple[PoseBelief, ...]
    weights: tuple[float, ...]

    def each(self, change: Callable[[PoseBelief], PoseBelief]) -> HeadingSearch:
        """Return the search with each component changed."""
        return HeadingSearch(tuple(change(belief) for belief in self.beliefs), self.weights)

    def merged(self) -> PoseBelief:
        """Return the Gaussian with the same mean and covariance; the heading's are those on the circle."""
        pairs = list(zip(self.weights, self.beliefs, strict=True))
        x = sum(w * b.x_m for w, b in pairs)
        y = sum(w * b.y_m for w, b in pairs)
        yaw = math.atan2(sum(w * math.sin(b.yaw_rad) for w, b in pairs), sum(w * math.cos(b.yaw_rad) for w, b in pairs))
        # The mean of the sensitivities takes no more from the covariance than the components' own do.
        sensitivity = None
        if all(b.sensitivity is not None for _, b in pairs):
            columns = zip(*(b.sensitivity for _, b in pairs if b.sensitivity is not None), strict=True)
            a, b_, c, d, e, f, g, h, i = (
                sum(w * value for w, value in zip(self.weights, column, strict=True)) for column in columns
            )
            sensitivity = (a, b_, c, d, e, f, g, h, i)
        xx = xy = xt = yy = yt = tt = 0.0
        for w, b in pairs:
            (b_xx, b_xy, b_xt), (_, b_yy, b_yt), (_, _, b_tt) = b.covariance
            dx, dy, dt = b.x_m - x, b.y_m - y, wrap(b.yaw_rad - yaw)
            xx, xy, xt = xx + w * (b_xx + dx * dx), xy + w * (b_xy + dx * dy), xt + w * (b_xt + dx * dt)
            yy, yt, tt = yy + w * (b_yy + dy * dy), yt + w * (b_yt + dy * dt), tt + w * (b_tt + dt * dt)
        if sensitivity is not None:
            by_parameters = covariance_by_parameters(sensitivity)
            xx, xy, xt, yy, yt, tt = (a - b for a, b in zip((xx, xy, xt, yy, yt, tt), by_parameters, strict=True))
        return PoseBelief(x, y, yaw, xx, xy, xt, yy, yt, tt, sensitivity)


def any_heading(measurement: Measurement, model: MotionModel) -> HeadingSearch:
    """Create a search at the sensor's place with all headings equally likely; a measured heading is ignored."""
    tt = _COMPONENT_STD_RAD**2
    beliefs = []
    for k in range(COMPONENTS):
        yaw = wrap(math.tau * k / COMPONENTS)
        ahead_x, ahead_y, by_yaw_x, by_yaw_y = measurement.lever(yaw)
        place = Pose(measurement.pose.x_m - ahead_x, measurement.pose.y_m - ahead_y, yaw)
        belief = belief_at(place, measurement.position_variance, tt, model)
        beliefs.append(
            msgspec.structs.replace(
                belief,
                xx=belief.xx + by_yaw_x * by_yaw_x * tt,
                xy=by_yaw_x * by_yaw_y * tt,
                xt=-by_yaw_x * tt,
                yy=belief.yy + by_yaw_y * by_yaw_y * tt,
                yt=-by_yaw_y * tt,
            )
        )
    return HeadingSearch(tuple(beliefs), (1.0 / COMPONENTS,) * COMPONENTS)


def correct_search(
    search: HeadingSearch, measurement: Measurement, corrector: PoseCorrector
) -> tuple[HeadingSearch, Correction]:
    """Update the search with a measurement; return it with the correction of the component that fits it best."""
    corrections = [corrector.correct(belief, measurement) for belief in search.beliefs]
    logs = [math.log(w) + c.log_density for w, c in zip(search.weights, corrections, strict=True)]
    most = max(logs)
    kept = [(math.exp(log - most), c) for log, c in zip(logs, corrections, strict=True)]
    kept = [(weight, c) for weight, c in kept if weight > _LEAST_WEIGHT]
    total = sum(weight for weight, _ in kept)
    after = HeadingSearch(tuple(c.belief for _, c in kept), tuple(weight / total for weight, _ in kept))
    return after, min(corrections, key=lambda correction: correction.distance2)


Belief = PoseBelief | HeadingSearch


class Evaluation(msgspec.Struct, frozen=True, gc=False):
    """The filter's answer to a pose; numbers as in PoseUpdate, None where there was nothing to compare with."""

    reason: PoseReason
    innovation: Triple | None = None
    innovation_variance: Triple | None = None
    distance2: float | None = None
    test_ratio: float | None = None


class FilterState(msgspec.Struct, frozen=True, gc=False):
    """State of the filter at one instant: everything that the future depends on.

    `belief` is None before there is any, and a search while the heading is not known. `candidate` is the pose that the
    last rejected measurements agree on, `candidate_count` how many in a row do, and `candidate_of` of which sources.
    `pose_t_ns` is the stamp of the last accepted pose, None before the first, and `accepted` those of each source.
    `evaluation` is that of the pose at this very instant, None after wheel motion.
    """

    t_ns: int
    left_rad: float
    right_rad: float
    belief: Belief | None
    candidate: Belief | None
    candidate_count: int
    pose_t_ns: int | None
    reinitialisations: int
    evaluation: Evaluation | None
    candidate_of: frozenset[int] = frozenset()
    accepted: tuple[tuple[int, int], ...] = ()

    @property
    def heading_known(self) -> bool:
        """Whether there is one heading that is certain enough to drive by."""
        return isinstance(self.belief, PoseBelief) and _heading_is_known(self.belief)


def _heading_is_known(belief: PoseBelief) -> bool:
    return belief.covariance[2][2] <= MAX_HEADING_STD_RAD**2


class PoseFilter:
    """Kalman filter on the pose with a gate, as transitions from one immutable state to the next."""

    def __init__(self, settings: Estimation, parameters: OdometryParameters) -> None:
        self.parameters = parameters
        self.drift: Drift = NO_DRIFT
        self._model = motion_model(settings, parameters)
        self._pose_limit = gate_limit(settings.gate_probability)
        self._position_limit = gate_limit(settings.gate_probability, with_heading=False)
        self._found_variance = settings.heading_std_rad**2
        self._lockout_count = settings.gate_lockout_count
        self._take_over_ns = round(TAKE_OVER_TIMEOUTS * settings.pose_timeout_s * 1e9)
        self._pose_required = settings.pose_required
        self._corrector = PoseCorrector()

    def begin(self, wheels: WheelReading) -> FilterState:
        """Return the state at the first wheel sample: no belief, or the origin where no pose is required."""
        origin = belief_at(Pose(0.0, 0.0, 0.0), 1e-6, 1e-6, self._model)
        belief = None if self._pose_required else origin
        return FilterState(wheels.t_ns, wheels.left_rad, wheels.right_rad, belief, None, 0, None, 0, None)

    def adopt(self, state: FilterState) -> FilterState:
        """Return a state of a filter with other parameters, as one of this filter."""
        return msgspec.structs.replace(
            state, belief=self._rebased(state.belief), candidate=self._rebased(state.candidate)
        )

    def move(self, state: FilterState, t_ns: int, left_rad: float, right_rad: float, in_gap: bool) -> FilterState:
        """Follow the wheels to measured angles."""
        rolled_m = 0.0
        if in_gap:
            turned_rad = abs(left_rad - state.left_rad) + abs(right_rad - state.right_rad)
            rolled_m = 0.5 * self.parameters.wheel_radius_m * turned_rad
        return self._moved(state, t_ns, left_rad, right_rad, (UNMEASURED_PART * rolled_m) ** 2, 0.0)

    def extrapolate(self, state: FilterState, wheels: WheelReading, t_ns: int) -> FilterState:
        """Follow the wheels beyond their newest sample; `t_ns` is not before the state."""
        since_s, until_s = (state.t_ns - wheels.t_ns) * 1e-9, (t_ns - wheels.t_ns) * 1e-9
        coasting_s = min(until_s, MAX_EXTRAPOLATION_S)
        left, right = wheels.left_speed_rad_s, wheels.right_speed_rad_s
        radius = self.parameters.wheel_radius_m
        # Squares of the time since the sample, so that stopping on the way adds nothing.
        growth = (UNMEASURED_PART * radius) ** 2 * (until_s * until_s - since_s * since_s)
        return self._moved(
            state,
            t_ns,
            wheels.left_rad + left * coasting_s,
            wheels.right_rad + right * coasting_s,
            0.25 * growth * (abs(left) + abs(right)) ** 2,
            growth * (left * left + right * right) / self.parameters.axial_distance_m**2,
        )

    def fuse(self, state: FilterState, measurement: Measurement) -> FilterState:
        """Judge a pose at the state's instant, and correct the belief by it if it passes.

        The first pose sets the belief; where it has no heading, every heading is followed until motion shows which is
        right. If the wheels were followed from the origin until then and have not led there, it counts as a jump. A
        pose outside the gate is compared with where the rejected poses before it would be now: if `gate_lockout_count`
        in a row agree with one another, and every source that was believed of late is among them, the robot is where
        they say.
        """
        if state.belief is None:
            return self._after(state, measurement, self._fresh(measurement), Evaluation(PoseReason.INITIALISED))
        if state.pose_t_ns is None:
            jumps = self._corrected(state.belief, measurement)[1].distance2 > self._limit(measurement)
            first = self._after(state, measurement, self._fresh(measurement), Evaluation(PoseReason.INITIALISED))
            return msgspec.structs.replace(first, reinitialisations=state.reinitialisations + jumps)
        lacks_heading = isinstance(state.belief, PoseBelief) and not state.heading_known
        if measurement.yaw_variance is None and (lacks_heading or measurement.forgets_heading):
            return self._after(state, measurement, self._fresh(measurement), Evaluation(PoseReason.REINITIALISED))
        belief, correction = self._corrected(state.belief, measurement)
        limit = self._limit(measurement)
        if correction.distance2 <= limit:
            return self._after(state, measurement, belief, _evaluation(PoseReason.ACCEPTED, correction, limit))
        candidate, count, sources = self._candidate(state, measurement)
        if count >= self._lockout_count and not self._contested(state, measurement.t_ns, sources):
            return self._after(state, measurement, candidate, _evaluation(PoseReason.REINITIALISED, correction, limit))
        evaluation = _evaluation(PoseReason.GATED, correction, limit)
        return msgspec.structs.replace(
            state, candidate=candidate, candidate_count=count, candidate_of=sources, evaluation=evaluation
        )

    def _contested(self, state: FilterState, t_ns: int, sources: frozenset[int]) -> bool:
        """Whether another source than these was believed of late."""
        return any(each not in sources and t_ns - at_ns <= self._take_over_ns for each, at_ns in state.accepted)

    def _limit(self, measurement: Measurement) -> float:
        return self._position_limit if measurement.yaw_variance is None else self._pose_limit

    def _fresh(self, measurement: Measurement) -> Belief:
        if measurement.yaw_variance is not None and measurement.yaw_variance <= MAX_HEADING_STD_RAD**2:
            ahead_x, ahead_y, _, _ = measurement.lever(measurement.pose.yaw_rad)
            pose = measurement.pose
            place = Pose(pose.x_m - ahead_x, pose.y_m - ahead_y, pose.yaw_rad)
            return belief_at(place, measurement.position_variance, measurement.yaw_variance, self._model)
        search = any_heading(measurement, self._model)
        if measurement.yaw_variance is None:
            return search
        return self._settled(correct_search(search, measurement, self._corrector)[0])

    def _corrected(self, belief: Belief, measurement: Measurement) -> tuple[Belief, Correction]:
        if isinstance(belief, PoseBelief):
            correction = self._corrector.correct(belief, measurement)
            return correction.belief, correction
        search, best = correct_search(belief, measurement, self._corrector)
        return self._settled(search), best

    def _settled(self, search: HeadingSearch) -> Belief:
        """One belief, once the headings that are left are close enough to one another."""
        merged = search.merged()
        return merged if merged.covariance[2][2] <= self._found_variance else search

    def _candidate(self, state: FilterState, measurement: Measurement) -> tuple[Belief, int, frozenset[int]]:
        if state.candidate is not None:
            belief, correction = self._corrected(state.candidate, measurement)
            if correction.distance2 <= self._limit(measurement):
                return belief, state.candidate_count + 1, state.candidate_of | {measurement.source}
        return self._fresh(measurement), 1, frozenset((measurement.source,))

    def _rebased(self, belief: Belief | None) -> Belief | None:
        if isinstance(belief, HeadingSearch):
            return belief.each(lambda each: rebased(each, self._model))
        return None if belief is None else rebased(belief, self._model)

    def _after(
        self, state: FilterState, measurement: Measurement, belief: Belief, evaluation: Evaluation
    ) -> FilterState:
        others = (each for each in state.accepted if each[0] != measurement.source)
        return msgspec.structs.replace(
            state,
            belief=belief,
            candidate=None,
            candidate_count=0,
            candidate_of=frozenset(),
            pose_t_ns=measurement.t_ns,
            reinitialisations=state.reinitialisations + (evaluation.reason is PoseReason.REINITIALISED),
            evaluation=evaluation,
            accepted=(*others, (measurement.source, measurement.t_ns)),
        )

    def _moved(
        self,
        state: FilterState,
        t_ns: int,
        left_rad: float,
        right_rad: float,
        position_variance: float,
        yaw_variance: float,
    ) -> FilterState:
        belief, candidate = state.belief, state.candidate
        left_turn, right_turn = left_rad - state.left_rad, right_rad - state.right_rad
        if left_turn or right_turn or position_variance or yaw_variance:
            drift, since_s = self.drift, (t_ns - state.t_ns) * 1e-9
            motion = arc(self.parameters, left_turn, right_turn)
            carried_s = 0.0
            if since_s > 0.0:
                carried_s = drift.part_at(left_turn / since_s, right_turn / since_s) * since_s

            def follow(before: PoseBelief) -> PoseBelief:
                if drift is NO_DRIFT:
                    return predict(before, self._model, motion, position_variance, yaw_variance)
                forward, left = drift.in_body(carried_s, before.yaw_rad + 0.5 * motion.turn_rad)
                carried = msgspec.structs.replace(
                    motion, forward_m=motion.forward_m + forward, left_m=motion.left_m + left
                )
                return predict(before, self._model, carried, position_variance, yaw_variance)

            belief = belief.each(follow) if isinstance(belief, HeadingSearch) else belief and follow(belief)
            candidate = (
                candidate.each(follow) if isinstance(candidate, HeadingSearch) else candidate and follow(candidate)
            )
        # Not by `replace`, as it is of each wheel sample: a tick would take a tenth longer.
        return FilterState(
            t_ns, left_rad, right_rad, belief, candidate, state.candidate_count, state.pose_t_ns,
            state.reinitialisations, None, state.candidate_of, state.accepted,
        )  # fmt: skip


def _evaluation(reason: PoseReason, correction: Correction, limit: float) -> Evaluation:
    return Evaluation(
        reason,
        correction.innovation,
        correction.innovation_variance,
        correction.distance2,
        correction.distance2 / limit,
    )
