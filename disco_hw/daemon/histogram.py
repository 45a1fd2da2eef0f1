"""A histogram of durations of fixed size: recording takes no memory however long the daemon runs."""

from __future__ import annotations

import math
from array import array

_MANTISSA_BITS = 7
_HALF = 1 << (_MANTISSA_BITS - 1)
_LARGEST_BITS = 44
_BUCKETS = (_LARGEST_BITS - _MANTISSA_BITS + 2) * _HALF


class Histogram:
    """Counts of durations in nanoseconds, from 0 to 2^44 ns (4.9 hours), in buckets at most 1/64 wide (1.6 %).

    The buckets are those of a high-dynamic-range histogram: exact up to 127, then 64 to each power of two.
    """

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * _BUCKETS))
        self._count = 0
        self._total_ns = 0
        self._max_ns = 0

    @property
    def count(self) -> int:
        """Number of durations recorded."""
        return self._count

    @property
    def max_ns(self) -> int:
        """The longest duration, exact; 0 before the first."""
        return self._max_ns

    @property
    def mean_ns(self) -> float:
        """The mean duration, exact; NaN before the first."""
        return self._total_ns / self._count if self._count else math.nan

    def record(self, duration_ns: int) -> None:
        """Count one duration; a negative one counts as 0, one beyond the range in the last bucket."""
        duration_ns = max(duration_ns, 0)
        self._counts[min(_bucket(duration_ns), _BUCKETS - 1)] += 1
        self._count += 1
        self._total_ns += duration_ns
        self._max_ns = max(self._max_ns, duration_ns)

    def percentile_ns(self, percent: float) -> float:
        """Return the duration that `percent` of all do not exceed, at most 1.6 % too high; NaN before the first."""
        if not self._count:
            return math.nan
        # Rounded first: 99.9 % of 41000 is 40959, not the next integer above 40959.00000000001.
        wanted = max(1, math.ceil(round(percent * self._count / 100.0, 6)))
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if seen >= wanted:
                return float(min(_upper_edge_ns(bucket), self._max_ns))
        return float(self._max_ns)

    def summary_s(self) -> dict[str, float]:
        """Return p50, p99, p99.9, max and mean in seconds under the keys p50_s, p99_s, p999_s, max_s, mean_s."""
        return {
            "p50_s": self.percentile_ns(50.0) * 1e-9,
            "p99_s": self.percentile_ns(99.0) * 1e-9,
            "p999_s": self.percentile_ns(99.9) * 1e-9,
            "max_s": self._max_ns * 1e-9,
            "mean_s": self.mean_ns * 1e-9,
        }


def _bucket(value: int) -> int:
    shift = max(0, value.bit_length() - _MANTISSA_BITS)
    # Beyond the exact range the leading bit is always set, so each further power of two takes half as many buckets.
    return shift * _HALF + (value >> shift)


def _upper_edge_ns(bucket: int) -> int:
    shift = max(0, bucket // _HALF - 1)
    return ((bucket - shift * _HALF + 1) << shift) - 1
