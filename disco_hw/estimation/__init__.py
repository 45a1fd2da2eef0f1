"""Fusion of wheel odometry and measured pose: what the pipeline feeds and asks.

A pose that comes late is put in at the time when it was true, and what followed is run again (`RewindBuffer`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import msgspec

from disco_hw.config import Estimation
from disco_hw.estimation.correction import Measurement, PoseReason, PoseUpdate, screen
from disco_hw.estimation.filter import Evaluation, FilterState, HeadingSearch, PoseFilter
from disco_hw.estimation.odometry import (
    FUTURE_TOLERANCE_NS,
    MAX_POSITION_VARIANCE,
    MAX_YAW_VARIANCE,
    Matrix3,
    OdometryParameters,
    Pose,
    WheelReading,
    WheelReason,
    WheelTracker,
)
from disco_hw.estimation.pose_sources import MAX_POSE_RATE_HZ, PoseSources
from disco_hw.model.drift import Drift
from drivers.types import PoseSample, WheelSample

# Chosen: two poses in a row that are missing count as a gap; a single late one does not.
GAP_INTERVALS = 3.0
# Chosen: smaller averages more jitter out, larger follows a change of the sensor's rate sooner.
INTERVAL_WEIGHT = 0.1
_UNKNOWN: Matrix3 = ((MAX_POSITION_VARIANCE, 0.0, 0.0), (0.0, MAX_POSITION_VARIANCE, 0.0), (0.0, 0.0, MAX_YAW_VARIANCE))


class PoseEstimate(msgspec.Struct, frozen=True, gc=False):
    """Estimated pose of the tracked body point at `t_ns` in the world frame, with its uncertainty.

    World frame; `covariance` of (x, y, yaw) is 3x3, rows of floats, m and rad, symmetric and positive definite.
    `speed_m_s` is forward, of the centre of rotation; the tracked point also moves sideways by -yaw_rate * x_icr.
    Ages are those of the newest wheel sample and the newest accepted pose, None before the first. `pose_ok`: a pose was
    accepted within the timeout, the heading is known, and no two sources contradict each other; without the first the
    estimate is prediction only, without the second its yaw says nothing (`heading_known` is False, the position holds).
    `wheels_ok`: as for wheel samples.
    Before `initialised`, pose and covariance say nothing (zeros, largest variances). `reinitialisations` counts how
    often the estimate has jumped to where agreeing poses say; a change means that a path through it is no motion.
    """

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    covariance: Matrix3
    speed_m_s: float
    yaw_rate_rad_s: float
    left_speed_rad_s: float
    right_speed_rad_s: float
    wheel_age_s: float | None
    pose_age_s: float | None
    initialised: bool
    wheels_ok: bool
    pose_ok: bool
    reinitialisations: int
    heading_known: bool

    @property
    def pose(self) -> Pose:
        """Mean of the estimated pose: x, y (m), yaw (rad)."""
        return Pose(self.x_m, self.y_m, self.yaw_rad)

    @property
    def ok(self) -> bool:
        """Whether the estimate rests on fresh wheel samples and fresh poses."""
        return self.initialised and self.wheels_ok and self.pose_ok


@dataclass(frozen=True, slots=True)
class FusionStats:
    """Counters since the start; each sample is in exactly one of `wheels_...` and `poses_...`, as judged on arrival.

    The last four are in addition: samples taken although something about them was mended, and times without a pose for
    more than three usual intervals between them.
    """

    wheels_accepted: int = 0
    wheels_not_finite: int = 0
    wheels_out_of_range: int = 0
    wheels_future: int = 0
    wheels_out_of_order: int = 0
    poses_accepted: int = 0
    poses_initialised: int = 0
    poses_reinitialised: int = 0
    poses_gated: int = 0
    poses_not_finite: int = 0
    poses_out_of_range: int = 0
    poses_future: int = 0
    poses_too_old: int = 0
    poses_duplicate: int = 0
    poses_no_odometry: int = 0
    poses_overflow: int = 0
    wheel_gaps: int = 0
    wheel_restarts: int = 0
    pose_std_floored: int = 0
    pose_gaps: int = 0


class PoseFusion:
    """Estimates the pose from wheel angles and measured poses, each taken at its own time stamp.

    No clock: time comes in with samples and queries, and the same calls give the same results bit for bit. Nothing that
    a sample holds raises; what is refused is counted. Cost of a call: see RewindBuffer.
    """

    def __init__(
        self,
        settings: Estimation,
        parameters: OdometryParameters,
        wheel_timeout_s: float,
        sources: Sequence[str] = ("poses",),
    ) -> None:
        self._settings = settings
        self.sources = PoseSources(sources, settings.pose_timeout_s, settings.history_s)
        self._filter = PoseFilter(settings, parameters)
        self._history_s = settings.history_s
        self._pose_timeout_s = settings.pose_timeout_s
        self._wheel_timeout_s = wheel_timeout_s
        self._buffer: RewindBuffer | None = None
        self._tracker = WheelTracker()
        self._forgets_heading = False
        self._pose_came_ns: int | None = None
        self._pose_interval_ns = 0.0
        self._counts = {field.name: 0 for field in fields(FusionStats)}

    @property
    def stats(self) -> FusionStats:
        """A snapshot of the counters."""
        return FusionStats(**self._counts)

    def set_parameters(self, parameters: OdometryParameters) -> None:
        """Follow the wheels with another geometry from now on; the present estimate and its uncertainty stay."""
        drift = self._filter.drift
        self._filter = PoseFilter(self._settings, parameters)
        self._filter.drift = drift
        if self._buffer is not None:
            self._buffer.set_filter(self._filter)

    @property
    def parameters(self) -> OdometryParameters:
        """The geometry in force."""
        return self._filter.parameters

    @property
    def wheel_difference_rad(self) -> float:
        """Angle (rad) by which the right wheel has turned more than the left; zero before the first sample."""
        if self._buffer is None:
            return 0.0
        return self._buffer.newest_wheels.right_rad - self._buffer.newest_wheels.left_rad

    def reset_heading(self) -> None:
        """Take the heading for unknown from the next position without one on: what it rests on was no measurement."""
        self._forgets_heading = True

    def set_drift(self, drift: Drift) -> None:
        """Take the ground to carry the moving robot so from now on."""
        self._filter.drift = drift

    def add_wheels(self, sample: WheelSample) -> None:
        """Take in a wheel sample; it must be newer than all before, otherwise it is dropped and counted."""
        reading = self._tracker.add_sample(sample)
        if isinstance(reading, WheelReason):
            self._counts[f"wheels_{reading.value}"] += 1
            return
        self._counts["wheels_accepted"] += 1
        self._counts["wheel_gaps"] += reading.after_gap
        self._counts["wheel_restarts"] += reading.restarted
        if self._buffer is None:
            self._buffer = RewindBuffer(self._filter, reading, self._history_s, len(self.sources.all))
        else:
            self._buffer.add_wheels(reading)

    def add_pose(self, sample: PoseSample, now_ns: int) -> PoseUpdate:
        """Take in a measured pose at its own stamp, and say what it did as far as is known by now."""
        self._note_arrival(now_ns)
        outcome = self._check(sample, now_ns)
        if isinstance(outcome, PoseReason):
            outcome = Evaluation(outcome)
        self._counts[f"poses_{outcome.reason.value}"] += 1
        update = PoseUpdate(sample.t_ns, (now_ns - sample.t_ns) / 1e9, *msgspec.structs.astuple(outcome))
        self.sources.add_sample(sample, update, now_ns)
        return update

    def estimate(self, now_ns: int) -> PoseEstimate:
        """Estimate the pose at `now_ns`.

        Beyond the newest sample the wheels are taken to keep their speeds for 0.2 s and then to stand; the uncertainty
        goes on growing. A time before the newest sample gets the pose of the newest sample.
        """
        if self._buffer is None:
            return PoseEstimate(
                now_ns, 0.0, 0.0, 0.0, _UNKNOWN, 0.0, 0.0, 0.0, 0.0, None, None, False, False, False, 0, False
            )
        wheels, state = self._buffer.newest_wheels, self._buffer.head()
        if now_ns > state.t_ns:
            state = self._filter.extrapolate(state, wheels, now_ns)
        x_m, y_m, yaw_rad, covariance = 0.0, 0.0, 0.0, _UNKNOWN
        belief = state.belief.merged() if isinstance(state.belief, HeadingSearch) else state.belief
        if belief is not None:
            x_m, y_m, yaw_rad, covariance = belief.x_m, belief.y_m, belief.yaw_rad, belief.covariance
        parameters = self._filter.parameters
        left, right = wheels.left_speed_rad_s, wheels.right_speed_rad_s
        wheel_age_s = _age_s(now_ns, wheels.t_ns)
        pose_age_s = None if state.pose_t_ns is None else _age_s(now_ns, state.pose_t_ns)
        return PoseEstimate(
            t_ns=now_ns,
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            covariance=covariance,
            speed_m_s=0.5 * parameters.wheel_radius_m * (left + right),
            yaw_rate_rad_s=parameters.wheel_radius_m * (right - left) / parameters.axial_distance_m,
            left_speed_rad_s=left,
            right_speed_rad_s=right,
            wheel_age_s=wheel_age_s,
            pose_age_s=pose_age_s,
            initialised=state.belief is not None,
            wheels_ok=wheel_age_s <= self._wheel_timeout_s,
            pose_ok=pose_age_s is not None
            and pose_age_s <= self._pose_timeout_s
            and state.heading_known
            and not self.sources.contradiction,
            reinitialisations=state.reinitialisations,
            heading_known=state.heading_known,
        )

    def _note_arrival(self, now_ns: int) -> None:
        last_ns, self._pose_came_ns = self._pose_came_ns, now_ns
        if last_ns is None or now_ns <= last_ns:
            return
        if 0.0 < GAP_INTERVALS * self._pose_interval_ns < now_ns - last_ns:
            self._counts["pose_gaps"] += 1
            return
        weight = 1.0 if self._pose_interval_ns == 0.0 else INTERVAL_WEIGHT
        self._pose_interval_ns += weight * (now_ns - last_ns - self._pose_interval_ns)

    def _check(self, sample: PoseSample, now_ns: int) -> Evaluation | PoseReason:
        measurement = screen(sample)
        if isinstance(measurement, PoseReason):
            return measurement
        if sample.t_ns > now_ns + FUTURE_TOLERANCE_NS:
            return PoseReason.FUTURE
        if self._buffer is None:
            return PoseReason.NO_ODOMETRY
        if self._forgets_heading and measurement.yaw_variance is None:
            measurement = msgspec.structs.replace(measurement, forgets_heading=True)
            self._forgets_heading = False
        outcome = self._buffer.add_pose(measurement)
        self._counts["pose_std_floored"] += measurement.floored and isinstance(outcome, Evaluation)
        return outcome


def _age_s(now_ns: int, t_ns: int) -> float:
    return max(0, now_ns - t_ns) / 1e9


Event = WheelReading | Measurement

# The buffer is sized for this rate; beyond it, it covers less time.
MAX_WHEEL_RATE_HZ = 200.0
_LEAST_POSE_INTERVAL_NS = round(1e9 / MAX_POSE_RATE_HZ)


class RewindBuffer:
    """Wheel readings and poses of the last `history_s` in the order of their stamps, and the state after each.

    The states are a function of the events alone, so that a pose gives the same result, bit for bit, however late or in
    whatever order it comes in, while its stamp is inside the buffer. A pose between two wheel readings sees the wheels
    at the angles interpolated linearly in time; one beyond the newest reading is judged on extrapolated angles, and
    again when the next reading is there.
    A source may have as many poses as time passes by its stamps, at `MAX_POSE_RATE_HZ`, and those of `history_s` at
    once: up to that rate none is left out, whatever their order and jitter, and beyond it they are thinned evenly.
    One call runs each event in the buffer once at worst. There are never more than `capacity` events;
    `newest_wheels` is the newest wheel reading.
    """

    def __init__(self, pose_filter: PoseFilter, first: WheelReading, history_s: float, sources: int = 1) -> None:
        self._filter = pose_filter
        self._history_ns = round(history_s * 1e9)
        self.capacity = math.ceil(sources * history_s * MAX_POSE_RATE_HZ) + math.ceil(history_s * MAX_WHEEL_RATE_HZ) + 1
        self._poses = 0
        # By source: its newest stamp, and the time (ns) that it may still fill with poses.
        self._credits: dict[int, tuple[int, int]] = {}
        self._largest_credit_ns = math.ceil(history_s * MAX_POSE_RATE_HZ) * _LEAST_POSE_INTERVAL_NS
        self._events: list[Event] = [first]
        # States after the first len(_states) events; never empty. The rest are outdated and run on demand.
        self._states: list[FilterState] = [pose_filter.begin(first)]
        # The first so many of them are of a filter before the present one, which adopts those that it goes on from.
        self._before = 0
        self.newest_wheels = first

    def __len__(self) -> int:
        return len(self._events)

    def set_filter(self, pose_filter: PoseFilter) -> None:
        """Go on with a filter of other parameters: what is run again from now on, late poses included, is run by it."""
        self._filter = pose_filter
        self._before = len(self._states)

    def add_wheels(self, reading: WheelReading) -> None:
        """Append a reading newer than all before."""
        index = self._index_after(reading.t_ns, include_equal=False)
        self._events.insert(index, reading)
        while isinstance(self._events[index - 1], Measurement):
            index -= 1
        self._outdate(index)
        self.newest_wheels = reading
        self._trim()

    def add_pose(self, measurement: Measurement) -> Evaluation | PoseReason:
        """Insert a pose at its stamp; what the filter made of it, or why it cannot be inserted."""
        if measurement.t_ns < self._events[0].t_ns:
            return PoseReason.TOO_OLD
        if measurement.t_ns > self.newest_wheels.t_ns + self._history_ns:
            return PoseReason.NO_ODOMETRY
        index = self._index_after(measurement.t_ns, include_equal=True)
        # Of several sources at one instant the lowest is first, in whatever order they come.
        while (before := self._events[index - 1]).t_ns == measurement.t_ns and isinstance(before, Measurement):
            if before.source == measurement.source:
                return PoseReason.DUPLICATE
            if before.source < measurement.source:
                break
            index -= 1
        newest_ns, credit_ns = self._credits.get(measurement.source, (measurement.t_ns, self._largest_credit_ns))
        credit_ns = min(credit_ns + max(0, measurement.t_ns - newest_ns), self._largest_credit_ns)
        # One event is left to the newest wheel reading, however many poses come after it.
        if credit_ns < _LEAST_POSE_INTERVAL_NS or self._poses >= self.capacity - 1:
            return PoseReason.OVERFLOW
        self._credits[measurement.source] = max(newest_ns, measurement.t_ns), credit_ns - _LEAST_POSE_INTERVAL_NS
        self._events.insert(index, measurement)
        self._poses += 1
        self._outdate(index)
        evaluation = self._run(index).evaluation
        self._trim()
        if evaluation is None:
            raise AssertionError("the state at a pose holds its judgement")
        return evaluation

    def head(self) -> FilterState:
        """Return the state after the last event."""
        return self._run(len(self._events) - 1)

    def _index_after(self, t_ns: int, include_equal: bool) -> int:
        """Return the index of an event of this time, searched from the end: nearly all are among the newest."""
        index = len(self._events)
        while index > 0 and (self._events[index - 1].t_ns > t_ns - (not include_equal)):
            index -= 1
        return index

    def _outdate(self, index: int) -> None:
        del self._states[index:]
        self._before = min(self._before, index)

    def _run(self, index: int) -> FilterState:
        while len(self._states) <= index:
            self._states.append(self._step(len(self._states)))
        return self._state(index)

    def _state(self, index: int) -> FilterState:
        state = self._states[index]
        return self._filter.adopt(state) if index < self._before else state

    def _step(self, index: int) -> FilterState:
        state, event = self._state(index - 1), self._events[index]
        if isinstance(event, WheelReading):
            return self._filter.move(state, event.t_ns, event.left_rad, event.right_rad, event.after_gap)
        if event.t_ns >= self.newest_wheels.t_ns:
            state = self._filter.extrapolate(state, self.newest_wheels, event.t_ns)
        else:
            ahead = self._wheels_ahead(index)
            part = (event.t_ns - state.t_ns) / (ahead.t_ns - state.t_ns)
            left_rad = state.left_rad + part * (ahead.left_rad - state.left_rad)
            right_rad = state.right_rad + part * (ahead.right_rad - state.right_rad)
            state = self._filter.move(state, event.t_ns, left_rad, right_rad, ahead.after_gap)
        return self._filter.fuse(state, event)

    def _wheels_ahead(self, index: int) -> WheelReading:
        while not isinstance(event := self._events[index], WheelReading):
            index += 1
        return event

    def _trim(self) -> None:
        """Drop what is too much or older than the buffer, but for the newest such event: the state to start from."""
        oldest_ns = self.newest_wheels.t_ns - self._history_ns
        count = max(0, len(self._events) - self.capacity)
        while count + 1 < len(self._events) and self._events[count + 1].t_ns <= oldest_ns:
            count += 1
        if count:
            self._run(count)
            self._poses -= sum(isinstance(event, Measurement) for event in self._events[:count])
            del self._events[:count]
            del self._states[:count]
            self._before = max(self._before - count, 0)
