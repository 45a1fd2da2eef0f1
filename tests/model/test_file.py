"""The model file: what is written is read back bit for bit, and every fault is one line with file, field and remedy."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.errors import InputError
from disco_hw.model import EffectSetting, Gaussian, Mixture, Model, Uniform, load_model, model_text, save_model
from tests.log.processes import files_of_at_most

SHIPPED = Path(__file__).parents[2] / "disco_hw/robots/wombot_model.toml"


def read(tmp_path, text):
    path = tmp_path / "model.toml"
    path.write_text(text)
    return load_model(path)


def test_the_shipped_model_is_the_papers_posterior():
    model = load_model(SHIPPED)
    assert (model.x_icr_m, model.wheel_radius_m, model.axial_distance_m) == (0.238, 0.061, 0.415)
    assert model.belief.names == ("x_icr_m", "wheel_radius_m", "axial_distance_m")
    np.testing.assert_allclose(model.belief.mean(), [0.238, 0.061, 0.415])
    printed = [[0.13, -0.03, -0.04], [-0.03, 0.15, 0.03], [-0.04, 0.03, 0.09]]
    np.testing.assert_allclose(model.belief.covariance(), np.array(printed) * 1e-3, rtol=1e-12)


numbers = st.floats(0.02, 0.4)


@settings(max_examples=40, deadline=None)
@given(numbers, numbers, numbers, st.sampled_from(["none", "gaussian", "mixture", "uniform"]))
def test_written_models_are_read_back_bit_for_bit(tmp_path_factory, radius, axial, tau, kind):
    names = ("wheel_radius_m", "motor_lag.tau_s")
    one = Gaussian(names, np.array([radius, tau]), np.array([[radius, 0.001], [0.001, tau]]))
    belief = {
        "none": None,
        "gaussian": one,
        "mixture": Mixture(np.array([0.3, 0.7]), (one, Gaussian(names, np.array([axial, tau]), np.eye(2) * axial))),
        "uniform": Uniform(names, np.array([0.0, 0.0]), np.array([radius, tau])),
    }[kind]
    model = Model(radius, axial, 0.1, (EffectSetting("motor_lag", {"tau_s": tau}),), belief, name='odd "name"')
    path = tmp_path_factory.mktemp("models") / "model.toml"
    save_model(model, path)
    back = load_model(path)
    assert model_text(back) == model_text(model)
    assert (back.wheel_radius_m, back.effects, back.name) == (radius, model.effects, model.name)
    if belief is not None:
        np.testing.assert_allclose(back.belief.mean(), belief.mean(), rtol=0)


GOOD = model_text(
    Model(
        0.06,
        0.4,
        effects=(EffectSetting("motor_lag", {"tau_s": 0.1}),),
        belief=Gaussian(("wheel_radius_m", "x_icr_m"), np.array([0.06, 0.1]), np.eye(2) * 1e-4),
    )
)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("format = 1", "format = 2", "format"),
        ("wheel_radius_m = 0.06", "wheel_radius_m = nan", "base.wheel_radius_m: not a finite number; write"),
        ("wheel_radius_m = 0.06", "wheel_radius_m = 0.0", r"wheel_radius_m: 0.0 is outside \[0.005, 2.0\] m; write"),
        ("wheel_radius_m = 0.06\n", "", "wheel_radius_m: missing; add it .docs/control.md"),
        ("wheel_radius_m = 0.06", "wheel_radius = 0.06", "wheel_radius: no such field; did you mean wheel_radius_m"),
        ("axial_distance_m = 0.4", 'axial_distance_m = "wide"', "base.axial_distance_m: expected `float`"),
        ('name = "motor_lag"', 'name = "moter_lag"', "'moter_lag'; did you mean motor_lag. known are acceleration"),
        ('name = "motor_lag"', 'title = "motor_lag"', r"effects\[0\].name: missing; write the name"),
        ("tau_s = 0.1", "tau = 0.1", "motor_lag.tau: no such parameter; motor_lag has tau_s"),
        ("tau_s = 0.1\n", "", "motor_lag.tau_s: missing; add its value in s"),
        ("tau_s = 0.1", "tau_s = inf", r"effects\[0\] motor_lag.tau_s: not a finite number"),
        ("tau_s = 0.1", "tau_s = -0.1", "motor_lag.tau_s: -0.1 is outside"),
        ("tau_s = 0.1", "tau_s = true", r"effects\[0\] motor_lag.tau_s: not a finite number"),
        ('"x_icr_m"]', '"y_icr_m"]', "belief over 'y_icr_m', which this model does not have; it has wheel_radius_m"),
        ('"x_icr_m"]', '"wheel_radius_m"]', "belief names 'wheel_radius_m' twice"),
        ("mean = [0.06, 0.1]", "mean = [0.06, nan]", "belief: mean holds a value that is not finite; correct it"),
        ("mean = [0.06, 0.1]", "mean = [0.06]", "belief: mean has 1 entries, not 2"),
        ("mean = [0.06, 0.1]", "mean = [60.0, 0.1]", r"belief: mean of wheel_radius_m: 60.0 is outside .* m; write"),
        ("mean = [0.06, 0.1]", "mean = [-0.06, 0.1]", "belief: mean of wheel_radius_m: -0.06 is outside"),
        (
            "[belief]",
            '[[effects]]\nname = "motor_lag"\ntau_s = 0.2\n\n[belief]',
            "'motor_lag' is listed twice; keep one",
        ),
        ("tau_s = 0.1", "tau_s = " + "1" * 60, "motor_lag.tau_s: 1+ is outside"),
        ("tau_s = 0.1", "tau_s = " + "1" * 5000, "not valid TOML .*64 characters"),
        ("tau_s = 0.1", "tau_s = " + "[" * 3000 + "]" * 3000, "not valid TOML .*16 deep"),
        ("[0.0001, 0.0]", "[0.0001, 0.1]", "belief: covariance is not symmetric"),
        ("[0.0, 0.0001]", "[0.0, -0.0001]", "belief: covariance is not positive definite"),
        ("[0.0, 0.0001]", "[0.0, nan]", "belief: covariance holds a value that is not finite"),
        (
            "[0.0, 0.0001]",
            "[0.0, 17.0]",
            r"belief: standard deviation of x_icr_m is 4\.12 m, wider than its whole range",
        ),
        ("[0.0, 0.0001]", "[0.0, 1e300]", r"belief: standard deviation of x_icr_m is 1e\+150 m, wider than its whole"),
        ("[0.0, 0.0001]", "[0.0]", "belief: covariance has rows of different lengths"),
        ('kind = "gaussian"', 'kind = "cauchy"', "belief: invalid value 'cauchy'|belief.kind: invalid value 'cauchy'"),
    ],
)
def test_faults_are_reported_in_one_line_with_the_file(tmp_path, old, new, fault):
    assert old in GOOD
    with pytest.raises(InputError, match=fault) as error:
        read(tmp_path, GOOD.replace(old, new, 1))
    assert str(error.value).startswith(str(tmp_path / "model.toml"))
    assert "\n" not in str(error.value)


def test_a_covariance_that_was_rounded_on_its_way_is_symmetric_to_the_last_bit(tmp_path):
    rounded = GOOD.replace("[0.0001, 0.0]", "[0.0001, 1e-15]")
    covariance = read(tmp_path, rounded).belief.covariance()
    assert covariance[0, 1] == covariance[1, 0] == 0.5e-15


def test_mixture_lists_must_agree(tmp_path):
    text = '[belief]\nkind = "mixture"\nnames = ["x_icr_m"]\nweights = [1.0]\n'
    text += "means = [[0.1], [0.2]]\ncovariances = [[[1.0]]]\n"
    with pytest.raises(InputError, match="weights, means and covariances differ in number"):
        read(tmp_path, GOOD.split("[belief]")[0] + text)


def test_unreadable_files_are_reported(tmp_path):
    with pytest.raises(InputError, match=r"cannot be read.*give the path of a model file"):
        load_model(tmp_path / "missing.toml")
    with pytest.raises(InputError, match="not valid TOML"):
        read(tmp_path, "format = = 1")


def test_the_mark_of_missing_effects_is_kept(tmp_path):
    complete = read(tmp_path, GOOD)
    assert complete.missing_effects == ()
    save_model(replace(complete, missing_effects=("turn_slip", "slope")), tmp_path / "marked.toml")
    assert load_model(tmp_path / "marked.toml").missing_effects == ("turn_slip", "slope")


@pytest.mark.parametrize(
    ("name", "fault"), [("wind", "unknown effect 'wind'"), ("motor_lag", "is also listed in effects")]
)
def test_a_mark_must_name_an_effect_that_the_model_lacks(tmp_path, name, fault):
    with pytest.raises(InputError, match=f"missing_effects: .*{fault}"):
        read(tmp_path, GOOD.replace("format = 1", f'format = 1\nmissing_effects = ["{name}"]'))


def test_a_model_that_cannot_be_written_whole_leaves_the_old_one(tmp_path):
    model, path = load_model(SHIPPED), tmp_path / "model.toml"
    save_model(model, path)
    before = path.read_text()
    with files_of_at_most(len(before) // 2), pytest.raises(OSError, match="File too large"):
        save_model(replace(model, name="another"), path)
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link_and_a_pipe_takes_the_text(tmp_path):
    model = load_model(SHIPPED)
    (tmp_path / "link.toml").symlink_to(tmp_path / "real.toml")
    save_model(model, tmp_path / "link.toml")
    assert (tmp_path / "link.toml").is_symlink()
    assert load_model(tmp_path / "real.toml").name == model.name
    reading, writing = os.pipe()
    with open(reading, encoding="utf-8") as pipe:
        save_model(model, Path(f"/proc/self/fd/{writing}"))
        os.close(writing)
        assert pipe.read() == model_text(model)
