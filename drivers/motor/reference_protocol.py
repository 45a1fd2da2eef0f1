"""The reference controller's protocol beside its commands, in two halves.

What follows from the protocol alone: e-stop, bus load, safety card. And the frames that the host keeps sending:
introduction, state, and clock requests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from drivers.motor.reference_arming import HostState
from drivers.motor.reference_frames import FrameReception, FrameTransmission
from drivers.types import CyclicFrame, Frame, NoSettings, OutgoingFrame, ReceivedFrame, SafetyCard
from firmware_protocol.codec import PROTOCOL, PROTOCOL_MAJOR, PROTOCOL_MINOR, Codec, Decoded

# Chosen: each has an 8-bit check sum that fits a foreign frame by chance, five do not.
_FRAMES_OF_OURS = 5
_COMMANDS = ("WHEEL_COMMAND", "WHEEL_COMMAND_MAC")
_AUTHENTICATION_FRAMES = ("WHEEL_COMMAND_MAC", "HOST_STATE_MAC", "MAC_CHALLENGE")
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


def cyclic_frames(_settings: NoSettings, command_rate_hz: float, authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Return all frames with a cycle time (GenMsgCycleTime) in the DBC, each page of a multiplexed one.

    The wheel command counts at the rate of the control loop; proofs and their challenge only if `authenticated`.
    """
    frames = []
    for message in PROTOCOL.messages:
        if message.period_s is not None and (authenticated or message.name not in _AUTHENTICATION_FRAMES):
            pages = {signal.page for signal in message.signals} - {None}
            rate_hz = command_rate_hz if message.name in _COMMANDS else 1.0 / message.period_s
            frames.append(CyclicFrame(message.name, message.sender, message.length, rate_hz * max(1, len(pages))))
    return tuple(frames)


def stop_frames(_settings: NoSettings) -> tuple[Frame, ...]:
    """Return the e-stop, which the controller latches and confirms."""
    encoded = Codec().encode("ESTOP", reason=1)
    return (Frame(encoded.can_id, encoded.data),)


def stop_confirmation(_settings: NoSettings) -> Callable[[ReceivedFrame], bool]:
    """Return a function that tells of a received frame whether the controller has confirmed an e-stop."""
    codec = Codec()

    def is_confirmation(received: ReceivedFrame) -> bool:
        frame = received.frame
        decoded = None if frame.extended else codec.decode(frame.can_id, frame.data)
        if not isinstance(decoded, Decoded) or decoded.name != "SYSTEM_STATE":
            return False
        return codec.choice_name("SYSTEM_STATE", "state", decoded.values["state"]) == "ESTOP"

    return is_confirmation


def safety_card(_settings: NoSettings) -> SafetyCard:
    """Return the safety card of the reference controller."""
    return SafetyCard(
        host_silent="the controller, 0.1 s after the last accepted wheel command, by its watchdog; the watchdog "
        "cannot be switched off",
        stops_by="braking: the robot decelerates within its own limit, then brakes",
        reaction_s=0.1,
        brakes=True,
        estop="an e-stop frame of any length, also from `disco-hw estop`: the robot decelerates; the stop is latched "
        "and confirmed",
        wheel_fault="the motors are off (COAST) for 0.2 s, then the controller brakes without its speed loop; no ramp",
    )


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Return an empty dict if the frames have the checksum that is the reference controller's alone, else None."""
    reception = FrameReception(Codec())
    believed = [reception.accept(ReceivedFrame(0, frame)) for frame in frames]
    return {} if sum(one is not None for one in believed) >= _FRAMES_OF_OURS else None


class HouseKeeping:
    """Says which of these frames are due; remembers when it asked for the robot's clock."""

    def __init__(self, transmission: FrameTransmission, dbc_hash: int) -> None:
        self._transmission, self._dbc_hash = transmission, dbc_hash
        self._host_state: HostState | None = None
        self._time_sequence = 0
        self._time_requests: dict[int, int] = {}

    def clear(self) -> None:
        """Expect no answer to any clock request, as after a new link."""
        self._time_requests.clear()

    def requested_time_ns(self, sequence: int) -> int | None:
        """When the clock request of this number was sent, once; None if no such answer is expected."""
        return self._time_requests.pop(sequence, None)

    def frames(
        self, now_ns: int, state: HostState, clock_samples: int, *, introduced: bool, refused: bool
    ) -> list[OutgoingFrame]:
        """Return the frames that are due now.

        `introduced`: whether host and robot have accepted each other; `refused`: whether the host refuses this robot.
        `clock_samples`: number of responses in the estimate of the robot's clock.
        """
        due: dict[str, dict[str, float | str]] = {}
        is_due = self._transmission.due
        hello_period_ns = REFUSED_HELLO_PERIOD_NS if refused else HELLO_PERIOD_NS
        if not introduced and is_due("HELLO_REQUEST", now_ns, hello_period_ns):
            version = {"protocol_major": PROTOCOL_MAJOR, "protocol_minor": PROTOCOL_MINOR}
            due["HELLO_REQUEST"] = {**version, "dbc_hash": self._dbc_hash}
        if state != self._host_state or is_due("HOST_STATE", now_ns, HOST_STATE_PERIOD_NS):
            self._host_state = state
            due["HOST_STATE"] = {**msgspec.structs.asdict(state), "host_fault": 0}
        time_period_ns = FAST_TIME_PERIOD_NS if clock_samples < FAST_TIME_COUNT else TIME_PERIOD_NS
        if is_due("TIME_REQUEST", now_ns, time_period_ns):
            self._time_sequence = (self._time_sequence + 1) % 256
            self._time_requests[self._time_sequence] = now_ns
            if len(self._time_requests) > _PENDING_TIMES:
                del self._time_requests[next(iter(self._time_requests))]
            due["TIME_REQUEST"] = {"sequence": self._time_sequence}
        return [self._transmission.frame(name, now_ns, _DEADLINE_NS, **signals) for name, signals in due.items()]
