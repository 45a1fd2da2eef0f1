"""What is not known, or contradicted by its own log, is listed with the reason and not told as found."""

import pytest

from disco_hw.gap.report import EffectFinding
from disco_hw.gap.report.judge import classify_findings, low_confidence_of
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.settings import DEFAULT_SETTINGS

SETTINGS = DEFAULT_SETTINGS.report


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
        ("wheel_gain", {"left": (0.0, -0.1, 0.1), "right": (0.05, 0.04, 0.06)}, None),
        ("wheel_gain", {"left": (0.01, -0.1, 0.1), "right": (0.05, -0.04, 0.15)}, "wider than the value"),
        (
            "surface_change",
            {"track": (0.03, 0.01, 0.05), "time_s": (50.0, 45.0, 55.0), "radius": (0.01, -0.01, 0.03)},
            None,
        ),
    ],
)
def test_only_what_is_known_is_told(name, values, why):
    found = low_confidence_of(effect(name, **values), SETTINGS)
    assert (found is None) == (why is None)
    assert why is None or why in found


def test_effects_are_parted_and_keep_their_order():
    effects = [
        effect("motor_lag", tau_s=(0.2, 0.19, 0.21)),
        effect("speed_limit", limit_rad_s=(3.5, 3.4, 3.6)),
        effect("deadband", width_rad_s=(0.3, 0.01, 0.59)),
    ]
    sure, doubtful = classify_findings(effects, {"speed_limit": "it is exceeded"}, SETTINGS)
    assert [one.name for one in sure] == ["motor_lag"]
    assert [one.name for one in doubtful] == ["speed_limit", "deadband"]
    assert doubtful[0].why == "it is exceeded"
    assert "hardly known" in doubtful[1].why
