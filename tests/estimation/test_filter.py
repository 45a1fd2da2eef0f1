"""Initialisation, gate and recovery from lock-out, one state transition at a time."""

import math

import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation.correction import Measurement, PoseReason, gate_limit
from disco_hw.estimation.filter import HeadingSearch, PoseFilter
from disco_hw.estimation.odometry import OdometryParameters, Pose, WheelReading, advance
from disco_hw.model.drift import Drift

PARAMETERS = OdometryParameters(0.061, 0.415, 0.238)
SETTINGS = Estimation(gate_lockout_count=5)
STEP_NS = 40_000_000


def measured(t_ns, x, y, yaw, std=0.01):
    return Measurement(t_ns, Pose(x, y, yaw), std**2, (2 * std) ** 2, False)


def started(settings=SETTINGS):
    pose_filter = PoseFilter(settings, PARAMETERS)
    return pose_filter, pose_filter.begin(WheelReading(0, 0.0, 0.0, 0.0, 0.0))


def initialised(settings=SETTINGS):
    pose_filter, state = started(settings)
    return pose_filter, pose_filter.fuse(state, measured(0, 0.0, 0.0, 0.0))


def reasons_of(pose_filter, state, poses):
    """Feed poses STEP_NS apart without motion."""
    reasons = []
    for pose in poses:
        t_ns = state.t_ns + STEP_NS
        state = pose_filter.move(state, t_ns, state.left_rad, state.right_rad, False)
        state = pose_filter.fuse(state, measured(t_ns, *pose))
        reasons.append(state.evaluation.reason)
    return state, reasons


def test_the_first_pose_sets_the_belief():
    pose_filter, state = started()
    assert state.belief is None
    state = pose_filter.fuse(state, measured(0, 3.0, 4.0, 2.0))
    assert state.evaluation.reason is PoseReason.INITIALISED
    assert state.belief.pose == Pose(3.0, 4.0, 2.0)
    np.testing.assert_allclose(state.belief.covariance, np.diag([1e-4, 1e-4, 4e-4]))
    assert (state.pose_t_ns, state.reinitialisations) == (0, 0)


def test_where_no_pose_is_required_odometry_starts_at_the_origin_until_the_first_pose():
    pose_filter, state = started(Estimation(pose_required=False))
    np.testing.assert_allclose(state.belief.covariance, 1e-6 * np.eye(3), rtol=1e-9)
    state = pose_filter.move(state, 10**9, 10.0, 10.0, False)
    assert state.belief.x_m == pytest.approx(0.61)
    assert state.pose_t_ns is None
    state = pose_filter.fuse(state, measured(10**9, 5.0, 5.0, 1.0))
    assert state.evaluation.reason is PoseReason.INITIALISED
    assert state.belief.pose == Pose(5.0, 5.0, 1.0)
    assert state.reinitialisations == 1


def test_a_first_pose_to_which_odometry_from_the_origin_has_led_is_no_jump():
    pose_filter, state = started(Estimation(pose_required=False))
    state = pose_filter.fuse(state, measured(0, 0.005, 0.005, 0.01))
    assert (state.evaluation.reason, state.reinitialisations) == (PoseReason.INITIALISED, 0)


def test_the_first_pose_of_a_sensor_that_is_mounted_aside_sets_the_robot_beside_it():
    pose_filter, state = started()
    # Heading along y: what is ahead lies at larger y, what is to the left at smaller x.
    aside = Measurement(0, Pose(1.0, 2.0, 0.5 * math.pi), 1e-4, 4e-4, False, 0.3, -0.2)
    belief = pose_filter.fuse(state, aside).belief
    assert (belief.x_m, belief.y_m, belief.yaw_rad) == pytest.approx((1.0 - 0.2, 2.0 - 0.3, 0.5 * math.pi))


def test_the_gate_opens_at_its_limit():
    pose_filter, state = initialised()
    # S = 2e-4 in x: d^2 = dx^2 / 2e-4.
    edge = math.sqrt(gate_limit(0.999) * 2e-4)
    inside = pose_filter.fuse(state, measured(0, 0.999 * edge, 0.0, 0.0))
    outside = pose_filter.fuse(state, measured(0, 1.001 * edge, 0.0, 0.0))
    assert inside.evaluation.reason is PoseReason.ACCEPTED
    assert inside.evaluation.test_ratio == pytest.approx(0.999**2, rel=1e-4)
    assert outside.evaluation.reason is PoseReason.GATED
    assert outside.evaluation.test_ratio == pytest.approx(1.001**2, rel=1e-4)
    assert outside.evaluation.distance2 == pytest.approx(1.001**2 * gate_limit(0.999), rel=1e-4)
    assert outside.belief == state.belief
    assert outside.pose_t_ns == 0


