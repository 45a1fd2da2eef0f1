"""Every effect: registered, described, does what it says in kernel and reference, and nothing when neutral."""

import math
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.config import PoseInput
from disco_hw.effects import Channel, Stage, encoder_scale, heading_bias, pose_latency, pose_offset
from disco_hw.effects.registry import MOTION_EFFECTS, REGISTRY
from disco_hw.model import EffectSetting, Model, plain
from disco_hw.model.step import FreeRun
from drivers.pose import PoseConvention
from drivers.types import PoseSample
from tests.model.reference import reference_run
from tools.every_effect import model_with_every_effect

NAMES = {
    Channel.COMMAND_TO_WHEEL: {
        "motor_lag", "command_delay", "deadband", "stiction", "speed_limit", "yaw_rate_limit",
        "yaw_acceleration_limit", "acceleration_limit", "battery_sag", "wheel_gain", "turning_load",
        "turning_buildup",
    },
    Channel.WHEEL_TO_BODY: {
        "encoder_scale", "wheel_radius_asymmetry", "turn_slip", "turn_asymmetry", "acceleration_slip", "side_slip",
        "lateral_icr", "turning_point", "load_transfer", "slope", "downhill_slide", "surface_change",
    },
    Channel.POSE_SENSOR: {"pose_latency", "pose_offset", "heading_bias"},
}  # fmt: skip
BASE = (0.06, 0.4, 0.1)
STEP_S = 0.1


def free_run(effects, commands, start=(0.0, 0.0, 0.0, 0.0, 0.0), time_s=0.0):
    # All effects are there, the others at their neutral values: neutral must be neutral.
    model = model_with_every_effect(effects, BASE)
    run = FreeRun(model, model.point()[None], STEP_S)
    return run.states(np.array(start), np.vstack([np.zeros((3, 2)), commands]), 3, time_s)


def added_by(name, values, commands):
    """How much an effect adds to each state of a run."""
    return free_run({name: values}, commands) - free_run({}, commands)


def by_reference(effects, commands, time_s=0.0):
    model = Model(*BASE, effects=tuple(EffectSetting(name, values) for name, values in effects.items()))
    theta = plain.theta_of(model.parameter_names, model.point())
    in_force = plain.delayed(np.vstack([np.zeros((3, 2)), commands]), 3, theta, STEP_S)
    return reference_run(model, in_force, STEP_S, time_s=time_s)


STRAIGHT = np.full((20, 2), 4.0)
SPIN = np.tile([-4.0, 4.0], (20, 1))
TURN = np.tile([2.0, 5.0], (20, 1))
THERE_AND_BACK = np.repeat([[-3.0, 5.0], [5.0, -3.0]], 10, axis=0)
SPEEDING_UP_IN_AN_ARC = np.column_stack([np.linspace(0.0, 6.0, 20), np.linspace(3.0, 9.0, 20)])
START_STOP = np.repeat([[0.0, 0.0], [5.0, 5.0], [0.0, 0.0], [-3.0, -4.0]], 5, axis=0)


def test_all_names_are_registered_in_their_channels():
    for channel, names in NAMES.items():
        assert {name for name, effect in REGISTRY.items() if effect.channel is channel} == names
    assert set(MOTION_EFFECTS) == {name for name, effect in REGISTRY.items() if effect.moves}


@pytest.mark.parametrize("effect", REGISTRY.values(), ids=lambda effect: effect.name)
def test_effects_describe_themselves(effect):
    assert effect.parameters
    for parameter in effect.parameters:
        assert parameter.low < parameter.high
        assert parameter.low <= parameter.start <= parameter.high
    for text in (effect.sentence, effect.sentence_below or effect.sentence, *dict(effect.other_symptoms).values()):
        sentence = effect.fill(text, {p.name: p.start for p in effect.parameters})
        assert sentence[0].islower()
        assert "{" not in sentence
    assert effect.excitation


@pytest.mark.parametrize(
    ("name", "value", "description"),
    [
        ("pose_latency", 0.065, "poses are stamped 65 ms late"),
        ("pose_latency", -0.065, "poses are stamped 65 ms early"),
        ("command_delay", -0.02, "the wheels act on commands 20 ms before they come: a clock stamps too late"),
    ],
)
def test_a_time_is_told_in_words_and_none_is_negative(name, value, description):
    assert REGISTRY[name].describe({REGISTRY[name].parameters[0].name: value}) == description


