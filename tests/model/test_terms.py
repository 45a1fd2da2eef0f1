"""Terms without a name: what they add, in the compiled step and in the reference; nothing where there are none."""

import numpy as np
import pytest

from disco_hw.errors import InputError
from disco_hw.model import EffectSetting, Gaussian, Model, load_model, plain, save_model
from disco_hw.model.step import FreeRun
from disco_hw.model.terms import BODY_FEATURES, BODY_MEMORIES, BODY_TARGETS, COMMAND_FEATURES, COMMAND_MEMORIES, TERMS
from tests.model import features
from tests.model.one_kernel import ASIDE, BASE, DIRECTION, DRAG, DROOP, RUBBER, SPIN, effects_of
from tests.model.reference import reference_run

STEP_S = 0.05
DRIVE = np.repeat([[4.0, 4.0], [-3.0, 2.0], [6.0, 1.0], [0.0, 0.5], [-5.0, -4.0]], 6, axis=0)


def compiled(effects):
    model = Model(*BASE, effects=effects)
    return FreeRun(model, model.point()[None], STEP_S).states(np.zeros(5), DRIVE, 0, 60.0)


def by_reference(effects):
    return reference_run(Model(*BASE, effects=effects), DRIVE, STEP_S, time_s=60.0)


def every_term(target, features):
    return tuple(
        EffectSetting(f"{target} += k {feature}", {"k": 0.003 * (1 + n)}) for n, feature in enumerate(features)
    )


# A term of each kind, of what is now and of what was before, of which each is somewhere beyond its reach.
NUMBERS = {DROOP: 0.01, DIRECTION: 0.3, DRAG: -9.0, ASIDE: 0.2, RUBBER: -0.3}
REACHES = {DROOP: 9.0, DIRECTION: 0.6, DRAG: 3e-3, ASIDE: 0.05, RUBBER: 0.1}


def test_no_term_goes_on_beyond_its_reach():
    within = effects_of(NUMBERS, REACHES)
    kept = compiled(within)
    np.testing.assert_allclose(kept, by_reference(within), atol=1e-9)
    # Each of the states feels it: x, y and yaw by the terms of the body, wheels by those of commands.
    assert (np.abs(kept - compiled(effects_of(NUMBERS))).max(axis=0) > 1e-3).all()
    v = 0.06 * 4.0
    dragged = compiled(effects_of({DRAG: -4.0}, {DRAG: 0.005}))
    assert dragged[6, 0] == pytest.approx((v - 4.0 * 0.005) * 0.3)
    back = dragged[12] - dragged[6]
    plain_run = compiled(effects_of({}))
    turned = plain_run[12] - plain_run[6]
    assert back[2] == pytest.approx(turned[2])


@pytest.mark.long
@pytest.mark.parametrize("target", ["command", "v_x", "v_y", "omega"])
def test_every_feature_agrees_with_the_reference(target):
    named = COMMAND_FEATURES if target == "command" else BODY_FEATURES
    effects = (EffectSetting("motor_lag", {"tau_s": 0.1}), *every_term(target, named))
    np.testing.assert_allclose(compiled(effects), by_reference(effects), atol=1e-9)


def test_every_feature_is_what_its_name_says():
    u, other, v, omega, a = np.random.default_rng(3).uniform(-4.0, 4.0, (5, 50))
    for name, found in COMMAND_FEATURES.items():
        expected = features.feature(name, u=u, u_other=other, t=70.0)
        np.testing.assert_allclose(found(u, other, 70.0), expected, rtol=1e-12, err_msg=name)
    for name, found in BODY_FEATURES.items():
        expected = features.feature(name, v=v, omega=omega, a=a, t=70.0)
        np.testing.assert_allclose(found(v, omega, a, 70.0), expected, rtol=1e-12, err_msg=name)


def test_every_memory_follows_what_its_name_says():
    first, second, before = np.random.default_rng(4).uniform(-4.0, 4.0, (3, 50))
    kinds = ((("u", "u_other"), COMMAND_MEMORIES), *((("v", "omega"), BODY_MEMORIES[each]) for each in BODY_TARGETS))
    for names, memories in kinds:
        motion = dict(zip(names, (first, second), strict=True))
        for name, memory in memories.items():
            value = memory.of(first, second)
            np.testing.assert_array_equal(value, features.goes_in(name, **motion), err_msg=name)
            expected = features.feature(name, mean=before, **motion)
            np.testing.assert_allclose(memory.feature(first, second, before), expected, rtol=1e-12, err_msg=name)
            mean, end = (follow(name, before, value, STEP_S) for follow in (features.over, features.after))
            np.testing.assert_allclose(plain._over(memory, before, value, STEP_S), mean, atol=1e-12, err_msg=name)
            np.testing.assert_allclose(plain._after(memory, before, value, STEP_S), end, atol=1e-12, err_msg=name)
            one_by_one = [memory.after(b, v, STEP_S, 1.0) for b, v in zip(before, value, strict=True)]
            np.testing.assert_allclose(one_by_one, end, atol=1e-12, err_msg=name)


