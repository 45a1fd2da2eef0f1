"""Terms that remember in the model's step: against the reference, the features of a known motion, and longer steps."""

import numpy as np
import pytest

from disco_hw.model import EffectSetting, Gaussian, Model, load_model, plain, save_model
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import FreeRun, simulate
from disco_hw.model.terms import BODY_MEMORIES, BODY_TARGETS, COMMAND_MEMORIES, TERMS, memories_of
from tests.model.one_kernel import BASE, DIRECTION, LOAD, RUBBER, SLIPPING, effects_of
from tests.model.reference import reference_run

STEP_S = 0.05
DRIVE = np.repeat([[4.0, 4.0], [-3.0, 2.0], [6.0, 1.0], [0.0, 0.5], [-5.0, -4.0]], 6, axis=0)
EVERY = [f"command += k {form}" for form in COMMAND_MEMORIES]
EVERY += [f"{target} += k {form}" for target in BODY_TARGETS for form in BODY_MEMORIES[target]]


def model_of(*effects):
    return Model(*BASE, effects=effects)


def a_few(direction=0.3, load=-0.01, rubber=-0.5, lag_s=0.0, slipping=0.0):
    """The terms that most tests here are of, among others."""
    numbers = {DIRECTION: direction, LOAD: load, RUBBER: rubber, SLIPPING: slipping}
    return model_of(*effects_of(numbers, lag_s=lag_s))


def run(model, commands, step_s=STEP_S, means=None, start=(0.0,) * 5):
    return FreeRun(model, model.point()[None], step_s).states(np.array(start), commands, 0, means=means)


@pytest.mark.long
def test_every_term_that_remembers_agrees_with_the_reference():
    effects = [EffectSetting(name, {"k": 0.003 * (1 + n)}) for n, name in enumerate(EVERY)]
    model = model_of(EffectSetting("motor_lag", {"tau_s": 0.1}), EffectSetting("v_x += k v^3", {"k": -0.2}), *effects)
    np.testing.assert_allclose(run(model, DRIVE), reference_run(model, DRIVE, STEP_S), atol=1e-9)


def test_terms_that_remember_agree_with_the_reference_among_others():
    model = a_few(lag_s=0.1)
    np.testing.assert_allclose(run(model, DRIVE), reference_run(model, DRIVE, STEP_S), atol=1e-9)
    assert np.abs(run(model, DRIVE) - run(a_few(0.0, 0.0, 0.0, 0.1), DRIVE)).max() > 0.1


def test_commands_with_the_features_of_what_was_before_drive_wheels_alike():
    other = DRIVE[:, ::-1]
    added = 0.3 * COMMAND_MEMORIES["sign(u - mean_0.3s(u))"].at_nodes(STEP_S, DRIVE, other)
    added += -0.01 * COMMAND_MEMORIES["u mean_1s(|u| + |u_other|)"].at_nodes(STEP_S, DRIVE, other)
    found, expected = run(a_few(rubber=0.0), DRIVE), run(a_few(0.0, 0.0, 0.0), DRIVE + added)
    np.testing.assert_allclose(found[:, 3:], expected[:, 3:], atol=1e-12)


def test_a_body_turns_by_the_feature_of_how_its_wheels_turned():
    wheels = run(a_few(0.0, 0.0, 0.0), DRIVE)
    rate = 0.06 / 0.4 * (DRIVE[:, 1] - DRIVE[:, 0])
    more = BODY_MEMORIES["omega"]["(omega - mean_1s(omega))"].at_nodes(STEP_S, 0.0 * rate, rate)
    turned = run(a_few(0.0, 0.0, -0.5), DRIVE)[:, 2]
    np.testing.assert_allclose(turned[1:], wheels[1:, 2] - 0.5 * STEP_S * np.cumsum(more), atol=1e-12)


def test_a_robot_whose_tyres_slip_goes_by_what_they_grip():
    """Wheels of 60 mm that spin up to 0.24 m/s at once, and 2 m/s^2: in steps of 0.1 m/s."""
    model = a_few(0.0, 0.0, 0.0, slipping=-1.0)
    np.testing.assert_allclose(run(model, DRIVE), reference_run(model, DRIVE, STEP_S), atol=1e-12)
    means = np.zeros(6)
    ahead = run(model, np.full((4, 2), 4.0), means=means)[:, 0]
    assert np.diff(ahead) == pytest.approx([0.05 * 0.05, 0.05 * 0.15, 0.05 * (0.24 - 0.04 * 0.4 / 2.0), 0.05 * 0.24])
    # Kept in rad/s of both wheels, as they are measured, after what the two terms of commands remember of each wheel.
    assert means[4] == pytest.approx(8.0)
    wheels = 0.03 * DRIVE.sum(axis=1)
    behind = BODY_MEMORIES["v_x"]["(v - slewed_2(v))"].at_nodes(STEP_S, wheels, 0.0 * wheels)
    turns, found = np.diff(run(a_few(0.0, 0.0, 0.0), DRIVE), axis=0), np.diff(run(model, DRIVE), axis=0)
    way = np.hypot(*found[:, :2].T)
    sideways = 0.1 * np.abs(turns[:, 2])
    chord = np.sinc(0.5 * turns[:, 2] / np.pi)
    assert way == pytest.approx(np.hypot(STEP_S * (wheels - behind), sideways) * chord, abs=1e-9)