@pytest.mark.parametrize("name", sorted(NAMES[Channel.POSE_SENSOR]))
def test_what_the_pose_sensor_does_is_undone_by_its_key_of_robot_toml(name):
    effect, true = REGISTRY[name], (1.0, 2.0, 0.7)
    values = dict(zip((p.name for p in effect.parameters), (0.12, -0.05), strict=False))
    key, correction = effect.pose_correction(values)
    time_s, pose = 3.0, true
    if effect.stage is Stage.POSE_TIME:
        time_s += values["latency_s"]
        assert effect.plain(time_s, tuple(values.values())) == pytest.approx(3.0)
    else:
        pose = effect.plain(*true, tuple(values.values()))
    measured = PoseSample(round(1e9 * time_s), 0, *map(float, pose), 0.01, 0.01)
    setting = correction[0] if len(correction) == 1 else correction
    found = PoseConvention(**{key: setting}).converted(measured)
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx(true)
    assert found.t_ns == pytest.approx(3e9)
    # robot.toml takes it, too.
    assert key in PoseInput.__struct_fields__


def test_only_the_pose_sensor_is_corrected_by_robot_toml():
    assert {name for name, one in REGISTRY.items() if one.pose_key is not None} == NAMES[Channel.POSE_SENSOR]


@pytest.mark.parametrize("other_symptoms", [(("no", "no"),), (("unequal", "wheels are {no}"),)])
def test_what_follows_a_sentence_is_of_a_parameter_and_names_parameters(other_symptoms):
    with pytest.raises(ValueError, match=r"turning_load: .*'no'"):
        replace(REGISTRY["turning_load"], other_symptoms=other_symptoms)


@pytest.mark.parametrize(
    ("name", "values", "commands"),
    [
        ("motor_lag", {"tau_s": 0.15}, START_STOP),
        ("command_delay", {"delay_s": 0.23}, START_STOP),
        ("deadband", {"width_rad_s": 0.7}, START_STOP),
        ("stiction", {"threshold_rad_s": 4.5}, START_STOP),
        ("speed_limit", {"limit_rad_s": 3.0}, START_STOP),
        ("yaw_rate_limit", {"limit_rad_s": 0.6}, SPIN),
        ("yaw_acceleration_limit", {"limit_rad_s2": 2.0}, THERE_AND_BACK),
        ("battery_sag", {"loss": 0.5}, START_STOP),
        ("wheel_gain", {"left": -0.1, "right": 0.05}, TURN),
        ("turning_load", {"load_rad_s": 0.4, "unequal": 0.02}, TURN),
        ("acceleration_limit", {"limit_rad_s2": 1.5, "stop_share": 0.7}, START_STOP),
        ("turning_buildup", {"limit_rad_s2": 1.5, "at_once_rad_s": 0.4, "shared": 0.7}, THERE_AND_BACK),
        ("wheel_radius_asymmetry", {"ratio": 0.03}, STRAIGHT),
        ("turn_slip", {"k_s": 0.2}, SPIN),
        ("turn_asymmetry", {"share": 0.1}, THERE_AND_BACK),
        ("acceleration_slip", {"k_s2_m": 0.2}, START_STOP),
        ("side_slip", {"k_s": 0.15}, TURN),
        ("lateral_icr", {"offset_m": 0.05}, SPIN),
        ("turning_point", {"ahead_m": 0.05}, SPIN),
        ("load_transfer", {"k_s2": 0.3}, SPEEDING_UP_IN_AN_ARC),
        ("slope", {"drift_x_m_s": 0.02, "drift_y_m_s": -0.01}, START_STOP),
        ("downhill_slide", {"slide_x_m": 0.1, "slide_y_m": -0.05}, TURN),
        ("surface_change", {"track": 0.15, "time_s": 60.65, "radius": -0.03}, TURN),
    ],
)
def test_kernel_and_reference_agree_and_the_effect_shows(name, values, commands):
    got = free_run({name: values}, commands, time_s=60.0)
    np.testing.assert_allclose(got, by_reference({name: values}, commands, time_s=60.0), atol=1e-9)
    assert np.abs(got - free_run({}, commands))[:, :3].max() > 2e-3


