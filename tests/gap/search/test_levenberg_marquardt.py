"""Each step of the least squares, against what is computed by hand for residuals that are linear."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.search.least_squares import Fit, _as_promised, _carried, fit, jacobian, known
from disco_hw.gap.settings import DEFAULT_SETTINGS

FIT = DEFAULT_SETTINGS.fit
# The third entry says so little that what it is damped by is a share of what the first says.
SLOPE = np.array([[3.0, 0.2, 0.0], [0.5, 0.1, 0.0], [0.0, 0.0, 2e-7], [1.0, -0.4, 0.0]])
MEASURED = np.array([5.0, -3.0, 1.0, 4.0])


def channel(residual=lambda p: SLOPE @ p - MEASURED, precision=(0.0, 0.0, 0.0), expected=0.0, step=1.0, **settings):
    """A channel, and the vectors at which its residual is asked for."""
    asked = []

    def counted(p):
        asked.append(p.copy())
        return residual(p)

    size = len(precision)
    layout = SimpleNamespace(
        step=np.full(size, step), low=np.full(size, -1e12), high=np.full(size, 1e12), neutral=np.full(size, expected),
        precision=np.array(precision),
    )  # fmt: skip
    chosen = SimpleNamespace(fit=replace(FIT, **settings))
    return SimpleNamespace(settings=chosen, layout=layout, residual=counted), asked


def stepped(vector, damping, precision=(0.0, 0.0, 0.0), expected=0.0):
    """Where Marquardt's step from a vector leads."""
    normal = SLOPE.T @ SLOPE + np.diag(precision)
    gradient = SLOPE.T @ (SLOPE @ vector - MEASURED) + np.array(precision) * (vector - expected)
    damped = np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max())
    return vector - np.linalg.solve(normal + damping * np.diag(damped), gradient)


@pytest.mark.parametrize("precision", [(0.0, 0.0, 0.0), (0.5, 2.0, 0.0)])
def test_steps_are_damped_by_a_share_of_what_each_entry_says_that_falls_as_they_succeed(precision):
    line, asked = channel(precision=precision, expected=0.7)
    vector = np.array([1.0, 2.0, 3.0])
    for steps, damping in enumerate((1e-3, 1e-4, 1e-5), start=1):
        vector = stepped(vector, damping, precision, 0.7)
        found = fit(line, np.array([1.0, 2.0, 3.0]), (0, 1, 2), steps)
        np.testing.assert_allclose(found.vector, vector, rtol=1e-7)
        left = SLOPE @ found.vector - MEASURED
        assert found.cost == pytest.approx(0.5 * left @ left, rel=1e-12)
    assert not found.loose
    assert not found.carried
    asked.clear()
    # As many as nobody asks for, and none of nothing.
    assert fit(line, vector, ()).vector is not vector
    assert len(asked) == 1


def test_six_shorter_steps_are_tried_each_damped_ten_times_as_much_and_then_it_is_over():
    # It falls where the derivative looks, and is as high as at the beginning everywhere else.
    def residual(p):
        return np.array([1.0 - p[0] if abs(p[0]) <= 0.0011 else 1.0])

    bent, asked = channel(residual, (0.0,), step=0.001)
    found = fit(bent, np.zeros(1), (0,))
    assert found.vector.tolist() == [0.0]
    steps = [1.0 / (1.0 + 1e-3 * 10.0**k) for k in range(6)]
    assert np.concatenate(asked) == pytest.approx([0.0, 0.001, *steps], rel=1e-9)


def line_of_gain(nats, of_prior=False, **settings):
    """A line, or what is expected, that is so many nats from its best fit at 0."""
    size = np.sqrt(2.0 * nats)
    if of_prior:
        return channel(lambda p: np.zeros(1), (nats * 2.0 / 3.0**2,), expected=3.0, **settings)
    return channel(lambda p: p - size, (0.0,), **settings)


@pytest.mark.parametrize("of_prior", [False, True])
@pytest.mark.parametrize(("share", "steps"), [(0.9, 1), (1.1, 2)])
def test_a_step_that_gains_too_little_is_the_last(of_prior, share, steps):
    some, asked = line_of_gain(share * FIT.enough_nats, of_prior)
    fit(some, np.zeros(1), (0,))
    # The start, a derivative and a trial for every step.
    assert len(asked) == 1 + 2 * steps


def test_a_step_that_gains_just_enough_is_not_the_last():
    some, _ = line_of_gain(1.0)
    gain = 0.5 * float(np.sqrt(2.0) ** 2) - fit(some, np.zeros(1), (0,), 1).cost
    for enough, steps in ((gain, 2), (np.nextafter(gain, 9.0), 1)):
        some, asked = line_of_gain(1.0, enough_nats=enough)
        fit(some, np.zeros(1), (0,))
        assert len(asked) == 1 + 2 * steps


def test_derivatives_that_were_taken_along_and_lead_nowhere_are_taken_anew_and_steps_as_at_the_beginning():
    line, asked = channel()
    start = np.array([1.0, 2.0, 3.0])
    astray = Fit(start, (0, 1, 2), 0.0, SLOPE @ start - MEASURED, -SLOPE, loose=True, carried=True)
    fit(line, astray, (0, 1, 2), 2, loose=True)
    # Six trials that lead away, a derivative, and a trial.
    assert len(asked) == 6 + 3 + 1
    np.testing.assert_allclose(asked[-1], stepped(start, 1e-3), rtol=1e-7)


def test_a_step_keeps_its_promise_where_it_gains_what_it_should_within_a_share():
    slope, step = np.array([-8.0, 1.0]), np.array([1.0, 2.0])
    normal = np.array([[2.0, 0.5], [0.5, 1.0]])
    # 6 nats by the slope, less 4 by the bend.
    for gained, kept in ((2.0, True), (1.6, True), (2.4, True), (1.5, False), (2.5, False), (1.4, False), (2.6, False)):
        assert _as_promised(gained, slope, normal, step, FIT) is kept
    assert FIT.promised_share == 0.25


def test_derivatives_taken_along_give_the_change_of_a_step_and_are_as_before_across_it():
    slope, step, scale = SLOPE[:, :2], np.array([0.5, -2.0]), np.array([4.0, 3.0])
    change = np.array([1.0, 2.0, -3.0, 0.5])
    moved = _carried(slope, step, change, scale)
    np.testing.assert_allclose(moved @ step, change)
    across = np.array([6.0, 2.0])
    assert across @ (scale * step) == 0.0
    np.testing.assert_allclose(moved @ across, slope @ across, atol=1e-12)


def test_what_a_part_knows_is_more_than_a_share_of_what_the_whole_does():
    settings = replace(FIT, least_known_share=0.25)
    part, whole = np.diag([1.0, 1.1, 0.9, 0.0]), np.diag([4.0, 4.0, 4.0, 0.0])
    assert known(part, whole, settings).tolist() == [False, True, False, False]


def test_a_derivative_looks_ahead_up_to_the_bound_and_else_back():
    asked = []
    layout = SimpleNamespace(step=np.array([0.5]), high=np.array([1.0]))
    for at in (0.5, 0.6):
        jacobian(lambda p: asked.append(p[0]) or p, np.array([at]), (0,), layout, np.array([at]))
    assert asked == pytest.approx([1.0, 0.1])
