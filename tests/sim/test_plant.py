"""The whole chain: channels stay apart, nothing depends on how time is cut, known motions come out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.body_dynamics import BodyPose
from sim.effects import EFFECTS, hidden_effects
from sim.plant import CELLS, Disturbances, Plant
from sim.plant_parameters import PlantParameters

NOISY = PlantParameters()
NOISELESS = NOISY.noiseless()
IDEAL = NOISELESS.with_ideal_motors()

# Straight, both turns, a slow reverse, a rest, a fast spin: two seconds in which every effect can show.
DRIVE = ((5.0, 5.0), (6.5, 2.0), (2.0, 6.5), (-0.4, -1.0), (0.0, 0.0), (-7.0, 7.0), (3.0, 4.0))
SIZES = {name: [value.realistic[1] for value in spec.values] for name, spec in EFFECTS.items()}
SIZES["surface_change"] = [0.15, 0.5, 0.04]
SIZES["x_carpet_patch"] = [0.2, 0.0, 0.0, 1.0]
SIZES["slope"] = [0.02, 0.5]
SIZES["speed_limit"] = [5.0]


def recorded(parameters=NOISY, seed=3, drive=DRIVE, **effects):
    """Drive; return per-step wheel speeds, ticks, true poses, and the poses that were measured."""
    plant = Plant(parameters, hidden_effects(effects), seed)
    speeds, ticks, truth, poses = [], [], [], []
    for left, right in drive:
        for _ in range(120):
            poses += plant.step(plant.now_us + 1000, left, right)
            state = plant.truth
            speeds.append((state.left_speed_rad_s, state.right_speed_rad_s))
            ticks.append(plant.encoder_ticks)
            truth.append((state.x_m, state.y_m, state.yaw_rad))
    return np.array(speeds), np.array(ticks), np.array(truth), poses


def is_same(one, other):
    """Whether wheel speeds, ticks, true poses and measured poses of two drives are bit-identical."""
    return (*(np.array_equal(a, b) for a, b in zip(one[:3], other[:3], strict=True)), one[3] == other[3])


@pytest.fixture(scope="module")
def baseline():
    return recorded()


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_shows_in_its_own_channel_and_leaves_what_comes_before_bit_identical(name, baseline):
    same = is_same(recorded(**{name: SIZES[name]}), baseline)
    if name == "encoder_scale":
        assert same == (True, False, True, True)
    elif EFFECTS[name].channel == "command_to_wheel":
        assert (same[0], same[2]) == (False, False)
    elif EFFECTS[name].channel == "wheel_to_body":
        assert same == (True, True, False, False)
    else:
        assert same == (True, True, True, False)


def test_effects_of_size_nothing_leave_the_trajectory_bit_identical(baseline):
    nothing = {
        name: [0.0 if math.isinf(value.neutral) and value.name == "time_s" else value.neutral for value in spec.values]
        for name, spec in EFFECTS.items()
        if not math.isinf(spec.values[0].neutral) and name != "motor_lag"
    }
    assert is_same(recorded(**nothing), baseline) == (True, True, True, True)


def test_pose_latency_shifts_the_measured_path_by_itself_and_keeps_stamps():
    prompt, delayed = recorded(NOISELESS)[3], recorded(NOISELESS, pose_latency=0.12)[3]
    for now, then in zip(delayed[3:], prompt, strict=False):
        assert now.sample_us - then.sample_us == 120_000
        assert (now.x_m, now.y_m, now.yaw_rad) == (then.x_m, then.y_m, then.yaw_rad)
    prompt, delayed = recorded(NOISY)[3], recorded(NOISY, pose_latency=0.04)[3]
    assert [(m.sample_us, m.available_us) for m in prompt] == [(m.sample_us, m.available_us) for m in delayed]


@pytest.mark.parametrize("delay_s", [0.04, 0.0403])
def test_a_delayed_command_takes_effect_exactly_then(delay_s):
    prompt, delayed = Plant(IDEAL), Plant(IDEAL, hidden_effects({"command_delay": delay_s}))
    prompt.step(100_000, 0.0, 0.0)
    prompt.step(400_000, 4.0, 2.0)
    delayed.step(100_000, 0.0, 0.0)
    delayed.step(100_000 + round(delay_s * 1e6), 4.0, 2.0)
    assert delayed.truth.left_speed_rad_s == delayed.truth.x_m == 0.0
    delayed.step(400_000 + round(delay_s * 1e6), 4.0, 2.0)
    for name in ("x_m", "y_m", "yaw_rad", "left_speed_rad_s"):
        assert getattr(delayed.truth, name) == pytest.approx(getattr(prompt.truth, name), abs=1e-12)


def test_every_delayed_command_comes_through_in_order():
    plant = Plant(IDEAL, hidden_effects({"command_delay": 0.0505}))
    for k in range(400):
        plant.step((k + 1) * 1000, float(k // 10), 0.0)
        assert plant.truth.left_speed_rad_s == max(0, (k * 1000 + 999 - 50_500) // 10_000)


def test_the_circle_has_the_radius_of_the_kinematics():
    plant = Plant(IDEAL)
    path = []
    for _ in range(4000):
        plant.step(plant.now_us + 5000, 2.5, 4.0)
        path.append((plant.truth.x_m, plant.truth.y_m))
    v, omega = 0.061 * 3.25, 0.061 * 1.5 / 0.415
    radii = np.hypot(np.array(path)[:, 0] - 0.238, np.array(path)[:, 1] - v / omega)
    np.testing.assert_allclose(radii, math.hypot(v / omega, 0.238), rtol=1e-9)


def test_a_straight_line_is_straight_with_real_motors_and_ends_where_the_ticks_say():
    plant = Plant(NOISELESS)
    plant.step(5_000_000, 5.0, 5.0)
    plant.step(6_000_000, 0.0, 0.0)
    state = plant.truth
    assert state.y_m == state.yaw_rad == state.speed_m_s == 0.0
    left, right = plant.encoder_ticks
    assert left == right == math.floor(state.x_m / (2 * math.pi * 0.061) * 2048)


def test_a_measured_pose_is_the_true_one_at_its_stamp():
    plant = Plant(NOISELESS)
    truth, poses = {}, []
    for _ in range(2000):
        poses += plant.step(plant.now_us + 1000, 3.0, 5.0)
        truth[plant.now_us] = plant.truth
    assert len(poses) == 49
    for pose in poses:
        state = truth[pose.sample_us]
        assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((state.x_m, state.y_m, state.yaw_rad), abs=1e-12)


def test_a_pose_between_two_integration_steps_is_that_of_its_own_instant():
    plant = Plant(replace(IDEAL, pose_rate_hz=30.0))
    poses = plant.step(2_000_000, 4.0, 4.0)
    assert len(poses) == 59
    assert [pose.sample_us for pose in poses[:3]] == [33_333, 66_667, 100_000]
    for pose in poses:
        assert pose.x_m == pytest.approx(4.0 * 0.061 * pose.sample_us * 1e-6, abs=1e-12)


def test_poses_come_out_when_they_are_available_and_not_before():
    plant = Plant(replace(NOISY, pose_delay_s=0.1, pose_delay_jitter_s=0.06))
    out_of_order = 0
    last_us = 0
    for _ in range(3000):
        before_us = plant.now_us
        poses = plant.step(plant.now_us + 1000, 3.0, 5.0)
        assert all(before_us < pose.available_us <= plant.now_us for pose in poses)
        for pose in poses:
            out_of_order += pose.sample_us < last_us
            last_us = max(last_us, pose.sample_us)
    assert out_of_order > 3


@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(1, 80), min_size=1, max_size=40))
def test_how_a_run_is_cut_into_steps_changes_nothing(cuts):
    uncut, cut = Plant(seed=5), Plant(seed=5)
    until_us = 1000 * sum(cuts)
    poses = uncut.step(until_us, 3.0, 5.0)
    pieces = [pose for milliseconds in cuts for pose in cut.step(cut.now_us + 1000 * milliseconds, 3.0, 5.0)]
    assert cut.truth == uncut.truth
    assert cut.encoder_ticks == uncut.encoder_ticks
    assert cut.electrics.battery == uncut.electrics.battery
    assert pieces == poses


def test_the_seed_decides_everything():
    first = recorded(seed=1)
    assert is_same(first, recorded(seed=1)) == (True, True, True, True)
    assert is_same(first, recorded(seed=2)) == (False, False, False, False)


def final_pose(parameters, step_us, **effects):
    plant = Plant(replace(parameters, integration_step_us=step_us), hidden_effects(effects))
    for left, right in DRIVE:
        plant.step(plant.now_us + 320_000, left, right)
    return np.array([plant.truth.x_m, plant.truth.y_m, plant.truth.yaw_rad])


def errors_by_step(parameters, **effects):
    """Distance of the final pose from the one of a 25 us step, for 4, 2 and 1 ms."""
    limit = final_pose(parameters, 25, **effects)
    return [np.abs(final_pose(parameters, step_us, **effects) - limit).max() for step_us in (4000, 2000, 1000)]


@pytest.mark.parametrize("effects", [{"motor_lag": 0.08}, {"x_second_order_motor": 15.0}], ids=lambda e: next(iter(e)))
def test_the_integrator_is_of_second_order(effects):
    coarse, middle, fine = errors_by_step(IDEAL, **effects)
    assert middle < 0.3 * coarse
    assert fine < 0.3 * middle


def test_limits_and_dry_friction_leave_the_integrator_convergent():
    coarse, _, fine = errors_by_step(NOISELESS)
    assert fine < 0.5 * coarse
    assert fine < 5e-6


def test_kidnapping_moves_the_body_and_not_the_wheels():
    plant = Plant(NOISELESS, start=BodyPose(1.0, 1.0, 0.5))
    plant.step(500_000, 3.0, 3.0)
    before, ticks = plant.truth, plant.encoder_ticks
    plant.kidnap(0.5, -0.2, 4.0)
    after = plant.truth
    assert (after.x_m - before.x_m, after.y_m - before.y_m) == pytest.approx((0.5, -0.2))
    assert after.yaw_rad == pytest.approx(before.yaw_rad + 4.0 - 2 * math.pi)
    assert plant.encoder_ticks == ticks
    assert (after.left_speed_rad_s, after.t_us) == (before.left_speed_rad_s, before.t_us)
    poses = plant.step(600_000, 0.0, 0.0)
    assert abs(poses[-1].x_m - after.x_m) < 0.05


def test_disabled_and_braked_wheels_come_to_rest_and_time_does_not_go_back():
    plant = Plant(NOISELESS)
    plant.step(1_000_000, 5.0, 5.0)
    plant.step(4_000_000, 5.0, 5.0, enabled=False)
    assert plant.truth.left_speed_rad_s == plant.truth.speed_m_s == 0.0
    plant.step(5_000_000, 5.0, 5.0)
    plant.step(5_300_000, 5.0, 5.0, brake=True)
    assert plant.truth.left_speed_rad_s == 0.0
    with pytest.raises(ValueError, match="5300000 us"):
        plant.step(5_299_000, 0.0, 0.0)


def test_readings_follow_what_the_motors_do():
    plant = Plant(NOISELESS)
    resting_v = plant.electrics.battery.voltage_v
    plant.step(3_000_000, -6.0, 6.0)
    left_a, right_a = plant.electrics.motor_currents_a
    assert left_a < -1.0 < 1.0 < right_a
    assert plant.electrics.battery.voltage_v < resting_v
    assert min(plant.electrics.motor_temperatures_c) > 22.0
    assert plant.measured_wheel_speeds_rad_s == pytest.approx((-6.0, 6.0), abs=0.1)


def test_wheel_disturbance_shows_in_ticks_and_in_the_pose():
    plant = Plant(replace(NOISELESS, wheel_disturbance_std=0.015).with_ideal_motors(), seed=4)
    speeds = []
    for _ in range(4000):
        plant.step(plant.now_us + 10_000, 5.0, 5.0)
        speeds.append((plant.truth.left_speed_rad_s, plant.truth.right_speed_rad_s))
    np.testing.assert_allclose(np.std(speeds, axis=0), 0.015 * 5.0, rtol=0.15)
    travelled = np.array(plant.encoder_ticks) / 2048 * 2 * math.pi * 0.061
    assert plant.truth.yaw_rad == pytest.approx((travelled[1] - travelled[0]) / 0.415, abs=2e-3)


PARAMETERS = PlantParameters(integration_step_us=10_000)


def _blocks(parameters, seed, count):
    source = Disturbances(parameters, np.random.SeedSequence(seed))
    wheel, slip = [], []
    for number in range(count):
        source.move_to(number * CELLS)
        assert source.first_cell == number * CELLS
        wheel.append(source.wheel)
        slip.append(source.slip)
    return np.concatenate(wheel), np.concatenate(slip)


def test_disturbances_have_the_stated_size_and_correlation_time_and_are_independent():
    wheel, slip = _blocks(PARAMETERS, 1, 100)
    np.testing.assert_allclose(wheel.std(axis=0), 0.015, rtol=0.05)
    np.testing.assert_allclose(slip.std(axis=0), [0.005, 0.004, 0.018], rtol=0.07)
    assert np.all(np.abs(wheel.mean(axis=0)) < 0.1 * 0.015)
    for values, lag in ((wheel[:, 0], 15), (slip[:, 2], 30)):
        assert np.corrcoef(values[:-lag], values[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.05)
    together = np.corrcoef(np.hstack([wheel, slip]).T)
    assert np.all(np.abs(together - np.eye(5)) < 0.06)


def test_wander_adds_slow_variance():
    without_drift, _ = _blocks(PARAMETERS, 4, 200)
    with_drift, _ = _blocks(replace(PARAMETERS, wheel_drift_std=0.02, wheel_drift_correlation_s=2.0), 4, 200)
    drift = with_drift[:, 0] - without_drift[:, 0]
    assert drift.std() == pytest.approx(0.02, rel=0.1)
    assert np.corrcoef(drift[:-200], drift[200:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.12)


def test_volatility_keeps_the_variance_and_fattens_the_tails():
    def kurtosis(values):
        return np.mean(values**4) / np.mean(values**2) ** 2

    calm, _ = _blocks(PARAMETERS, 5, 300)
    wild, _ = _blocks(replace(PARAMETERS, volatility=0.5), 5, 300)
    assert wild.std() == pytest.approx(calm.std(), rel=0.1)
    assert kurtosis(calm[:, 0]) == pytest.approx(3.0, abs=0.4)
    assert kurtosis(wild[:, 0]) > 5.0


def test_the_seed_decides_all_disturbances_and_those_of_the_wheels_do_not_depend_on_the_options_of_the_slip():
    first, again, other = (_blocks(PARAMETERS, seed, 2) for seed in (1, 1, 2))
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])
    without_slip, _ = _blocks(replace(PARAMETERS, slip_std_yaw_rad_s=0.0), 1, 2)
    assert np.array_equal(first[0], without_slip)