def test_lag_and_delay_and_limits_act_on_the_wheels():
    lagged = free_run({"motor_lag": {"tau_s": 0.1}}, STRAIGHT)[:, 3]
    np.testing.assert_allclose(lagged, 4.0 * (1.0 - np.exp(-np.arange(21))), atol=1e-12)
    delayed = free_run({"command_delay": {"delay_s": 0.15}}, STRAIGHT)[1:, 3]
    np.testing.assert_allclose(delayed, [0.0, 2.0, *[4.0] * 18], atol=1e-12)
    assert free_run({"speed_limit": {"limit_rad_s": 3.0}}, STRAIGHT)[-1, 3] == pytest.approx(3.0)
    assert free_run({"deadband": {"width_rad_s": 0.5}}, -STRAIGHT)[-1, 3] == pytest.approx(-3.5)
    assert free_run({"battery_sag": {"loss": 0.15}}, STRAIGHT, time_s=100.0)[1, 3] == pytest.approx(3.6)
    # No pack loses more: a planner that believed it would ask for ever more speed.
    assert free_run({"battery_sag": {"loss": 0.15}}, STRAIGHT, time_s=5000.0)[1, 3] == pytest.approx(2.8)
    left, right = free_run({"wheel_gain": {"left": 0.1, "right": -0.1}}, STRAIGHT)[-1, 3:]
    assert (left, right) == pytest.approx((4.4, 3.6))


def test_yaw_rate_limit_keeps_the_mean_and_cuts_the_turn():
    states = free_run({"yaw_rate_limit": {"limit_rad_s": 0.3}}, TURN)
    assert states[-1, 2] / 2.0 == pytest.approx(0.3)
    assert states[-1, 3:].mean() == pytest.approx(3.5)


def test_wheels_ramp_between_speeds_and_stop_faster():
    values = {"acceleration_limit": {"limit_rad_s2": 4.0, "stop_share": 1 / 3}}
    wheels = free_run(values, np.array([[3.0, -1.0]] * 5 + [[1.5, 0.0]] + [[0.0, 0.3]] * 2))[1:, 3:]
    assert wheels[:, 0] == pytest.approx([0.4, 0.8, 1.2, 1.6, 2.0, 1.6, 0.4, 0.0])
    assert wheels[:, 1] == pytest.approx([-0.4, -0.8, -1.0, -1.0, -1.0, 0.0, 0.3, 0.3])
    # Each wheel by itself: no wheel has to wait for another.
    assert free_run(values, STRAIGHT)[1, 3:] == pytest.approx([0.4, 0.4])


def built_up(commands, **values):
    """Half the difference of the wheels and their mean, step by step, where turning builds up by 1 rad/s^2."""
    given = {"limit_rad_s2": 1.0, "at_once_rad_s": 0.0, "shared": 0.0} | values
    wheels = free_run({"turning_buildup": given}, np.array(commands))[1:, 3:]
    return 0.5 * (wheels[:, 1] - wheels[:, 0]), wheels.mean(axis=1)


def test_turning_builds_up_slowly_from_what_is_there_at_once_and_falls_at_once():
    half, mean = built_up([[-1.0, 3.0]] * 6 + [[1.0, 1.0]] * 2 + [[3.0, -1.0]] * 3)
    assert half == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.0, -0.1, -0.2, -0.3])
    assert mean == pytest.approx([1.0] * 11)
    # Turning the other way begins from none.
    half, _ = built_up([[-1.0, 1.0]] * 5 + [[1.0, -1.0]] * 2)
    assert half[4:] == pytest.approx([0.5, -0.1, -0.2])
    # Up to this it is there at once.
    half, _ = built_up([[-2.0, 2.0]] * 3, at_once_rad_s=0.7)
    assert half == pytest.approx([0.8, 0.9, 1.0])
    half, _ = built_up([[-0.5, 0.5]] * 3, at_once_rad_s=0.7)
    assert half == pytest.approx([0.5] * 3)


def test_motors_that_give_all_to_a_turn_leave_the_mean_behind_by_what_the_turn_lacks():
    half, mean = built_up([[-0.5, 2.5]] * 8, shared=1.0)
    assert half == pytest.approx(0.1 * np.arange(1, 9))
    assert mean == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3])


def loaded(left, right, unequal=0.0):
    """Wheel speeds that a turning load of 0.4 rad/s leaves of constant commands."""
    values = {"load_rad_s": 0.4, "unequal": unequal}
    return free_run({"turning_load": values}, np.tile([left, right], (3, 1)))[-1, 3:]


