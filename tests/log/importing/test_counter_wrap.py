"""Counters that wrap, in all widths and directions, against the counts that they were made of."""

import math

import numpy as np
import pytest

from disco_hw.log.importing.counter_wrap import restarts, unwrap_counter

DT_S = 0.02
T_S = DT_S * np.arange(1500)


def to_and_fro(largest_step):
    """Counts of a wheel that speeds up, drives, brakes, stands and comes back twice as far."""
    speed = np.concatenate([np.linspace(0, 1, 100), np.ones(400), np.linspace(1, 0, 50), np.zeros(100), -np.ones(850)])
    return np.round(np.cumsum(largest_step * speed))


def wrapped(counts, span, is_signed=False):
    return (counts + span / 2) % span - span / 2 if is_signed else counts % span


def unwrap(t_s, values, spans=(), unit="counts"):
    """The counter made continuous where nothing is known of segments and speeds."""
    return unwrap_counter(t_s, values, spans, np.zeros(t_s.size, dtype=bool), np.full(t_s.size, np.nan), unit)


def moved(counts):
    return counts - counts[0]


@pytest.mark.parametrize("is_signed", [True, False])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("span", [2**8, 2**10, 2**16, 2**32, 10_000, 2048, 4000, 1000])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.2])
def test_a_counter_that_wraps_is_made_continuous(span, share, direction, is_signed):
    counts = direction * to_and_fro(share * span)
    found = unwrap(T_S, wrapped(counts, span, is_signed), (2048.0,))
    assert found.fault == ""
    assert found.span == pytest.approx(span, rel=1e-3)
    np.testing.assert_allclose(moved(found.values), moved(counts), atol=0.02 * span)


@pytest.mark.parametrize("span", [2**8, 2**16])
def test_gaps_are_bridged_as_far_as_the_motion_shows(span):
    counts = to_and_fro(0.05 * span)
    rows = np.delete(np.arange(T_S.size), [*range(200, 206), 300, 301, 302, *range(1000, 1008)])
    found = unwrap(T_S[rows], wrapped(counts, span)[rows])
    np.testing.assert_array_equal(moved(found.values), moved(counts[rows]))


@pytest.mark.parametrize("noise", [-1, 1])
def test_a_counter_that_stands_at_its_boundary_counts_nothing(noise):
    counts = np.where(np.arange(T_S.size) % 2, noise, 0.0)
    counts[700:] += np.arange(T_S.size - 700)
    found = unwrap(T_S, wrapped(counts, 256))
    np.testing.assert_array_equal(moved(found.values), moved(counts))


@pytest.mark.parametrize(
    "counts",
    [
        np.where(T_S < 10.0, 40.0, 0.0) * 50 + np.round(T_S * 100) % 1000,
        np.concatenate([np.arange(750.0), np.arange(750.0)]),
        np.concatenate([np.arange(500.0), np.arange(200.0), np.arange(800.0)]),
        3.0 * np.arange(1500.0),
        np.where(np.arange(1500) < 700, 0.0, 5000.0),
        np.zeros(1500),
        np.where(np.arange(1500) == 700, 60_000.0, np.arange(1500.0)),
    ],
    ids=["offset", "reset", "resets at other counts", "line", "one leap", "standing", "outlier"],
)
def test_what_does_not_wrap_stays_to_the_last_bit(counts):
    found = unwrap(T_S, counts)
    if found.wraps:
        pytest.fail(f"{found.wraps} wraps at {found.span}")
    np.testing.assert_array_equal(found.values, counts)
    assert found.fault == ""


def test_a_reset_among_wraps_stays_a_jump():
    counts = to_and_fro(20.0)
    with_reset = wrapped(np.where(np.arange(T_S.size) < 400, counts, counts - counts[400]), 1024)
    found = unwrap(T_S, with_reset)
    assert found.span == 1024
    np.testing.assert_array_equal(moved(found.values[:400]), moved(counts[:400]))
    steps, true_steps = np.diff(found.values), np.diff(counts)
    assert np.flatnonzero(steps != true_steps).tolist() in ([399], [])


@pytest.mark.parametrize("span", [256, 1024])
def test_a_counter_that_wraps_faster_than_it_is_read_is_refused(span):
    counts = np.round(np.cumsum(span * (0.45 + 0.3 * np.sin(T_S))))
    assert "wraps faster than it is read" in unwrap(T_S, wrapped(counts, span)).fault


def test_angles_within_one_turn_are_made_continuous():
    angles = np.cumsum(0.3 * np.sin(0.5 * T_S))
    found = unwrap(T_S, wrapped(angles, 2 * math.pi, is_signed=True), (2 * math.pi,), unit="rad")
    np.testing.assert_allclose(moved(found.values), moved(angles), atol=1e-9)


def test_an_encoder_of_few_ticks_shows_no_wrap_and_no_reset():
    counts = np.round(np.cumsum(np.full(T_S.size, 0.07)))
    assert unwrap(T_S, counts, (12.0,)).wraps == 0
    angles = counts * 2.0 * math.pi / 12.0
    assert not restarts(T_S, np.column_stack([angles, angles])).any()


@pytest.mark.parametrize("size", [0, 1, 2, 5])
def test_few_samples_stay_as_they_are(size):
    counts = np.arange(float(size)) * 100.0
    assert unwrap(T_S[:size], counts).values.tolist() == counts.tolist()
    assert not restarts(T_S[:size], np.column_stack([counts, counts])[:, :2] * 0.0).any()