def test_each_single_term_adds_what_it_says():
    # Features one by one by hand: two plain libraries could share a slip in the pairing of names and formulas.
    u, other = np.array([2.0, -3.0]), np.array([-3.0, 2.0])
    assert COMMAND_FEATURES["u |u|"](u, other, 0.0) == pytest.approx([4.0, -9.0])
    assert COMMAND_FEATURES["|u_other| sign(u)"](u, other, 0.0) == pytest.approx([3.0, -2.0], rel=1e-3)
    assert BODY_FEATURES["v^3"](-0.5, 9.0, 9.0, 9.0) == pytest.approx(-0.125)
    assert BODY_FEATURES["|v| omega"](-0.5, 2.0, 9.0, 9.0) == pytest.approx(1.0)
    assert BODY_FEATURES["omega / (2 + 5 |omega|)"](0.0, -2.0, 0.0, 0.0) == pytest.approx(-1.0 / 6.0)
    assert BODY_FEATURES["v |a|"](-0.5, 0.0, -2.0, 0.0) == pytest.approx(-1.0)
    v = 0.06 * 4.0
    assert compiled(effects_of({DRAG: -0.4}))[6, 0] == pytest.approx((v - 0.4 * v**3) * 0.3)
    drooped = compiled(effects_of({DROOP: -0.01}))
    assert drooped[6, 3:] == pytest.approx([3.84, 3.84])
    assert drooped[12, 3:] == pytest.approx([-2.91, 1.96])


def test_a_term_on_the_yaw_rate_turns_about_the_axle():
    spun = compiled(effects_of({SPIN: 0.5}))
    wider = Model(0.06, 0.4 / 1.5, 0.1, effects=effects_of({}))
    same = FreeRun(wider, wider.point()[None], STEP_S).states(np.zeros(5), DRIVE, 0, 60.0)
    np.testing.assert_allclose(spun, same, atol=1e-9)


def test_terms_stand_in_a_model_file_and_its_belief(tmp_path):
    name = "v_x += k v^3"
    names = ("wheel_radius_m", "axial_distance_m", f"{name}.k")
    belief = Gaussian(names, np.array([0.06, 0.4, -0.4]), np.diag([1e-6, 1e-4, 1e-3]))
    model = Model(*BASE, effects=(EffectSetting(name, {"k": -0.4, "reach": 0.3}),), belief=belief)
    save_model(model, tmp_path / "model.toml")
    again = load_model(tmp_path / "model.toml")
    assert again.parameter_names == model.parameter_names
    assert again.effects[0].values == {"k": -0.4, "reach": 0.3}
    written = (tmp_path / "model.toml").read_text()
    (tmp_path / "old.toml").write_text(written.replace("reach = 0.3\n", ""))
    assert load_model(tmp_path / "old.toml").effects[0].values["reach"] > 1e8
    (tmp_path / "wrong.toml").write_text(written.replace("reach = 0.3\n", "reach = -0.3\n"))
    with pytest.raises(InputError, match=r"wrong.toml: v_x \+= k v\^3.reach: -0.3 is outside \[0.0, "):
        load_model(tmp_path / "wrong.toml")
    np.testing.assert_array_equal(again.belief.covariance(), model.belief.covariance())
    with pytest.raises(ValueError, match=r"unknown effect 'v_x \+= k v\^4'"):
        EffectSetting("v_x += k v^4", {"k": 1.0})


def test_coefficients_keep_their_meaning_on_other_wheels():
    term = TERMS["omega += k v^2 omega"]
    # v^2 omega of wheels 2 % larger on an axle 10 % longer is 1.02^3 / 1.1 times the old.
    assert term.rescaled(1.02, 1.1) == pytest.approx(1.1 / 1.02**3)
    assert TERMS["v_x += k v |a|"].rescaled(1.02, 1.1) == pytest.approx(1.0 / 1.02**2)
    assert TERMS["command += k u^3"].rescaled(1.02, 1.1) == 1.0