def test_a_turning_load_takes_as_much_from_every_turn_and_nothing_from_a_straight():
    for half in (-3.0, -0.6, 0.6, 3.0):
        left, right = loaded(2.0 - half, 2.0 + half)
        assert (0.5 * (left + right), 0.5 * (right - left)) == pytest.approx((2.0, half - math.copysign(0.4, half)))
    # Where all of it is lost the robot drives straight on.
    assert loaded(1.7, 2.3) == pytest.approx([2.0, 2.0])
    assert loaded(4.0, 4.0) == pytest.approx([4.0, 4.0])


@pytest.mark.parametrize("speed_rad_s", [-3.0, 0.5, 5.0])
def test_a_turning_load_holds_the_rims_of_unequal_wheels_together(speed_rad_s):
    left, right = loaded(speed_rad_s, speed_rad_s, unequal=0.03)
    assert 1.03 * right == pytest.approx(0.97 * left)
    assert 0.5 * (left + right) == pytest.approx(speed_rad_s)


def test_yaw_acceleration_limit_keeps_the_mean_and_ramps_the_turn():
    states = free_run({"yaw_acceleration_limit": {"limit_rad_s2": 2.0}}, THERE_AND_BACK)
    rate = 0.06 * (states[:, 4] - states[:, 3]) / 0.4
    np.testing.assert_allclose(rate[:7], 0.2 * np.arange(7), atol=1e-12)
    np.testing.assert_allclose(rate[6:11], 1.2, atol=1e-12)
    np.testing.assert_allclose(rate[10:], np.maximum(1.2 - 0.2 * np.arange(11), -1.2), atol=1e-12)
    np.testing.assert_allclose(states[1:, 3:].mean(axis=1), 1.0, atol=1e-12)
    # The turn of a ramp that is as long as six steps, with the speed reached exactly at its end.
    assert states[6, 2] == pytest.approx(0.5 * 2.0 * 0.6**2)


def test_yaw_acceleration_limit_comes_after_the_motors_lag():
    both = {"motor_lag": {"tau_s": 0.1}, "yaw_acceleration_limit": {"limit_rad_s2": 2.0}}
    got = free_run(both, THERE_AND_BACK)
    np.testing.assert_allclose(got, by_reference(both, THERE_AND_BACK), atol=1e-9)
    rate = 0.06 * (got[:, 4] - got[:, 3]) / 0.4
    assert np.abs(np.diff(rate)).max() == pytest.approx(0.2)
    assert 0.0 < 1.2 - rate[10] < 0.05


def test_stiction_holds_a_wheel_at_rest_but_not_a_turning_one():
    effect, weak = {"stiction": {"threshold_rad_s": 0.7}}, np.full((10, 2), 0.5)
    assert free_run(effect, weak)[-1, 3] == 0.0
    assert free_run(effect, weak, start=(0.0, 0.0, 0.0, 2.0, 2.0))[-1, 3] == pytest.approx(0.5)


def test_body_effects_act_on_the_velocities_they_name():
    asymmetric = free_run({"wheel_radius_asymmetry": {"ratio": 0.02}}, STRAIGHT)
    assert asymmetric[-1, 2] == pytest.approx(0.06 * 4.0 * 0.04 / 0.4 * 2.0)
    omega = 0.06 * 8.0 / 0.4
    assert free_run({"turn_slip": {"k_s": 0.1}}, SPIN)[-1, 2] == pytest.approx(omega * (1.0 - 0.1 * omega) * 2.0)
    assert free_run({"turn_slip": {"k_s": 2.0}}, SPIN)[-1, 2] == pytest.approx(omega)
    assert added_by("lateral_icr", {"offset_m": 0.05}, SPIN)[1, 0] == pytest.approx(0.05 * math.sin(omega * 0.1))
    half = 0.06 * 3.0 / 0.4 / 2.0 * 0.1
    slid = added_by("side_slip", {"k_s": 0.2}, TURN)[1]
    across = -slid[0] * math.sin(half) + slid[1] * math.cos(half)
    assert across == pytest.approx(-0.2 * (0.06 * 3.5) * (0.06 * 3.0 / 0.4) * 0.1, rel=1e-3)
    slipping = free_run({"acceleration_slip": {"k_s2_m": 0.1}}, STRAIGHT)
    acceleration = 0.06 * 4.0 / 0.1
    assert slipping[1, 0] == pytest.approx(0.06 * 4.0 * 0.1 * (1.0 - 0.1 * acceleration))
    assert slipping[2, 0] - slipping[1, 0] == pytest.approx(0.06 * 4.0 * 0.1)


