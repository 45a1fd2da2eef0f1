"""Frames of the reference controller in and out, and what telemetry says in SI units on the host's clock.

Which received frames may be believed; counters, deadlines and proofs of those to send; pairs of frames, tick counters
and time stamps of decoded telemetry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from drivers.device_clock import DeviceClock, age_us
from drivers.types import (
    Frame,
    MotorSample,
    OutgoingFrame,
    PoseSample,
    PowerSample,
    ReceivedFrame,
    RobotLinkHealth,
    WheelSample,
)
from firmware_protocol.codec import PROTOCOL, Codec, Decoded, DecodeFault, FaultReason
from firmware_protocol.protection import COUNTER_MODULUS, E2EReceiver, E2EStatus, EncodedFrame, Prover

# Five periods of the slowest cyclic messages: 0.1 s of most, 1 s of LINK_HEALTH; a few lost frames lose no sender. The
# poses' period is the sensor's; old ones are refused by their age.
TIMEOUT_NS = 500_000_000
SLOW_TIMEOUT_NS = 5_000_000_000
_SLOW = frozenset({"POWER", "LINK_HEALTH", "POSE_POSITION", "POSE_HEADING"})
# Asked for one by one, so that there is no row of good frames to wait for; hearing one twice does no harm.
_ANSWERS = frozenset({"HELLO", "BUILD", "LIMITS", "TIME_RESPONSE", "PARAM_RESPONSE", "MAC_CHALLENGE"})
_SENDERS = {layout.name: layout.sender for layout in PROTOCOL.messages}
_USABLE = (E2EStatus.OK, E2EStatus.OK_SOME_LOST)
_REJECTED = (E2EStatus.REPEATED, E2EStatus.WRONG_SEQUENCE)
_AFTER_A_GAP = (E2EStatus.INITIAL, E2EStatus.OK_SOME_LOST, E2EStatus.WRONG_SEQUENCE)


class FrameReception:
    """Decodes frames, checks their end-to-end protection per identifier and counts all that is not used."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._receivers: dict[str, E2EReceiver] = {}
        self._counters: dict[str, int] = {}
        self.accepted = 0
        self.rejected_crc = 0
        self.rejected_sequence = 0
        self.rejected_length = 0
        self.unknown_id = 0
        self.lost = 0
        self.foreign: str | None = None
        self.outside_stop_ns: int | None = None

    def reset(self) -> None:
        """Forget the senders, as at a new link; the counts stay."""
        self._receivers.clear()
        self._counters.clear()
        self.foreign = None
        self.outside_stop_ns = None

    def accept(self, received: ReceivedFrame) -> Decoded | None:
        """Return the decoded frame if it may be believed, None otherwise; whatever the wire brings, nothing is raised.

        `foreign` names the last message seen that only a host sends: somebody else commands this robot. An e-stop does
        not count as that, as anybody may send one: `outside_stop_ns` is when the last was received.
        """
        if received.frame.extended:
            self.unknown_id += 1
            return None
        decoded = self._codec.decode(received.frame.can_id, received.frame.data)
        if isinstance(decoded, DecodeFault):
            self._count(decoded, received.t_ns)
            return None
        if decoded.name == "ESTOP":
            self.outside_stop_ns = received.t_ns
            return None
        if _SENDERS[decoded.name] != "ROBOT":
            self.foreign = decoded.name
            self.unknown_id += 1
            return None
        if decoded.name not in _ANSWERS:
            receiver = self._receiver(decoded.name)
            status = receiver.check(decoded.counter, True, received.t_ns)
            self._count_lost(decoded, status)
            if status in _REJECTED:
                self.rejected_sequence += 1
            if not (receiver.qualified and status in _USABLE):
                return None
        self.accepted += 1
        return decoded

    def _receiver(self, name: str) -> E2EReceiver:
        receiver = self._receivers.get(name)
        if receiver is None:
            receiver = self._receivers[name] = E2EReceiver(SLOW_TIMEOUT_NS if name in _SLOW else TIMEOUT_NS)
        return receiver

    def _count(self, fault: DecodeFault, received_ns: int) -> None:
        match fault.reason:
            case FaultReason.UNKNOWN_ID:
                self.unknown_id += 1
            case FaultReason.CRC:
                self.rejected_crc += 1
                self._receiver(fault.name).check(0, False, received_ns)
            case FaultReason.LENGTH | FaultReason.PAGE:
                self.rejected_length += 1

    def _count_lost(self, decoded: Decoded, status: E2EStatus) -> None:
        previous = self._counters.get(decoded.name)
        self._counters[decoded.name] = decoded.counter
        if previous is not None and status in _AFTER_A_GAP:
            # At least: whole turns of the counter do not show.
            self.lost += (decoded.counter - previous - 1) % COUNTER_MODULUS


