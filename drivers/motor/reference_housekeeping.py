"""Frames that the host of a reference controller sends beside its commands: introduction, state, and clock requests."""

from __future__ import annotations

from drivers.motor.reference_arming import HostState
from drivers.motor.reference_frames import FrameTransmission
from drivers.types import OutgoingFrame
from firmware_protocol.codec import PROTOCOL_MAJOR, PROTOCOL_MINOR

# A little under 10 Hz, so that a loop whose ticks come early by some jitter does not skip one.
HOST_STATE_PERIOD_NS = 90_000_000
HELLO_PERIOD_NS = 200_000_000
# A controller that was refused is asked again slowly: it has to be changed first.
REFUSED_HELLO_PERIOD_NS = 1_000_000_000
# The first requests come fast, so that samples have the device's time soon after the link is up.
FAST_TIME_PERIOD_NS = 200_000_000
TIME_PERIOD_NS = 1_000_000_000
FAST_TIME_COUNT = 10
# Held up for longer, a frame is dropped: the next one takes its place.
_DEADLINE_NS = 100_000_000
_PENDING_TIMES = 8


class HouseKeeping:
    """Says which of these frames are due; remembers when it asked for the robot's clock."""

    def __init__(self, transmission: FrameTransmission, dbc_hash: int) -> None:
        self._transmission, self._dbc_hash = transmission, dbc_hash
        self._host_state: HostState | None = None
        self._time_sequence = 0
        self._time_requests: dict[int, int] = {}

    def forget(self) -> None:
        """Expect no answer to any clock request, as after a new link."""
        self._time_requests.clear()

    def asked_time_ns(self, sequence: int) -> int | None:
        """When the clock request of this number was sent, once; None if no such answer is expected."""
        return self._time_requests.pop(sequence, None)

    def frames(
        self, now_ns: int, state: HostState, clock_samples: int, *, introduced: bool, refused: bool
    ) -> list[OutgoingFrame]:
        """Frames due now.

        `introduced`: whether host and robot have accepted each other; `refused`: whether the host refuses this robot.
        `clock_samples`: how many answers the estimate of the robot's clock is made of.
        """
        frames = []
        transmission = self._transmission
        hello_period_ns = REFUSED_HELLO_PERIOD_NS if refused else HELLO_PERIOD_NS
        if not introduced and transmission.due("HELLO_REQUEST", now_ns, hello_period_ns):
            frames.append(
                transmission.frame(
                    "HELLO_REQUEST",
                    now_ns,
                    _DEADLINE_NS,
                    protocol_major=PROTOCOL_MAJOR,
                    protocol_minor=PROTOCOL_MINOR,
                    dbc_hash=self._dbc_hash,
                )
            )
        if state != self._host_state or transmission.due("HOST_STATE", now_ns, HOST_STATE_PERIOD_NS):
            self._host_state = state
            frames.append(
                transmission.frame(
                    "HOST_STATE",
                    now_ns,
                    _DEADLINE_NS,
                    request=state.request,
                    session=state.session,
                    challenge_answer=state.challenge_answer,
                    host_fault=0,
                )
            )
        time_period_ns = FAST_TIME_PERIOD_NS if clock_samples < FAST_TIME_COUNT else TIME_PERIOD_NS
        if transmission.due("TIME_REQUEST", now_ns, time_period_ns):
            self._time_sequence = (self._time_sequence + 1) % 256
            self._time_requests[self._time_sequence] = now_ns
            if len(self._time_requests) > _PENDING_TIMES:
                del self._time_requests[next(iter(self._time_requests))]
            frames.append(transmission.frame("TIME_REQUEST", now_ns, _DEADLINE_NS, sequence=self._time_sequence))
        return frames
