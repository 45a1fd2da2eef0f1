"""The device's clock as seen from the host: offset and skew from request and response, never stepped once in use."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

# Time stamps on the wire have 40 bits.
DEVICE_CLOCK_MODULUS_US = 1 << 40
# The stages of the clock filter of RFC 5905; half of them is enough to have met one short round trip. Chosen.
WINDOW = 8
SYNCED_AFTER = 4
# Two crystals of 100 ppm each; the spread of what is expected at first is that of one.
MAX_SKEW = 200e-6
_SKEW_STD = 100e-6
# How fast a correction is spread, five times faster than the clocks can part. Chosen.
SLEW_RATE = 1e-3
# At MAX_SKEW the clocks part by 6 ms in the holdover: an offset beyond RESTART_NS is no skew. Chosen.
HOLDOVER_NS = 30_000_000_000
RESTART_NS = 100_000_000
# Crystals drift with temperature, and no exchange is better than its time stamps. Chosen.
_SKEW_WALK_PER_SQRT_S = 1e-6
_FLOOR_NS = 50_000.0


@dataclass(frozen=True, slots=True)
class _Exchange:
    """One request and response: the midpoint on the host's clock and where the device's clock stood then."""

    host_ns: int
    offset_ns: float
    round_trip_ns: int


class DeviceClock:
    """Estimates host time minus device time from exchanges (Mills, RFC 5905, section 10: the clock filter).

    Of the last eight exchanges the one with the least round trip is used, since it was delayed least; a Kalman filter
    holds offset and skew, the skew within 200 ppm. Once `synced`, a correction is spread over time (1 ms a second), so
    that time stamps never jump. A device that has restarted is noticed by an offset that no skew explains: then
    everything starts afresh. The device's clock is taken modulo 2^40 us, as it is on the wire. `count`: exchanges, one
    after the other, since the start or the device's last restart.
    """

    def __init__(self) -> None:
        self._window: deque[_Exchange] = deque(maxlen=WINDOW)
        self._base_host_ns = 0
        self._base_us = 0
        self._last_ns = 0
        self._slew_from_ns = 0
        self.clear()

    def clear(self) -> None:
        """Start afresh with the next exchange."""
        self._window.clear()
        self._filter: _OffsetFilter | None = None
        self.count = 0
        self._slew_ns = 0.0

    def add(self, sent_ns: int, received_ns: int, device_us: int) -> bool:
        """Take in one exchange: host times of request and response, device time of the request's reception.

        Returns True if the device's clock was found to have restarted (then this exchange is the first of a new count).
        Nothing is learnt from a response that came before its request.
        """
        if received_ns < sent_ns:
            return False
        middle_ns = sent_ns + (received_ns - sent_ns) // 2
        restarted = False
        if self._filter is not None:
            error_ns = self._deviation(middle_ns, device_us) - self._filter.at(middle_ns)
            # What the estimate rests on may have waited on one of its two ways alone.
            uncertainty_ns = min(exchange.round_trip_ns for exchange in self._window)
            restarted = abs(error_ns) > RESTART_NS + uncertainty_ns + (received_ns - sent_ns)
        if self._filter is None or restarted:
            self._start(middle_ns, device_us)
        shown_ns = self._shown(received_ns) if self.synced(received_ns) else None
        # Requests that were under way together waited for the same thing, and agree however wrong they are.
        if self.count == 0 or sent_ns >= self._last_ns:
            self.count += 1
        self._last_ns = received_ns
        self._window.append(_Exchange(middle_ns, self._deviation(middle_ns, device_us), received_ns - sent_ns))
        best = min(self._window, key=lambda exchange: exchange.round_trip_ns)
        assert self._filter is not None
        self._filter.update(best)
        if shown_ns is not None:
            self._slew_ns = shown_ns - self._filter.at(received_ns)
            self._slew_from_ns = received_ns
        return restarted

    def synced(self, now_ns: int) -> bool:
        """Whether the estimate may be used: enough exchanges, and the last one not too long ago."""
        return self.count >= SYNCED_AFTER and now_ns - self._last_ns <= HOLDOVER_NS

    @property
    def skew(self) -> float:
        """Rate of the host's clock over the device's, minus one."""
        return self._filter.skew if self._filter is not None else 0.0

    def offset_ns(self, now_ns: int) -> int | None:
        """Host time minus device time at `now_ns`; None before the first exchange."""
        if self._filter is None:
            return None
        return self._base_host_ns - self._base_us * 1000 + round(self._shown(now_ns))

    def device_us(self, now_ns: int) -> float | None:
        """Return the device's clock at host time `now_ns`, in microseconds modulo 2^40.

        None before the first exchange.
        """
        offset_ns = self.offset_ns(now_ns)
        return None if offset_ns is None else ((now_ns - offset_ns) / 1000) % DEVICE_CLOCK_MODULUS_US

    def _start(self, host_ns: int, device_us: int) -> None:
        self.clear()
        self._filter = _OffsetFilter(host_ns)
        self._base_host_ns, self._base_us = host_ns, device_us

    def _deviation(self, host_ns: int, device_us: int) -> float:
        """Offset of one exchange relative to that of the first; the device's clock may have wrapped since."""
        half = DEVICE_CLOCK_MODULUS_US // 2
        elapsed_ns = host_ns - self._base_host_ns
        ahead_us = (device_us - self._base_us - elapsed_ns // 1000 + half) % DEVICE_CLOCK_MODULUS_US - half
        return float(elapsed_ns % 1000 - 1000 * ahead_us)

    def _shown(self, now_ns: int) -> float:
        assert self._filter is not None
        left_ns = max(0.0, abs(self._slew_ns) - SLEW_RATE * max(0, now_ns - self._slew_from_ns))
        return self._filter.at(now_ns) + (left_ns if self._slew_ns >= 0.0 else -left_ns)


class _OffsetFilter:
    """Kalman filter of two states: offset (ns, relative to the first exchange) and skew (ns per ns)."""

    def __init__(self, host_ns: int) -> None:
        self._host_ns = host_ns
        self._used_ns = host_ns - 1
        self._offset_ns = 0.0
        self.skew = 0.0
        self._p00 = 1e18
        self._p01 = 0.0
        self._p11 = _SKEW_STD**2

    def at(self, now_ns: int) -> float:
        """Return the offset at `now_ns`."""
        return self._offset_ns + self.skew * (now_ns - self._host_ns)

    def update(self, exchange: _Exchange) -> None:
        """Use an exchange, unless it or a later one has been used."""
        if exchange.host_ns <= self._used_ns:
            return
        self._used_ns = exchange.host_ns
        elapsed_ns = exchange.host_ns - self._host_ns
        offset_ns = self.at(exchange.host_ns)
        walk = _SKEW_WALK_PER_SQRT_S**2 * elapsed_ns * 1e-9
        p00 = self._p00 + elapsed_ns * (2.0 * self._p01 + elapsed_ns * self._p11) + walk * elapsed_ns**2 / 3.0
        p01 = self._p01 + elapsed_ns * self._p11 + walk * elapsed_ns / 2.0
        p11 = self._p11 + walk
        # The way there and the way back differ by at most the round trip; a quarter of it is a fair guess.
        noise = (_FLOOR_NS + 0.25 * exchange.round_trip_ns) ** 2
        innovation = exchange.offset_ns - offset_ns
        gain0, gain1 = p00 / (p00 + noise), p01 / (p00 + noise)
        self._host_ns = exchange.host_ns
        self._offset_ns = offset_ns + gain0 * innovation
        self.skew = min(max(self.skew + gain1 * innovation, -MAX_SKEW), MAX_SKEW)
        self._p00, self._p01, self._p11 = (1.0 - gain0) * p00, (1.0 - gain0) * p01, p11 - gain1 * p01


def age_us(sample_us: float, modulus_us: int, device_us: float) -> float:
    """Return how old a sample is, from the low bits of its device time.

    `sample_us` is the sample's device time modulo `modulus_us`, `device_us` the device's clock now. The age lies in
    [-modulus/16, modulus 15/16): a sample may seem to be a little of the future, as the clocks agree only so well.
    """
    slack_us = modulus_us / 16
    return (device_us % modulus_us - sample_us + slack_us) % modulus_us - slack_us
