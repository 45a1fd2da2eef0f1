"""Rewind buffer: poses are put in at the time when they were true, and what followed is run again."""

from __future__ import annotations

import math

from disco_hw.estimation.correction import Measurement, PoseReason
from disco_hw.estimation.filter import FilterState, Judgement, PoseFilter
from disco_hw.estimation.odometry import WheelReading

Event = WheelReading | Measurement

# The buffer is sized for these rates; beyond them it covers less time (wheels) or refuses (poses).
MAX_WHEEL_RATE_HZ = 200.0
MAX_POSE_RATE_HZ = 100.0


class RewindBuffer:
    """Wheel readings and poses of the last `history_s` in the order of their stamps, and the state after each.

    The states are a function of the events alone, so that a pose gives the same result, bit for bit, however late or in
    whatever order it comes in, while its stamp is inside the buffer. A pose between two wheel readings sees the wheels
    at the angles interpolated linearly in time; one beyond the newest reading is judged on extrapolated angles, and
    again when the next reading is there.
    One call runs each event in the buffer once at worst.
    """

    def __init__(self, pose_filter: PoseFilter, first: WheelReading, history_s: float, sources: int = 1) -> None:
        self._filter = pose_filter
        self._history_ns = round(history_s * 1e9)
        self._max_poses = math.ceil(sources * history_s * MAX_POSE_RATE_HZ)
        self._max_events = self._max_poses + math.ceil(history_s * MAX_WHEEL_RATE_HZ) + 1
        self._poses = 0
        self._events: list[Event] = [first]
        # States after the first len(_states) events; never empty. The rest are outdated and run on demand.
        self._states: list[FilterState] = [pose_filter.begin(first)]
        # The first so many of them are of a filter before the present one, which adopts those that it goes on from.
        self._before = 0
        self._newest_wheels = first

    @property
    def newest_wheels(self) -> WheelReading:
        """The newest wheel reading."""
        return self._newest_wheels

    @property
    def capacity(self) -> int:
        """Number of events that the buffer never exceeds."""
        return self._max_events

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
        self._newest_wheels = reading
        self._trim()

    def add_pose(self, measurement: Measurement) -> Judgement | PoseReason:
        """Insert a pose at its stamp; what the filter made of it, or why it cannot be inserted."""
        if measurement.t_ns < self._events[0].t_ns:
            return PoseReason.TOO_OLD
        if measurement.t_ns > self._newest_wheels.t_ns + self._history_ns:
            return PoseReason.NO_ODOMETRY
        index = self._index_after(measurement.t_ns, include_equal=True)
        # Of several sources at one instant the lowest is first, in whatever order they come.
        while (before := self._events[index - 1]).t_ns == measurement.t_ns and isinstance(before, Measurement):
            if before.source == measurement.source:
                return PoseReason.DUPLICATE
            if before.source < measurement.source:
                break
            index -= 1
        if self._poses >= self._max_poses:
            return PoseReason.OVERFLOW
        self._events.insert(index, measurement)
        self._poses += 1
        self._outdate(index)
        judgement = self._run(index).judgement
        self._trim()
        if judgement is None:
            raise AssertionError("the state at a pose holds its judgement")
        return judgement

    def head(self) -> FilterState:
        """The state after the last event."""
        return self._run(len(self._events) - 1)

    def _index_after(self, t_ns: int, include_equal: bool) -> int:
        """Where an event of this time belongs: from the end, because nearly all are among the newest."""
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
        if event.t_ns >= self._newest_wheels.t_ns:
            state = self._filter.extrapolate(state, self._newest_wheels, event.t_ns)
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
        oldest_ns = self._newest_wheels.t_ns - self._history_ns
        count = max(0, len(self._events) - self._max_events)
        while count + 1 < len(self._events) and self._events[count + 1].t_ns <= oldest_ns:
            count += 1
        if count:
            self._run(count)
            self._poses -= sum(isinstance(event, Measurement) for event in self._events[:count])
            del self._events[:count]
            del self._states[:count]
            self._before = max(self._before - count, 0)