@pytest.mark.parametrize(("std_rad", "is_known"), [(0.29, True), (0.31, False)])
def test_a_heading_is_known_up_to_a_standard_deviation_of_0_3_rad(std_rad, is_known):
    pose_filter, state = started()
    found = pose_filter.fuse(state, Measurement(0, Pose(0.0, 0.0, 0.0), 1e-4, std_rad**2, False))
    assert (found.heading_known, isinstance(found.belief, HeadingSearch)) == (is_known, not is_known)


def test_a_heading_is_forgotten_where_the_wheels_turn_the_robot_unmeasured():
    pose_filter, state = initialised()
    spins = WheelReading(0, 0.0, 0.0, -5.0, 5.0)
    assert pose_filter.extrapolate(state, spins, 200_000_000).heading_known
    assert not pose_filter.extrapolate(state, spins, 2 * 10**9).heading_known


def test_of_each_source_the_last_accepted_stamp_is_kept():
    pose_filter, state = initialised()
    for t_ns, source in ((1, 1), (2, 0), (3, 1)):
        state = pose_filter.fuse(state, Measurement(t_ns, Pose(0.0, 0.0, 0.0), 1e-4, 4e-4, False, source=source))
    assert dict(state.accepted) == {0: 2, 1: 3}
    assert len(state.accepted) == 2


def test_for_a_position_alone_the_gate_is_that_of_two_numbers():
    pose_filter, state = initialised()
    # Chi-square with two degrees of freedom exceeds -2 ln(0.001) once in a thousand times.
    edge = math.sqrt(-2.0 * math.log(0.001) * 2e-4)
    for part, reason in ((0.999, PoseReason.ACCEPTED), (1.001, PoseReason.GATED)):
        place = Measurement(0, Pose(part * edge, 0.0, 0.0), 1e-4, None, False)
        assert pose_filter.fuse(state, place).evaluation.reason is reason


def test_outliers_that_disagree_never_move_the_belief():
    pose_filter, state = initialised()
    outliers = [(0.5 * (i % 7) + 0.4, (-1) ** i * 0.8, 0.3 * i) for i in range(40)]
    after, reasons = reasons_of(pose_filter, state, outliers)
    assert set(reasons) == {PoseReason.GATED}
    assert after.belief == state.belief
    assert after.candidate_count == 1


AGREED, JUMPED, STRAY = (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        (([JUMPED] * 4 + [AGREED]) * 2, ([PoseReason.GATED] * 4 + [PoseReason.ACCEPTED]) * 2),
        ([JUMPED] * 4 + [STRAY] + [JUMPED] * 5, [PoseReason.GATED] * 9 + [PoseReason.REINITIALISED]),
    ],
    ids=["a pose in between that agrees with the belief", "an outlier in between that disagrees"],
)
def test_fewer_agreeing_outliers_in_a_row_than_the_count_do_not_move_the_belief(poses, expected):
    assert reasons_of(*initialised(), poses)[1] == expected


def test_agreeing_outliers_in_a_row_move_it_to_where_they_are():
    pose_filter, state = initialised()
    rng = np.random.default_rng(0)
    poses = [(0.5 + dx, dy, dyaw) for dx, dy, dyaw in rng.normal(size=(5, 3)) * (0.01, 0.01, 0.02)]
    after, reasons = reasons_of(pose_filter, state, poses)
    assert reasons == [PoseReason.GATED] * 4 + [PoseReason.REINITIALISED]
    assert after.reinitialisations == 1
    assert after.candidate is None
    assert after.evaluation.test_ratio > 1.0
    # At the mean of the five, which is better than any one of them.
    np.testing.assert_allclose([after.belief.x_m, after.belief.y_m], np.mean(poses, axis=0)[:2], atol=1e-4)
    assert math.sqrt(after.belief.xx) == pytest.approx(0.01 / math.sqrt(5), rel=0.01)