class FrameTransmission:
    """Encodes frames, proves them if there is a key (16 bytes), and remembers when each message was last sent."""

    def __init__(self, codec: Codec, key: bytes | None = None) -> None:
        self._codec = codec
        self._prover = Prover(key, codec) if key is not None else None
        self._counters: dict[str, int] = {}
        self._sent_ns: dict[str, int] = {}

    def due(self, name: str, now_ns: int, period_ns: int) -> bool:
        """Whether a message was last sent a period ago or never."""
        sent_ns = self._sent_ns.get(name)
        return sent_ns is None or now_ns - sent_ns >= period_ns

    def clear(self) -> None:
        """Make every cyclic message due; the counters go on, so that no old frame can pass for a new one."""
        self._sent_ns.clear()
        if self._prover is not None:
            self._prover.clear()

    def challenge(self, nonce: int) -> None:
        """Take in the robot's nonce, to which proofs are bound."""
        if self._prover is not None:
            self._prover.challenge(nonce)

    def proved(self, frames: Sequence[OutgoingFrame]) -> tuple[OutgoingFrame, ...]:
        """Put its proof before each frame that needs one; what cannot be proved yet is left out."""
        prover = self._prover
        if prover is None:
            return tuple(frames)
        proved = []
        for outgoing in frames:
            frame = EncodedFrame(outgoing.frame.can_id, outgoing.frame.data)
            if prover.needs_proof(frame.can_id):
                if not prover.ready:
                    continue
                proved.append(OutgoingFrame(Frame(*prover.prove(frame)), outgoing.deadline_ns))
            proved.append(outgoing)
        return tuple(proved)

    def frame(self, name: str, now_ns: int, valid_for_ns: int, **signals: float | str) -> OutgoingFrame:
        """Return a frame that must have left `valid_for_ns` from now. Raises ValueError as `Codec.encode` does."""
        counter = self._counters.get(name, 0)
        encoded = self._codec.encode(name, counter, **signals)
        self._counters[name] = (counter + 1) % COUNTER_MODULUS
        self._sent_ns[name] = now_ns
        return OutgoingFrame(Frame(encoded.can_id, encoded.data), now_ns + valid_for_ns)


# Shorter than 160 ms, after which the 4-bit counter of a message sent every 10 ms comes again.
LONGEST_APART_NS = 50_000_000
# 24-bit counters in WHEEL_TICKS.
TICKS_MODULUS = 1 << 24
# Chosen: an overshoot of the wheel and jitter of its time are no implausible count.
SPEED_MARGIN = 1.5
SLACK_TICKS = 4.0
# Chosen: so many implausible counts in a row are a counter that has restarted, fewer are noise.
REANCHOR_AFTER = 5
WHEEL_MESSAGES = frozenset({"WHEEL_SPEED", "WHEEL_TICKS"})
POSE_MESSAGES = frozenset({"POSE_POSITION", "POSE_HEADING"})
# sample_time: 16 bits, in steps of 20 us in WHEEL_SPEED and of 100 us in POSE_HEADING.
WHEEL_TIME_MODULUS_US = 20 << 16
POSE_TIME_MODULUS_US = 100 << 16
# Chosen: below half of the modulus, so that a stamp of the future does not look like an old one.
OLDEST_WHEEL_US = 300_000.0
OLDEST_POSE_US = 3_000_000.0
# Chosen: so many odd stamps in a row are a device that has restarted, fewer are disturbed samples.
DISTRUST_CLOCK_AFTER = 20
# Chosen: by how much a reading thread may be late; the device's time cannot have gone on for longer than the host's and
# this.
RECEPTION_JITTER_US = 50_000.0


