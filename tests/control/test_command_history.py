"""Means of the commands already sent over the steps before a plan."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.control import SentCommand
from disco_hw.control.plan import command_history

MS = 1_000_000


def test_means_over_steps_oldest_first():
    sent = (SentCommand(0, 1.0, -1.0), SentCommand(150 * MS, 3.0, 0.0), SentCommand(200 * MS, 5.0, 2.0))
    means = command_history(sent, 300 * MS, 0.1, 4, (9.0, 9.0))
    np.testing.assert_allclose(means, [[1.0, -1.0], [1.0, -1.0], [2.0, -0.5], [5.0, 2.0]])


def test_a_command_sent_now_or_later_is_not_past():
    sent = (SentCommand(0, 1.0, 1.0), SentCommand(100 * MS, 4.0, 4.0), SentCommand(150 * MS, 6.0, 6.0))
    np.testing.assert_allclose(command_history(sent, 100 * MS, 0.1, 2, (9.0, 9.0)), [[1.0, 1.0], [1.0, 1.0]])


def test_without_commands_all_are_as_told():
    np.testing.assert_array_equal(command_history((), 0, 0.1, 2, (3.0, 4.0)), [[3.0, 4.0], [3.0, 4.0]])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 60), st.floats(-5, 5)), min_size=1, max_size=40), st.integers(1, 6))
def test_means_agree_with_a_fine_grid(steps, count):
    t, sent = 0, []
    for gap_ms, value in steps:
        sent.append(SentCommand(t * MS, value, -value))
        t += gap_ms
    means = command_history(tuple(sent), t * MS, 0.1, count, (0.0, 0.0))
    grid = t - count * 100 + np.arange(count * 100)
    index = np.maximum(np.searchsorted([s.t_ns // MS for s in sent], grid, side="right") - 1, 0)
    fine = np.array([s.left_rad_s for s in sent])[index].reshape(count, 100).mean(axis=1)
    np.testing.assert_allclose(means[:, 0], fine, atol=1e-9)
    np.testing.assert_allclose(means[:, 1], -fine, atol=1e-9)


def test_empty_window():
    assert command_history((SentCommand(0, 1.0, 1.0),), 100, 0.1, 0, (0.0, 0.0)).shape == (0, 2)
    assert command_history((), 100, 0.1, 0, (0.0, 0.0)) == pytest.approx(np.zeros((0, 2)))