def test_longer_steps_lead_to_the_same_place():
    straight = np.repeat([[4.0, 4.0], [2.0, 2.0]], 30, axis=0)
    finer = np.repeat(straight, 10, axis=0)
    # A mean over a step makes what is in proportion to it exact.
    loaded = a_few(direction=0.0, rubber=0.0)
    assert run(loaded, straight)[-1, 0] == pytest.approx(run(loaded, finer, STEP_S / 10)[-1, 0], rel=1e-12)
    model = a_few()
    turns = np.repeat(DRIVE, 10, axis=0)
    np.testing.assert_allclose(run(model, DRIVE)[-1, :3], run(model, turns, STEP_S / 10)[-1, :3], atol=2e-3)


def test_a_run_goes_on_from_what_another_remembered():
    model, means = a_few(), np.zeros(6)
    single_run = run(model, DRIVE)
    first = run(model, DRIVE[:13], means=means)
    without_memory = run(model, DRIVE[13:], start=first[-1])
    second = run(model, DRIVE[13:], means=means, start=first[-1])
    np.testing.assert_allclose(np.vstack([first, second[1:]]), single_run, atol=1e-12)
    assert np.abs(without_memory[1:] - single_run[14:]).max() > 0.05
    np.testing.assert_array_equal(simulate(model, DRIVE, STEP_S), single_run)


def test_a_robot_that_has_done_the_same_for_ever_goes_on_so():
    model, left = a_few(), 1.0 - 0.01 * 4.0
    theta = plain.theta_of(model.parameter_names, model.point())
    means = plain.settled_means(theta, 3.0, 1.0, 3.0 * left, left)
    later, v, omega = plain.step(theta, plain.RobotState(0.0, 0.0, 0.0, 0.0, 0.0, means), 3.0, 1.0, STEP_S)
    # The load stays; no command was changed, and the rubber gives way no more.
    assert (v, omega) == pytest.approx((0.06 * 2.0 * left, -0.15 * 2.0 * left))
    for name, values in means.items():
        assert later.means[name] == pytest.approx(values)


def test_what_remembers_stands_in_a_model_file_and_its_belief(tmp_path):
    names = ("wheel_radius_m", f"{DIRECTION}.k", f"{RUBBER}.k")
    belief = Gaussian(names, np.array([0.06, -0.25, -0.5]), np.diag([1e-6, 1e-4, 1e-3]))
    effects = EffectSetting(DIRECTION, {"k": -0.25}), EffectSetting(RUBBER, {"k": -0.5})
    model = Model(*BASE, effects=effects, belief=belief)
    save_model(model, tmp_path / "model.toml")
    again = load_model(tmp_path / "model.toml")
    assert again.effects == model.effects
    np.testing.assert_array_equal(again.belief.covariance(), model.belief.covariance())
    with pytest.raises(ValueError, match=r"unknown effect 'command \+= k sign\(u - mean_2s\(u\)\)'"):
        EffectSetting("command += k sign(u - mean_2s(u))", {"k": 1.0})


def test_a_table_says_how_a_mean_follows_in_a_step():
    model = model_of(EffectSetting(RUBBER, {"k": -0.5}))
    _, effects = coefficient_tables(model, model.point()[None], 0.1)
    (entry,) = effects.body_terms
    assert entry.by_end == pytest.approx(1.0 - np.exp(-0.1))
    assert entry.over_step == pytest.approx(1.0 - (1.0 - np.exp(-0.1)) / 0.1)
    assert effects.command_terms is None
    model = model_of(EffectSetting(SLIPPING, {"k": -1.0}))
    (entry,) = coefficient_tables(model, model.point()[None], 0.1)[1].body_terms
    assert entry.most == pytest.approx(0.2)


def test_means_are_in_the_order_of_a_model_s_effects():
    commands, body = memories_of([RUBBER, "turn_slip", "command += k u |u|", LOAD, DIRECTION])
    assert [memory.time_s for memory in commands] == [1.0, 0.3]
    assert body == (BODY_MEMORIES["omega"]["(omega - mean_1s(omega))"],)
    assert (TERMS[LOAD].means, TERMS[RUBBER].means, TERMS["command += k u |u|"].means) == (2, 1, 0)


def test_a_body_s_memory_keeps_its_meaning_on_other_wheels():
    assert TERMS[RUBBER].rescaled(1.02, 1.1) == pytest.approx(1.1 / 1.02)
    assert TERMS["v_x += k (v - mean_3s(v))"].rescaled(1.02, 1.1) == pytest.approx(1.0 / 1.02)
    assert TERMS[LOAD].rescaled(1.02, 1.1) == 1.0
