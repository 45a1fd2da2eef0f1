"""How far two fits of a channel lie apart some seconds ahead: against arcs and lengths computed by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.selection import _where_most, body_moves, wheel_moves
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from tests.gap.synthetic import GEOMETRY, NOISE, line_of, vector_of

RADIUS_M, AXLE_M, X_ICR_M = *GEOMETRY[:2], -0.1


def apart_as_wheels(apart_rad, command_rad_s=None):
    """What `wheel_moves` says of wheels at 3 and 5 rad/s whose predicted angles lie so far apart, (M, 2)."""
    count = apart_rad.shape[0]
    t_s = GRID_STEP_S * np.arange(count)
    drive = SimpleNamespace(
        first=np.arange(count) == 0,
        command_rad_s=np.ones((count, 2)) if command_rad_s is None else command_rad_s,
        angle_rad=np.outer(t_s, (3.0, 5.0)),
    )
    # The vectors are the predictions themselves.
    channel = SimpleNamespace(drive=drive, settings=DEFAULT_SETTINGS, angles=lambda predicted, extra: predicted + extra)
    moves = wheel_moves(channel, np.array((RADIUS_M, AXLE_M, X_ICR_M)))
    small = np.outer(t_s, (0.7, -0.2))
    return moves((small, 1.0), (small + apart_rad, 1.0))


@pytest.mark.parametrize(("seconds", "ahead_s"), [(8.0, 2.0), (2.0, 1.0)])
def test_wheels_that_turn_further_move_the_robot_ahead_and_by_its_heading_half_the_way(seconds, ahead_s):
    t_s = GRID_STEP_S * np.arange(round(seconds / GRID_STEP_S))
    # Ahead by 0.15 and 0.25 rad/s more; half the way of 3 and 5 rad/s is a lever beside x_icr's 0.1 m.
    ahead_m, turned_rad, lever_m = 0.03 * 0.4 * ahead_s, 0.15 * 0.1 * ahead_s, 0.12 * ahead_s + 0.1
    expected = np.hypot(ahead_m, lever_m * turned_rad)
    assert apart_as_wheels(np.outer(t_s, (0.15, 0.25))) == pytest.approx(expected, rel=1e-9)


def test_wheels_are_not_compared_across_what_was_not_commanded_nor_in_a_run_that_is_too_short():
    t_s = GRID_STEP_S * np.arange(800)
    command = np.ones((800, 2))
    command[(t_s > 3.0) & (t_s < 3.2), 0] = np.nan
    jump = np.where(t_s > 3.1, 1.0, 0.0)[:, None] + np.zeros(2)
    assert apart_as_wheels(jump) > 0.05
    assert apart_as_wheels(jump, command) < 1e-12
    assert apart_as_wheels(jump[:40]) == 0.0


def test_what_is_felt_in_few_places_is_judged_there():
    squares = np.array([9.0, 1.0, 16.0, 4.0])
    assert _where_most(squares, 0.5) == pytest.approx(np.sqrt(12.5))
    assert _where_most(squares, 1.0) == pytest.approx(np.sqrt(7.5))
    assert _where_most(squares, 0.01) == 4.0


def body_at(speed_rad_s, yaw_rad=0.0, seconds=8.0):
    """The body channel of a drive at steady wheel speeds, with poses that look so all the time."""
    line = line_of(np.repeat(np.array([speed_rad_s], dtype=float), round(seconds / GRID_STEP_S), axis=0))
    poses = np.tile([1.5, 0.0, yaw_rad], (line.pose.t_s.size, 1))
    plain = vector_of(x_icr_m=X_ICR_M)
    return BodyChannel.build(replace(line, pose_values=poses), NOISE, plain), plain


def end_of_arc(vector, left_rad_s, right_rad_s, t_s):
    """Forward, left and yaw of the tracked point after so long at steady wheel speeds: the model's own integral."""
    radius_m, axle_m, x_icr_m = vector[:3]
    v, omega = 0.5 * radius_m * (left_rad_s + right_rad_s), radius_m / axle_m * (right_rad_s - left_rad_s)
    turned = omega * t_s
    along = v / omega * np.sin(turned) + x_icr_m * (1.0 - np.cos(turned))
    across = v / omega * (1.0 - np.cos(turned)) - x_icr_m * np.sin(turned)
    return np.array([along, across, turned])


def test_bodies_on_two_arcs_lie_apart_by_their_ends_and_by_their_headings_half_the_way():
    channel, small = body_at((2.0, 4.0))
    big = vector_of(wheel_radius_m=0.066, axial_distance_m=0.35, x_icr_m=0.05)
    ends = [end_of_arc(vector, 2.0, 4.0, 2.0) for vector in (small, big)]
    apart, lever_m = ends[1] - ends[0], 0.5 * np.hypot(*ends[1][:2])
    assert min(abs(apart)) > 0.02
    expected = np.sqrt(apart[0] ** 2 + apart[1] ** 2 + (lever_m * apart[2]) ** 2)
    assert body_moves(channel)((small, None), (big, None)) == pytest.approx(expected, rel=1e-3)


def test_what_drives_a_body_besides_moves_it():
    channel, plain = body_at((3.0, 3.0))
    extra = np.zeros((channel.drive.t_s.size, 3))
    extra[:, 1] = 0.02
    assert body_moves(channel)((plain, None), (plain, extra)) == pytest.approx(0.04, rel=1e-6)
    assert body_moves(channel)((plain, extra), (plain, extra)) == 0.0


def test_a_slope_moves_the_robot_to_where_it_looks_by_its_poses():
    # It looks along y, downhill: the drift adds to what a larger wheel moves it ahead, 0.003 m x 3 rad/s x 2 s.
    channel, small = body_at((3.0, 3.0), yaw_rad=0.5 * np.pi)
    big = vector_of(x_icr_m=X_ICR_M, wheel_radius_m=0.063, slope__drift_y_m_s=0.01)
    assert body_moves(channel)((small, None), (big, None)) == pytest.approx(0.018 + 0.02, rel=1e-3)


def test_a_body_in_a_run_that_is_too_short_is_not_moved():
    channel, small = body_at((3.0, 3.0), seconds=0.5)
    assert body_moves(channel)((small, None), (vector_of(x_icr_m=X_ICR_M, wheel_radius_m=0.09), None)) == 0.0