class Telemetry:
    """Joins, unwraps and time-stamps samples; what makes no sense is counted and dropped.

    Samples are stamped with the device's time of measurement once its clock is known, before that with the reception.
    """

    def __init__(self, clock: DeviceClock) -> None:
        self._clock = clock
        self._wheel_pairs = FramePairs("WHEEL_SPEED")
        self._pose_pairs = FramePairs("POSE_POSITION")
        self._ticks: WheelTicks | None = None
        self._limits: tuple[int, float] | None = None
        self._wheel_time: tuple[int, int, float] | None = None
        self._odd_stamps = 0
        self.implausible_ticks = 0
        self.implausible_values = 0

    @property
    def distrusts_clock(self) -> bool:
        """Whether sample times have contradicted the device's clock for so long that it must have restarted."""
        return self._odd_stamps >= DISTRUST_CLOCK_AFTER

    def configure(self, ticks_per_rev: int, max_wheel_speed_rad_s: float) -> None:
        """Set encoder resolution and largest speed; the angles go on from where they are."""
        limits = (ticks_per_rev, max_wheel_speed_rad_s)
        if limits != self._limits:
            self._limits = limits
            self._ticks = WheelTicks(*limits, start=self._ticks.angles if self._ticks is not None else (0.0, 0.0))

    def restart(self) -> None:
        """Take the next samples as they are, as after an interruption: the angles go on from where they are."""
        self._odd_stamps = 0
        if self._ticks is not None:
            self._ticks.clear()

    def wheels(self, decoded: Decoded, received_ns: int) -> WheelSample | None:
        """Take in a frame of `WHEEL_MESSAGES`; return the sample that it completes."""
        pair = self._wheel_pairs.add(decoded, received_ns)
        if pair is None or self._ticks is None:
            return None
        speed, ticks = pair[0].values, pair[1].values
        if not (speed["left_valid"] and speed["right_valid"]):
            self.implausible_values += 1
            return None
        sample_us = speed["sample_time"]
        t_us = self._plausible_us(sample_us, received_ns)
        angles = self._ticks.update(int(ticks["left_ticks"]), int(ticks["right_ticks"]), t_us)
        if angles is None:
            self.implausible_ticks += 1
            return None
        return WheelSample(
            t_ns=self._stamp_ns(sample_us, WHEEL_TIME_MODULUS_US, OLDEST_WHEEL_US, received_ns),
            received_ns=received_ns,
            left_angle_rad=angles[0],
            right_angle_rad=angles[1],
            left_speed_rad_s=speed["left_speed"],
            right_speed_rad_s=speed["right_speed"],
        )

    def pose(self, decoded: Decoded, received_ns: int) -> PoseSample | None:
        """Take in a frame of `POSE_MESSAGES`; return the sample that it completes."""
        pair = self._pose_pairs.add(decoded, received_ns)
        if pair is None:
            return None
        position, heading = pair[0].values, pair[1].values
        if not (position["valid"] and heading["valid"]):
            self.implausible_values += 1
            return None
        return PoseSample(
            t_ns=self._stamp_ns(heading["sample_time"], POSE_TIME_MODULUS_US, OLDEST_POSE_US, received_ns),
            received_ns=received_ns,
            x_m=position["x"],
            y_m=position["y"],
            # Into (-pi, pi]: the wire's range is a little wider.
            yaw_rad=math.pi - (math.pi - heading["yaw"]) % (2.0 * math.pi),
            position_std_m=heading["position_std"],
            yaw_std_rad=heading["yaw_std"],
        )

    def _plausible_us(self, sample_us: float, received_ns: int) -> int:
        """Return the unwrapped time (us) of a wheel sample since the first, limited by the time between receptions.

        It advances as the sample times say, but no more than the receptions allow: the sample times of a device that
        has restarted say anything.
        """
        if self._wheel_time is None:
            self._wheel_time = (0, received_ns, sample_us)
            return 0
        last_us, last_received_ns, last_sample_us = self._wheel_time
        elapsed_us = (sample_us - last_sample_us) % WHEEL_TIME_MODULUS_US
        since_us = (received_ns - last_received_ns) / 1000
        wraps = max(0, round((since_us - elapsed_us) / WHEEL_TIME_MODULUS_US))
        elapsed_us = min(elapsed_us + wraps * WHEEL_TIME_MODULUS_US, since_us + RECEPTION_JITTER_US)
        t_us = last_us + round(max(elapsed_us, 0.0))
        self._wheel_time = (t_us, received_ns, sample_us)
        return t_us

    def _stamp_ns(self, sample_us: float, modulus_us: int, oldest_us: float, received_ns: int) -> int:
        """Return a sample's host time; that of reception if the clock is not synced or the age exceeds `oldest_us`."""
        device_us = self._clock.device_us(received_ns) if self._clock.synced(received_ns) else None
        if device_us is None:
            return received_ns
        age = age_us(sample_us, modulus_us, device_us)
        if age > oldest_us:
            self._odd_stamps += 1
            self.implausible_values += 1
            return received_ns
        self._odd_stamps = 0
        return received_ns - max(0, round(age * 1000))