def test_a_slope_moves_only_a_robot_whose_wheels_turn():
    values = {"slope": {"drift_x_m_s": 0.02, "drift_y_m_s": 0.01}}
    np.testing.assert_array_equal(free_run(values, np.zeros((10, 2)))[-1, :2], [0.0, 0.0])
    np.testing.assert_allclose(added_by("slope", values["slope"], STRAIGHT)[-1, :2], [0.04, 0.02], atol=1e-12)


def test_a_robot_turns_about_another_point_to_the_left_than_to_the_right():
    """Of a small turn from heading 0, the axle moves to the left whichever way it goes."""
    values = {"turning_point": {"ahead_m": 0.05}}
    for spin in (SPIN[:1], -SPIN[:1]):
        turned, plainly = free_run(values, spin)[-1], free_run({}, spin)[-1]
        assert turned[1] - plainly[1] == pytest.approx(0.05 * abs(turned[2]), rel=0.01)
        assert turned[2] == plainly[2]


def test_a_robot_that_speeds_up_in_a_turn_is_carried_aside_and_one_at_a_steady_speed_is_not():
    added = added_by("load_transfer", {"k_s2": 0.3}, TURN)
    np.testing.assert_allclose(added[2:], np.tile(added[1], (19, 1)), rtol=1e-7, atol=1e-12)


def test_an_uneven_grip_turns_further_one_way():
    values = {"turn_asymmetry": {"share": 0.1}}
    plainly = free_run({}, SPIN)[-1, 2]
    assert free_run(values, SPIN)[-1, 2] == pytest.approx(1.1 * plainly)
    assert free_run(values, -SPIN)[-1, 2] == pytest.approx(-0.9 * plainly)


def test_a_turning_robot_slides_downhill_as_fast_as_it_turns():
    values = {"downhill_slide": {"slide_x_m": 0.1, "slide_y_m": 0.05}}
    for direction in (1.0, -1.0):
        turned, plainly = free_run(values, direction * SPIN), free_run({}, direction * SPIN)
        np.testing.assert_allclose(turned[:, 2], plainly[:, 2])
        slid = abs(turned[-1, 2])
        np.testing.assert_allclose((turned - plainly)[-1, :2], [0.1 * slid, 0.05 * slid], rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("turning_point", {"ahead_m": 0.05}),
        ("load_transfer", {"k_s2": 0.3}),
        ("turn_asymmetry", {"share": 0.1}),
        ("downhill_slide", {"slide_x_m": 0.1, "slide_y_m": 0.05}),
    ],
)
def test_what_acts_in_turns_leaves_straights_alone(name, values):
    np.testing.assert_array_equal(added_by(name, values, STRAIGHT), 0.0)


def test_a_surface_changes_at_its_time():
    states = free_run({"surface_change": {"track": 0.5, "time_s": 1.0, "radius": 0.0}}, SPIN)
    rates = np.diff(states[:, 2]) / STEP_S
    np.testing.assert_allclose(rates[:10], 1.2, rtol=1e-7)
    np.testing.assert_allclose(rates[10:], 0.8, rtol=1e-7)


def test_measurement_effects_change_what_is_measured():
    assert encoder_scale.plain(2.0, 4.0, (0.1, -0.05)) == pytest.approx((2.2, 3.8))
    assert pose_offset.plain(1.0, 2.0, math.pi / 2, (0.3, 0.1)) == pytest.approx((0.9, 2.3, math.pi / 2))
    assert heading_bias.plain(1.0, 2.0, 1.0, (0.2,)) == pytest.approx((1.0, 2.0, 1.2))
    assert pose_latency.plain(5.0, (0.15,)) == pytest.approx(4.85)


def test_an_unknown_effect_or_parameter_is_refused():
    with pytest.raises(ValueError, match="unknown effect 'slip'"):
        EffectSetting("slip", {})
    with pytest.raises(ValueError, match=r"turn_slip\.k: no such parameter; turn_slip has k_s"):
        EffectSetting("turn_slip", {"k": 0.1})
