import re
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.adaptation.guard import (
    Geometry,
    believed_geometry,
    check_adaptable,
    choose_adaptation,
    geometry_fault,
    possible_range,
    with_geometry,
)
from disco_hw.config import SHIPPED_ROBOT, Control, PoseInput, Prior
from disco_hw.effects import Channel
from disco_hw.effects.registry import REGISTRY
from disco_hw.errors import InputError
from disco_hw.model import EffectSetting, Gaussian, load_model

MODEL = load_model(SHIPPED_ROBOT.with_name("wombot_model.toml"))
NEW = Geometry(np.array([0.2, 0.07, 0.4]), np.diag([1e-6, 2e-8, 3e-6]))


def test_the_geometry_is_replaced_and_nothing_else():
    lag = EffectSetting("motor_lag", {"tau_s": 0.1})
    names = ("wheel_radius_m", "motor_lag.tau_s", "x_icr_m", "axial_distance_m")
    covariance = np.diag([1e-4, 1e-3, 1e-4, 1e-4]) + 1e-5
    model = replace(MODEL, effects=(lag,), belief=Gaussian(names, np.array([0.06, 0.12, 0.2, 0.4]), covariance))
    changed = with_geometry(model, NEW)
    assert changed.belief.names == names
    assert changed.belief.mean() == pytest.approx([0.07, 0.12, 0.2, 0.4])
    assert changed.belief.covariance()[1] == pytest.approx([0.0, covariance[1, 1], 0.0, 0.0])
    assert believed_geometry(changed).covariance == pytest.approx(NEW.covariance)


def test_what_cannot_be_adapted_is_refused():
    check_adaptable(MODEL, "ut")
    with pytest.raises(InputError, match="uncertainty"):
        check_adaptable(MODEL, "point")
    with pytest.raises(InputError, match=r"^control.adaptation: .*uncertainty"):
        check_adaptable(MODEL, "point", "control.adaptation")
    with pytest.raises(InputError, match="no belief"):
        check_adaptable(replace(MODEL, belief=None), "ut")
    with pytest.raises(InputError, match="side_slip"):
        check_adaptable(replace(MODEL, effects=(EffectSetting("side_slip", {"k_s": 0.1}),)), "ut")


@pytest.mark.parametrize("name", REGISTRY)
def test_only_effects_between_wheel_and_body_forbid_it_of_which_encoders_are_one(name):
    effect = REGISTRY[name]
    setting = EffectSetting(name, {parameter.name: parameter.start for parameter in effect.parameters})
    chosen = choose_adaptation(Control(), PoseInput(), replace(MODEL, effects=(setting,)))
    assert chosen.kind == ("off" if effect.channel is Channel.WHEEL_TO_BODY else "fast")
    assert name != "encoder_scale" or chosen.kind == "off"
    assert name != "heading_bias" or chosen.kind == "fast"


def test_the_geometry_is_learnt_where_the_model_allows_it():
    assert choose_adaptation(Control(), PoseInput(), MODEL).kind == "fast"
    chosen = choose_adaptation(Control(uncertainty="point"), PoseInput(), MODEL)
    assert chosen.kind == "off"
    assert "uncertainty" in chosen.why


def test_one_line_reports_what_runs_and_why():
    assert choose_adaptation(Control(), PoseInput(), MODEL).report == (
        'the geometry is estimated while driving: control.adaptation = "auto"'
    )
    assert choose_adaptation(Control(adaptation="off"), PoseInput(), MODEL).report == (
        'the geometry is not estimated: control.adaptation = "off"'
    )


def test_what_the_file_asks_for_counts():
    assert choose_adaptation(Control(adaptation="off"), PoseInput(), MODEL).kind == "off"
    assert choose_adaptation(Control(adaptation="fast"), PoseInput(), MODEL).kind == "fast"
    with pytest.raises(InputError, match=r"^control.adaptation: .*uncertainty"):
        choose_adaptation(Control(adaptation="fast", uncertainty="point"), PoseInput(), MODEL)


def test_old_entries_are_read_and_named():
    deprecated = choose_adaptation(Control(adaptation="audited"), PoseInput(), MODEL)
    assert deprecated.kind == "fast"
    assert 'write "fast"' in deprecated.why
    # The rate of the poses once decided whether the geometry is learnt.
    for adaptation in ("auto", "off"):
        old = choose_adaptation(Control(adaptation=adaptation, disturbance=True), PoseInput(rate_hz=2.0), MODEL)
        assert old.kind == ("fast" if adaptation == "auto" else "off")
        assert "remove pose.rate_hz" in old.report
        assert "remove control.disturbance" in old.report
    # Also where the planner's mode does not allow it.
    impossible = choose_adaptation(Control(uncertainty="point", disturbance=True), PoseInput(), MODEL)
    assert impossible.kind == "off"
    assert "remove control.disturbance" in impossible.report


def test_the_range_is_the_prior_as_far_as_it_is_possible():
    low, high = possible_range(Prior(wheel_radius_m=(0.0, 0.2)))
    assert low.tolist() == [0.0, 0.005, 0.1]
    assert high.tolist() == [0.5, 0.2, 0.5]


MEAN = np.array([0.238, 0.061, 0.415])
LOW, HIGH = 0.5 * MEAN, 1.6 * MEAN
GOOD_COVARIANCE = np.diag((0.02 * MEAN) ** 2)
TOO_CORRELATED = GOOD_COVARIANCE + 1.01 * (0.02**2 * MEAN[0] * MEAN[1]) * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("mean", "covariance", "fault"),
    [
        (MEAN, GOOD_COVARIANCE, ""),
        (LOW, GOOD_COVARIANCE, ""),
        (HIGH, GOOD_COVARIANCE, ""),
        (MEAN * np.nan, GOOD_COVARIANCE, "not finite"),
        (MEAN, np.full((3, 3), np.inf), "not finite"),
        (MEAN, GOOD_COVARIANCE * 0.0, "no covariance"),
        (MEAN, -GOOD_COVARIANCE, "no covariance"),
        (MEAN, GOOD_COVARIANCE * 1e300, "no covariance"),
        (MEAN, TOO_CORRELATED, "no covariance"),
        (MEAN * [1.0, 1.7, 1.0], GOOD_COVARIANCE, r"wheel_radius_m 0\.1037 is outside \[0\.0305, 0\.0976\]"),
        (MEAN * [1.0, 1.0, 0.4], GOOD_COVARIANCE, "axial_distance_m .* is outside"),
    ],
)
def test_an_estimate_with_a_fault_is_named(mean, covariance, fault):
    found = geometry_fault(Geometry(np.asarray(mean), covariance), LOW, HIGH)
    assert re.search(fault, found) if fault else found == ""


@pytest.mark.parametrize(
    ("drift_m_s", "fault"),
    [((0.1, -0.15), ""), ((0.18, -0.15), r"by 0\.23 m/s, more than 0\.2"), ((np.nan, 0.0), "finite")],
)
def test_ground_that_carries_a_robot_too_fast_is_not_planned_with(drift_m_s, fault):
    found = geometry_fault(Geometry(MEAN, GOOD_COVARIANCE, drift_m_s), LOW, HIGH)
    assert re.search(fault, found) if fault else found == ""