def motor(decoded: Decoded, received_ns: int) -> MotorSample:
    """Return the sample of a MOTOR frame."""
    values = decoded.values
    return MotorSample(
        t_ns=received_ns,
        left_current_a=values["left_current"],
        right_current_a=values["right_current"],
        left_temperature_c=values["left_temperature"],
        right_temperature_c=values["right_temperature"],
    )


def power(decoded: Decoded, received_ns: int) -> PowerSample:
    """Return the sample of a POWER frame."""
    values = decoded.values
    return PowerSample(
        t_ns=received_ns,
        voltage_v=values["voltage"],
        current_a=values["current"],
        temperature_c=values["temperature"],
    )


def link_health(decoded: Decoded, received_ns: int) -> RobotLinkHealth:
    """Return the sample of a LINK_HEALTH frame."""
    values = {name: int(value) for name, value in decoded.values.items()}
    return RobotLinkHealth(t_ns=received_ns, **values)


class FramePairs:
    """Pairs frames of two messages that carry the same counter and arrive within 50 ms of each other.

    The counter alone would not do: it is the same again after sixteen samples.
    """

    def __init__(self, first_name: str) -> None:
        self._first_name = first_name
        self._waiting: Decoded | None = None
        self._waiting_since_ns = 0

    def add(self, decoded: Decoded, received_ns: int) -> tuple[Decoded, Decoded] | None:
        """Take in a frame of either message; return both, the first message's first, when they are complete."""
        other, self._waiting = self._waiting, None
        if (
            other is None
            or other.name == decoded.name
            or other.counter != decoded.counter
            or received_ns - self._waiting_since_ns > LONGEST_APART_NS
        ):
            self._waiting, self._waiting_since_ns = decoded, received_ns
            return None
        return (decoded, other) if decoded.name == self._first_name else (other, decoded)


class WheelTicks:
    """Turns a pair of 24-bit tick counters into angles (rad, left and right) that do not wrap.

    Two readings differ by the shortest way round the ring, and by no more than the wheels can turn in the time between:
    one and a half times `max_speed_rad_s`, and a few ticks. What is more is implausible and dropped; after five such
    readings in a row the counters are taken as they are, with no motion in between. The first reading is `start`.
    """

    def __init__(self, ticks_per_rev: int, max_speed_rad_s: float, start: tuple[float, float] = (0.0, 0.0)) -> None:
        self._start = start
        self._angle_per_tick = 2.0 * math.pi / ticks_per_rev
        self._max_ticks_per_us = SPEED_MARGIN * max_speed_rad_s / self._angle_per_tick * 1e-6
        self._left = self._right = 0
        self._rejected = 0
        self._last: tuple[int, int, int] | None = None

    def clear(self) -> None:
        """Take the next reading as it is: the angles go on from where they are."""
        self._last = None

    def update(self, ticks_left: int, ticks_right: int, t_us: int) -> tuple[float, float] | None:
        """Take in a reading of device time `t_us` (which does not wrap); return both angles, None if implausible."""
        if self._last is not None:
            last_left, last_right, last_us = self._last
            left, right = _shortest(ticks_left - last_left), _shortest(ticks_right - last_right)
            limit = min(self._max_ticks_per_us * (t_us - last_us) + SLACK_TICKS, TICKS_MODULUS // 2 - 1)
            if max(abs(left), abs(right)) <= limit:
                self._left += left
                self._right += right
            else:
                self._rejected += 1
                if self._rejected < REANCHOR_AFTER:
                    return None
        self._rejected = 0
        self._last = (ticks_left, ticks_right, t_us)
        return self.angles

    @property
    def angles(self) -> tuple[float, float]:
        """Angles (rad) of the left and right wheel after the last accepted reading."""
        left, right = self._start
        return left + self._left * self._angle_per_tick, right + self._right * self._angle_per_tick


def _shortest(difference: int) -> int:
    half = TICKS_MODULUS // 2
    return (difference + half) % TICKS_MODULUS - half
