"""What is not known, or contradicted by its own log, is listed with the reason and not told as found."""

import numpy as np
import pytest

from disco_hw.gap.report import EffectFinding
from disco_hw.gap.report.judge import Measured, classify_findings, low_confidence_of
from disco_hw.gap.search.channel_result import ParameterEstimate
from tests.gap.synthetic import line_of

GEOMETRY = (0.06, 0.4)


def drive(fastest=4.0, seconds=40.0):
    """Wheels that turn at 3 rad/s, and for two seconds at the fastest, on the spot."""
    speed = np.full((round(seconds * 100), 2), 3.0)
    speed[500:700] = -fastest, fastest
    return Measured(line_of(speed), GEOMETRY)


def effect(name, **values):
    return EffectFinding(name, "x", {key: ParameterEstimate(*each) for key, each in values.items()}, 50.0)


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("motor_lag", {"tau_s": (0.2, 0.18, 0.22)}, None),
        ("motor_lag", {"tau_s": (0.2, 0.01, 0.39)}, "wider than the value"),
        ("motor_lag", {"tau_s": (0.030, 0.010, 0.051)}, "wider than the value"),
        ("motor_lag", {"tau_s": (0.030, 0.017, 0.043)}, None),
        ("battery_sag", {"loss": (0.9, -2e11, 2e11)}, "wider than the value"),
        ("speed_limit", {"limit_rad_s": (4.2, 4.1, 4.3)}, None),
        ("speed_limit", {"limit_rad_s": (4.2, 2.4, 6.0)}, "wider than the value"),
        ("speed_limit", {"limit_rad_s": (3.5, 3.4, 3.6)}, "s of this log, up to 4 rad/s"),
        # However wide its interval.
        ("speed_limit", {"limit_rad_s": (3.5, 2.9, 4.1)}, "s of this log, up to 4 rad/s"),
        ("yaw_rate_limit", {"limit_rad_s": (0.15, 0.14, 0.16)}, "is exceeded"),
        ("yaw_rate_limit", {"limit_rad_s": (1.2, 1.15, 1.25)}, None),
        ("wheel_gain", {"left": (0.0, -0.1, 0.1), "right": (0.05, 0.04, 0.06)}, None),
        ("wheel_gain", {"left": (0.01, -0.1, 0.1), "right": (0.05, -0.04, 0.15)}, "wider than the value"),
        # When it changed is known, and that it did is not.
        (
            "surface_change",
            {"track": (0.03, -0.01, 0.07), "time_s": (50.0, 45.0, 55.0), "radius": (0.01, -0.01, 0.03)},
            "includes no effect",
        ),
        (
            "surface_change",
            {"track": (0.03, 0.01, 0.05), "time_s": (50.0, 45.0, 55.0), "radius": (0.01, -0.01, 0.03)},
            None,
        ),
    ],
)
def test_only_what_is_known_and_not_contradicted_is_told(name, values, why):
    found = low_confidence_of(effect(name, **values), drive())
    assert (found is None) == (why is None)
    assert why is None or why in found


def test_a_moment_beyond_a_limit_contradicts_nothing():
    speed = np.full((4000, 2), 3.0)
    speed[1000:1004] = 6.0
    limit = effect("speed_limit", limit_rad_s=(3.2, 3.1, 3.3))
    assert low_confidence_of(limit, Measured(line_of(speed), GEOMETRY)) is None


def test_effects_are_parted_and_keep_their_order():
    effects = [effect("motor_lag", tau_s=(0.2, 0.19, 0.21)), effect("speed_limit", limit_rad_s=(3.5, 3.4, 3.6))]
    sure, doubtful = classify_findings(effects, drive())
    assert [one.name for one in sure] == ["motor_lag"]
    assert [(one.name, "exceeded" in one.why) for one in doubtful] == [("speed_limit", True)]
