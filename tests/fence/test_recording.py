"""A drive once round along the edge makes the fence."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries, along_line
from disco_hw.first_use.fence_drive import NoFence, fence_along

FOOTPRINT = Footprint(0.5, 0.4, 0.05)
SQUARE = np.array([[1.5, -1.5], [1.5, 1.5], [-1.5, 1.5], [-1.5, -1.5], [1.5, -1.5]])


@pytest.mark.parametrize("way", [1, -1])
def test_a_square_gives_its_outer_side_with_few_corners(way):
    poses = along_line(SQUARE[::way])
    noisy = poses + np.random.default_rng(1).normal(0.0, 0.004, poses.shape)
    polygon = fence_along(noisy, FOOTPRINT)
    assert 4 <= len(polygon) <= 16
    inside = Boundaries(FOOTPRINT, Fence(keep_in=polygon)).clearance_m(np.array([[0.0, 0.0, 0.0]]))
    assert inside[0] == pytest.approx(1.7 - 0.3, abs=0.06)


def test_a_round_way_has_no_more_corners_than_a_fence_may_have():
    angle = np.linspace(0.0, 2.0 * np.pi, 4000)
    poses = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), angle + math.pi / 2])
    polygon = fence_along(poses, FOOTPRINT)
    assert 12 < len(polygon) <= 100
    assert np.hypot(*np.array(polygon).T).max() == pytest.approx(3.2, abs=0.05)


@pytest.mark.parametrize(
    ("poses", "expected_error"),
    [
        (np.empty((0, 3)), "the log holds no poses"),
        (along_line(SQUARE[:-1]), "the path ends 3.0 m from its start"),
        (along_line(np.array([[0, 0], [2, 2], [2, 0], [0, 2], [0, 0]], float)), "crosses itself"),
        (along_line(np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0]], float)), "the path makes no fence"),
    ],
)
def test_a_way_that_makes_no_fence_is_refused(poses, expected_error):
    with pytest.raises(NoFence, match=expected_error):
        fence_along(poses, FOOTPRINT)
