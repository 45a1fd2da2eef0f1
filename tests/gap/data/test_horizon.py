"""Displacements ahead in the frame of the start."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import BODY, carried
from disco_hw.gap.data.free_runs import displacement, starts_as_far_as, starts_of
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from tests.gap.synthetic import vector_of

N = 1000
ONE_RUN = np.arange(N) == 0
STILL = np.zeros((N, 2))


def test_a_circle_looks_the_same_from_everywhere():
    t = np.arange(N) * GRID_STEP_S
    track = np.column_stack([np.sin(0.5 * t), 1.0 - np.cos(0.5 * t), 0.5 * t])
    start = np.array([100, 300, 600])
    moved = displacement(BODY.neutral, ONE_RUN, track, STILL, start, track[start, 2], 2.0)
    np.testing.assert_allclose(moved, np.tile([np.sin(1.0), 1.0 - np.cos(1.0), 1.0], (3, 1)), atol=1e-9)


def test_latency_shows_what_was_and_drift_adds_in_the_world():
    t = np.arange(N) * GRID_STEP_S
    track = np.column_stack([0.5 * t**2, np.zeros(N), np.zeros(N)])
    late = vector_of(pose_latency=0.1)
    start = np.array([300])
    sooner, later = (
        displacement(p, ONE_RUN, track, STILL, start, np.zeros(1), 1.0)[0, 0] for p in (BODY.neutral, late)
    )
    assert sooner - later == pytest.approx(0.1, abs=1e-6)
    laid = displacement(late, ONE_RUN, track, STILL, start, np.zeros(1), 1.0, 0.1)[0, 0]
    assert laid == pytest.approx(sooner, abs=1e-9)
    ground = np.column_stack([np.zeros(N), 0.02 * t])
    carried_there, plain = (
        displacement(BODY.neutral, ONE_RUN, track, on, start, np.full(1, np.pi / 2), 1.0)[0] for on in (ground, STILL)
    )
    np.testing.assert_allclose(carried_there - plain, [0.02, 0.0, 0.0], atol=1e-9)


def test_a_slope_carries_a_robot_while_its_wheels_turn_and_a_slide_as_far_as_it_turns():
    speed = np.concatenate([np.zeros((500, 2)), np.full((200, 2), 5.0), np.tile([-5.0, 5.0], (300, 1))])
    t_s = np.arange(N) * GRID_STEP_S
    np.testing.assert_array_equal(carried(BODY.neutral, speed, t_s), STILL)
    sloping = {"slope__drift_x_m_s": 0.02, "slope__drift_y_m_s": -0.01, "downhill_slide__slide_y_m": 0.1}
    ground = carried(vector_of(wheel_radius_m=0.1, axial_distance_m=0.5, **sloping), speed, t_s)
    np.testing.assert_array_equal(ground[499], [0.0, 0.0])
    straight_s, turning_s = 200 * GRID_STEP_S, 300 * GRID_STEP_S
    np.testing.assert_allclose(ground[699], [0.02 * straight_s, -0.01 * straight_s], rtol=1e-9)
    # Turning at 0.1 / 0.5 * 10 rad/s.
    moved = ground[-1] - ground[699]
    np.testing.assert_allclose(moved, [0.02 * turning_s, (-0.01 + 0.1 * 2.0) * turning_s], rtol=1e-9)


@pytest.mark.parametrize("latency_s", [-0.3, -0.04, 0.0, 0.3, 1.5])
def test_a_latency_does_not_look_into_another_run(latency_s):
    """Where each run begins anew from 0, and the next ones are driven the other way."""
    first = np.arange(N) % 250 == 0
    track = np.column_stack([0.005 * (np.arange(N) % 250), np.zeros(N), np.zeros(N)])
    track[250:500, 0] *= -1.0
    start = starts_of(first, np.ones(N, bool), 1.0, replace(DEFAULT_SETTINGS.grid, start_every_s=0.01))
    assert start.max() + 102 == N
    moved = displacement(vector_of(pose_latency=latency_s), first, track, STILL, start, np.zeros(start.size), 1.0)[:, 0]
    # Before a run begins nothing is known: a pose that is so late sees the robot stand.
    expected = 0.5 - 0.5 * np.maximum(latency_s - (start % 250) * GRID_STEP_S, 0.0)
    expected[start // 250 == 1] *= -1.0
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_starts_stay_within_runs_and_on_known_nodes():
    first = np.zeros(N, bool)
    first[[0, 500]] = True
    usable = np.ones(N, bool)
    usable[250] = False
    start = starts_of(first, usable, 1.0, DEFAULT_SETTINGS.grid)
    ends = start + 100
    assert np.all((start < 500) == (ends < 500))
    assert not np.any((start <= 250) & (ends >= 250))


@pytest.mark.parametrize(("run_s", "ahead_s", "starts"), [(2.0, 1.0, 3), (2.0, 0.5, 5), (2.0, 2.0, 0), (10.0, 1.0, 40)])
def test_of_a_short_run_a_quarter_is_spent_before_predictions_begin(run_s, ahead_s, starts):
    cells = round(run_s / GRID_STEP_S)
    first = np.arange(3 * cells) % cells == 0
    found = starts_of(first, np.ones(3 * cells, bool), ahead_s, DEFAULT_SETTINGS.grid)
    assert found.size == 3 * starts
    if starts:
        assert found[0] == min(cells / 4, 100)


@pytest.mark.parametrize(("run_s", "reached_s"), [(10.0, 2.0), (2.0, 1.0), (1.0, 0.5), (0.3, 0.5)])
def test_what_an_effect_moves_is_judged_as_far_ahead_as_runs_are_long(run_s, reached_s):
    cells = round(run_s / GRID_STEP_S)
    first = np.arange(3 * cells) % cells == 0
    start, ahead_s = starts_as_far_as(first, np.ones(3 * cells, bool), 2.0, DEFAULT_SETTINGS.grid)
    assert ahead_s == reached_s
    assert bool(start.size) == (run_s > reached_s)
