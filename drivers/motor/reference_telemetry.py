"""Decoded telemetry -> samples in SI units on the host's clock: pairs of frames, tick counters, time stamps."""

from __future__ import annotations

import math

from drivers.device_clock import DeviceClock, age_us
from drivers.types import MotorSample, PoseSample, PowerSample, RobotLinkHealth, WheelSample
from firmware_protocol.codec import Decoded

LONGEST_APART_NS = 50_000_000
TICKS_MODULUS = 1 << 24
SPEED_MARGIN = 1.5
SLACK_TICKS = 4.0
REANCHOR_AFTER = 5
WHEEL_MESSAGES = frozenset({"WHEEL_SPEED", "WHEEL_TICKS"})
POSE_MESSAGES = frozenset({"POSE_POSITION", "POSE_HEADING"})
WHEEL_TIME_MODULUS_US = 20 << 16
POSE_TIME_MODULUS_US = 100 << 16
OLDEST_WHEEL_US = 300_000.0
OLDEST_POSE_US = 3_000_000.0
DISTRUST_CLOCK_AFTER = 20
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
            self._ticks.forget()

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
            yaw_rad=_wrap(heading["yaw"]),
            position_std_m=heading["position_std"],
            yaw_std_rad=heading["yaw_std"],
        )

    def _plausible_us(self, sample_us: float, received_ns: int) -> int:
        """Time of a wheel sample, relative to the first, for judging its motion; it does not wrap.

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
    """Return what a MOTOR frame says."""
    values = decoded.values
    return MotorSample(
        t_ns=received_ns,
        left_current_a=values["left_current"],
        right_current_a=values["right_current"],
        left_temperature_c=values["left_temperature"],
        right_temperature_c=values["right_temperature"],
    )


def power(decoded: Decoded, received_ns: int) -> PowerSample:
    """Return what a POWER frame says."""
    values = decoded.values
    return PowerSample(
        t_ns=received_ns,
        voltage_v=values["voltage"],
        current_a=values["current"],
        temperature_c=values["temperature"],
    )


def link_health(decoded: Decoded, received_ns: int) -> RobotLinkHealth:
    """Return what a LINK_HEALTH frame says."""
    values = {name: int(value) for name, value in decoded.values.items()}
    return RobotLinkHealth(t_ns=received_ns, **values)


def _wrap(angle_rad: float) -> float:
    """Wrap into (-pi, pi]; the wire's range is a little wider."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)


class FramePairs:
    """Pairs frames of two messages that carry the same counter and arrive within 50 ms of each other.

    The counter alone would not do: it is the same again after sixteen samples.
    """

    __slots__ = ("_first_name", "_waiting", "_waiting_since_ns")

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

    __slots__ = (
        "_angle_per_tick",
        "_left",
        "_max_ticks_per_us",
        "_rejected",
        "_right",
        "_start",
        "_t_us",
        "_ticks_left",
        "_ticks_right",
    )

    def __init__(self, ticks_per_rev: int, max_speed_rad_s: float, start: tuple[float, float] = (0.0, 0.0)) -> None:
        self._start = start
        self._angle_per_tick = 2.0 * math.pi / ticks_per_rev
        self._max_ticks_per_us = SPEED_MARGIN * max_speed_rad_s / self._angle_per_tick * 1e-6
        self._left = 0
        self._right = 0
        self._rejected = 0
        self._ticks_left: int | None = None
        self._ticks_right = 0
        self._t_us = 0

    def forget(self) -> None:
        """Take the next reading as it is: the angles go on from where they are."""
        self._ticks_left = None

    def update(self, ticks_left: int, ticks_right: int, t_us: int) -> tuple[float, float] | None:
        """Take in a reading of device time `t_us` (which does not wrap); return both angles, None if implausible."""
        if self._ticks_left is not None:
            left = _shortest(ticks_left - self._ticks_left)
            right = _shortest(ticks_right - self._ticks_right)
            limit = min(self._max_ticks_per_us * (t_us - self._t_us) + SLACK_TICKS, TICKS_MODULUS // 2 - 1)
            if max(abs(left), abs(right)) <= limit:
                self._left += left
                self._right += right
            else:
                self._rejected += 1
                if self._rejected < REANCHOR_AFTER:
                    return None
        self._rejected = 0
        self._ticks_left, self._ticks_right, self._t_us = ticks_left, ticks_right, t_us
        return self.angles

    @property
    def angles(self) -> tuple[float, float]:
        """Both angles after the last accepted reading."""
        left, right = self._start
        return left + self._left * self._angle_per_tick, right + self._right * self._angle_per_tick


def _shortest(difference: int) -> int:
    half = TICKS_MODULUS // 2
    return (difference + half) % TICKS_MODULUS - half