def test_agreement_is_judged_with_the_motion_in_between():
    # Driving at 0.3 m/s the rejected poses move 12 mm a step: those that move along agree, those that stand do not.
    def last_reason(follow):
        pose_filter, state = initialised()
        pose = Pose(0.0, 1.0, 0.0)
        for i in range(1, 6):
            turn = 0.3 / 0.061 * 0.04 * i * 10
            pose = advance(PARAMETERS, pose, [(0.3 / 0.061, 0.3 / 0.061, 0.4)]) if follow else pose
            state = pose_filter.move(state, i * STEP_NS, turn, turn, False)
            state = pose_filter.fuse(state, measured(i * STEP_NS, pose.x_m, pose.y_m, 0.0))
        return state.evaluation.reason

    assert last_reason(follow=True) is PoseReason.REINITIALISED
    assert last_reason(follow=False) is PoseReason.GATED


def test_standing_wheels_leave_the_belief_as_it_is():
    pose_filter, state = initialised()
    assert pose_filter.move(state, 10**9, 0.0, 0.0, False).belief is state.belief


def test_a_gap_keeps_the_distance_and_opens_the_covariance_by_a_quarter_of_it():
    pose_filter, state = initialised()
    turn = 2.0 / 0.061
    known = pose_filter.move(state, 10**9, turn, turn, False).belief
    gap = pose_filter.move(state, 10**9, turn, turn, True).belief
    assert gap.pose == known.pose == Pose(pytest.approx(2.0), 0.0, 0.0)
    np.testing.assert_allclose(np.array(gap.covariance) - known.covariance, np.diag([0.25, 0.25, 0.0]), atol=1e-12)


def test_extrapolation_keeps_the_speed_for_a_bounded_time_and_doubts_it_for_longer():
    pose_filter, state = initialised()
    wheels = WheelReading(0, 0.0, 0.0, 5.0, 6.0)
    near = pose_filter.extrapolate(state, wheels, 100_000_000)
    expected = advance(PARAMETERS, Pose(0.0, 0.0, 0.0), [(5.0, 6.0, 0.1)])
    assert (near.belief.x_m, near.belief.yaw_rad) == pytest.approx((expected.x_m, expected.yaw_rad))
    current = pose_filter.extrapolate(state, wheels, 200_000_000)
    later = pose_filter.extrapolate(state, wheels, 2 * 10**9)
    assert later.belief.pose == current.belief.pose
    # Without the slip of the moved part, a quarter of all the path there may have been: 0.061 * 5.5 * 2 s.
    assert math.sqrt(later.belief.xx) == pytest.approx(0.25 * 0.061 * 5.5 * 2.0, rel=0.02)
    assert math.sqrt(later.belief.tt) == pytest.approx(0.25 * 0.061 / 0.415 * math.hypot(5.0, 6.0) * 2.0, rel=0.02)


def test_extrapolating_in_two_steps_adds_no_doubt():
    pose_filter, state = initialised()
    wheels = WheelReading(0, 0.0, 0.0, 5.0, 5.0)
    in_one_step = pose_filter.extrapolate(state, wheels, 10**9)
    in_two_steps = pose_filter.extrapolate(pose_filter.extrapolate(state, wheels, 150_000_000), wheels, 10**9)
    assert (in_two_steps.left_rad, in_two_steps.t_ns) == (in_one_step.left_rad, in_one_step.t_ns)
    np.testing.assert_allclose(np.array(in_two_steps.belief.covariance)[0, 0], in_one_step.belief.xx, rtol=1e-9)


@pytest.mark.parametrize("speeds_rad_s", [(4.0, 4.0), (-3.0, 3.5), (0.0, 0.0)], ids=["straight", "turning", "standing"])
def test_the_ground_carries_a_robot_whose_wheels_turn(speeds_rad_s):
    pose_filter, state = started()
    state = pose_filter.fuse(state, measured(0, 0.0, 0.0, 0.7))
    drift_m_s, period_s = np.array([0.1, -0.05]), 0.01
    pose_filter.drift = Drift(*drift_m_s.tolist())
    expected, pose = np.zeros(2), state.belief.pose
    for step in range(1, 101):
        turned = [speed * period_s * step for speed in speeds_rad_s]
        state = pose_filter.move(state, step * 10_000_000, *turned, False)
        after = advance(PARAMETERS, pose, [(*speeds_rad_s, period_s)])
        carried = drift_m_s * period_s if any(speeds_rad_s) else 0.0
        expected += np.array([after.x_m - pose.x_m, after.y_m - pose.y_m]) + carried
        pose = after
    np.testing.assert_allclose([state.belief.x_m, state.belief.y_m], expected, atol=1e-3)
    assert state.belief.yaw_rad == pytest.approx(pose.yaw_rad)
