"""Settings: the paper's, those of robot.toml, and what is refused."""

import math

import pytest

from disco_hw.config import Control, Robot
from disco_hw.control import CommandLimits, DiscoSettings, Sampler
from disco_hw.control.plan import ROTATION


def test_paper_mode_is_the_appendix_table():
    settings = DiscoSettings.paper()
    sampler = settings.sampler
    assert (sampler.samples, sampler.horizon, sampler.temperature, settings.ut_alpha) == (400, 50, 0.1, 0.5)
    assert (sampler.noise_std / ROTATION) ** 2 == pytest.approx(0.25)
    assert sampler.control_cost_weight == sampler.temperature
    assert sampler.knots is None
    assert (sampler.update_from, sampler.beyond_end, sampler.with_nominal) == ("drawn", "zero", False)
    assert settings.euler


def test_from_config_takes_size_mode_and_uncertainty():
    settings = DiscoSettings.from_config(Control(samples=64, horizon=20, step_s=0.2, uncertainty="mc"), 0.2, 0.0)
    assert (settings.sampler.samples, settings.sampler.horizon, settings.step_s) == (64, 20, 0.2)
    assert settings.uncertainty == "mc"
    assert settings.sampler.knots == 7
    assert DiscoSettings.from_config(Control(mode="paper"), 0.2, 0.0).sampler.knots is None


def test_a_slow_robot_plans_as_far_in_shorter_steps_where_its_plans_are_refined():
    slow, slow_sampled = (DiscoSettings.from_config(Control(mode=mode), 0.1, 0.0) for mode in ("default", "sampled"))
    assert slow_sampled.step_s == pytest.approx(0.2)
    assert slow.step_s == pytest.approx(0.1)
    assert slow.sampler.horizon * slow.step_s == pytest.approx(slow_sampled.sampler.horizon * slow_sampled.step_s)
    usual = DiscoSettings.from_config(Control(), 0.2, 0.0).sampler.horizon
    assert DiscoSettings.from_config(Control(step_s=0.2), 0.1, 0.0).sampler.horizon == usual


@pytest.mark.parametrize(
    ("control", "speed_m_s", "x_icr_m", "horizon"),
    [
        (Control(), 0.2, 0.238, 40),
        (Control(), 0.2, -2.0, 40),
        (Control(), 0.2, 0.24, 40),
        (Control(), 0.2, 0.25, 50),
        (Control(), 0.2, 0.8, 160),
        (Control(facing="backwards"), 0.2, -0.8, 160),
        (Control(facing="backwards"), 0.2, 0.8, 40),
        (Control(mode="sampled", step_s=0.2), 0.1, 0.5, 100),
        (Control(), 0.05, 2.0, 500),
        (Control(horizon=20), 0.2, 0.8, 20),
        (Control(mode="paper"), 0.2, 0.8, 50),
    ],
)
def test_plans_cover_four_x_icr_where_the_tracked_point_lies_far_behind(control, speed_m_s, x_icr_m, horizon):
    assert DiscoSettings.from_config(control, speed_m_s, x_icr_m).sampler.horizon == horizon


def test_limits_of_the_robot():
    robot = Robot(name="r", wheel_radius_m=0.06, axial_distance_m=0.3, ticks_per_rev=1, max_wheel_speed_rad_s=7.0)
    assert CommandLimits.of_robot(robot) == CommandLimits(7.0, 20.0)
    assert CommandLimits(7.0).acceleration_rad_s2 == math.inf


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"samples": 1}, "samples: must be at least 2"),
        ({"horizon": 1}, "horizon"),
        ({"noise_std": 0.0}, "noise_std: must be above 0"),
        ({"knots": 3}, "knots: must be at least 4, or None"),
        ({"temperature": 0.0}, "temperature"),
        ({"target_ess": 0.5}, "target_ess"),
        ({"worst_part": 0.0}, "worst_part"),
        ({"control_cost_weight": -1.0}, "control_cost_weight"),
    ],
)
def test_samplers_that_make_no_sense_are_refused(values, fault):
    with pytest.raises(ValueError, match=fault):
        Sampler(**values)


def test_negative_weights_have_no_worst_part():
    with pytest.raises(ValueError, match="only risk 'mean' has a meaning"):
        DiscoSettings(sampler=Sampler(risk="cvar"), ut_alpha=0.5)
    DiscoSettings(sampler=Sampler(risk="cvar"), ut_alpha=1.0)
