"""A circle by RTK positions without heading, and by datagrams that get lost: whole drives in simulated time."""

import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import load_setup
from tests.runtime.pose_drives import ROBOT, RTK, UDP, drive_circle, with_circle


@pytest.fixture(scope="module")
def driven():
    setup = with_circle(load_setup(SHIPPED_ROBOT), 3.0, 0.5)
    planner = create_planner(setup.config, setup.model)
    return lambda kind, seeds: [drive_circle(setup, planner, kind, seed) for seed in seeds]


def rms_mm(drives):
    return 1e3 * float(np.sqrt(np.mean([drive.rms_m**2 for drive in drives])))


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_circle_by_positions_without_heading(driven):
    drives = driven(RTK, range(1, 9))
    assert rms_mm(drives) <= 60.0
    # Eight robots, each with one geometry for all of its looks: their means count, not the looks.
    assert 2.0 < np.mean([drive.nees for drive in drives]) < 4.0
    assert max(drive.straight_m for drive in drives) < 1.0


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_datagrams_that_are_late_lost_and_wrong_cost_less_than_a_fifth(driven):
    assert rms_mm(driven(UDP, range(1, 9))) <= 1.2 * rms_mm(driven(ROBOT, range(1, 9)))
