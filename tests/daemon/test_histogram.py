import math

import pytest
from hypothesis import strategies as st

from disco_hw.daemon.loop import Histogram
from tests.tables import examples

DURATIONS_NS = st.integers(0, 2**44 - 1) | st.integers(0, 300) | st.integers(0, 44).map(lambda bits: (1 << bits) - 1)
DURATIONS = st.lists(DURATIONS_NS, min_size=1, max_size=200)


def filled(durations_ns):
    histogram = Histogram()
    for duration_ns in durations_ns:
        histogram.record(duration_ns)
    return histogram


@examples(quick=40, every=100, durations_ns=DURATIONS, per_mille=st.integers(0, 1000))
def test_percentiles_are_those_of_the_data_and_at_most_one_64th_too_high(durations_ns, per_mille):
    rank = max(1, -(-per_mille * len(durations_ns) // 1000))
    exact_ns = sorted(durations_ns)[rank - 1]
    assert exact_ns <= filled(durations_ns).percentile_ns(per_mille / 10) <= exact_ns * (1 + 1 / 64)


@examples(quick=40, every=100, durations_ns=DURATIONS)
def test_mean_and_maximum_are_exact(durations_ns):
    summary = filled(durations_ns).summary_s()
    assert summary["mean_s"] == pytest.approx(sum(durations_ns) * 1e-9 / len(durations_ns))
    assert summary["max_s"] == max(durations_ns) * 1e-9
    assert filled(durations_ns).percentile_ns(100.0) == max(durations_ns)


def test_what_is_negative_counts_as_nothing_and_what_is_longest_is_exact():
    histogram = filled([-5, 2**60])
    assert histogram.percentile_ns(50.0) == 0.0
    assert histogram.percentile_ns(100.0) == 2**60
    assert histogram.summary_s()["max_s"] == 2**60 * 1e-9


def test_an_empty_histogram_says_that_it_knows_nothing():
    summary = Histogram().summary_s()
    assert math.isnan(summary["p99_s"])
    assert math.isnan(summary["mean_s"])


def test_summary_is_in_seconds():
    summary = filled([1_000_000] * 999 + [5_000_000]).summary_s()
    assert summary["p50_s"] == pytest.approx(0.001, rel=1 / 64)
    assert summary["p999_s"] == pytest.approx(0.001, rel=1 / 64)
    assert summary["max_s"] == 0.005
    assert summary["mean_s"] == pytest.approx(0.001004)


def test_recording_keeps_64_counts_for_each_power_of_two_at_most():
    histogram = filled(range(2**10, 2**14))
    assert len(histogram._counts) == 4 * 64


def test_a_percentile_at_the_edge_is_not_pushed_over_by_rounding():
    # 99.9 % of 41 000 is 40 959, though 99.9 * 41000 / 100 is a little more in binary.
    assert filled([1] * 40_959 + [100] * 41).percentile_ns(99.9) == 1.0
