"""Names, numbers and refusals of the hidden effects."""

import math
from itertools import chain

import pytest

from disco_hw.effects.registry import REGISTRY
from sim.effects import (
    EFFECTS,
    HiddenEffectError,
    HiddenEffects,
    effects_table,
    hidden_effects,
    parse_hidden_effects,
)

NAMES = {
    "command_to_wheel": "motor_lag command_delay deadband stiction speed_limit yaw_rate_limit "
    "yaw_acceleration_limit acceleration_limit battery_sag wheel_gain",
    "wheel_to_body": "encoder_scale wheel_radius_asymmetry turn_slip acceleration_slip side_slip lateral_icr slope "
    "surface_change",
    "pose_sensor": "pose_latency pose_offset heading_bias",
}


@pytest.mark.parametrize("channel", NAMES)
def test_every_named_effect_is_there_in_its_channel(channel):
    listed = {name for name, spec in EFFECTS.items() if spec.channel == channel and not name.startswith("x_")}
    assert listed == set(NAMES[channel].split())


def test_one_number_lands_where_the_table_says():
    assert hidden_effects({"turn_slip": 0.1}).values("turn_slip") == (0.1,)
    assert hidden_effects({"encoder_scale": 0.03}).values("encoder_scale") == (0.0, 0.03)
    assert hidden_effects({"wheel_gain": 0.02}).values("wheel_gain") == (0.02, 0.02)
    assert hidden_effects({"pose_offset": 0.03}).values("pose_offset") == (0.0, 0.03)


def test_several_numbers_fill_in_order_and_defaults_stand_in_for_the_rest():
    effects = hidden_effects({"surface_change": (0.15, 40), "battery_sag": 0.1, "wheel_gain": [0.01, -0.02]})
    assert effects.values("surface_change") == (0.15, 40.0, 0.0)
    assert effects.values("battery_sag") == (0.1, 150.0)
    assert effects.values("wheel_gain") == (0.01, -0.02)


def test_text_and_mapping_mean_the_same():
    text = ["turn_slip=0.1", "surface_change=0.15,40", "encoder_scale=0.01,-0.02"]
    mapping = {"turn_slip": 0.1, "surface_change": [0.15, 40], "encoder_scale": [0.01, -0.02]}
    assert parse_hidden_effects(text) == hidden_effects(mapping)


def test_an_effect_that_is_not_hidden_reads_neutral():
    effects = HiddenEffects()
    assert "speed_limit" not in effects
    assert effects.values("speed_limit") == (math.inf,)
    assert effects.values("turn_slip") == (0.0,)
    assert "turn_slip" in hidden_effects({"turn_slip": 0.0})


def test_an_unknown_name_is_refused_with_all_names():
    with pytest.raises(HiddenEffectError) as caught:
        parse_hidden_effects(["turnslip=0.1"])
    assert "'turnslip'" in str(caught.value)
    assert all(name in str(caught.value) for name in EFFECTS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected_error"),
    [
        ("turn_slip", "turn_slip=NUMBER"),
        ("turn_slip=", "not a number"),
        ("turn_slip=much", "not a number"),
        ("turn_slip=nan", "impossible"),
        ("turn_slip=inf", "impossible"),
        ("turn_slip=0.1,0.2", "2 values"),
        ("motor_lag=-0.1", "impossible"),
        ("speed_limit=0", "impossible"),
        ("wheel_gain=-1", "impossible"),
        ("surface_change=0.1,40,0,1", "4 values"),
    ],
)
def test_impossible_values_are_refused_in_one_line(text, expected_error):
    with pytest.raises(HiddenEffectError, match=expected_error) as caught:
        parse_hidden_effects([text])
    assert "\n" not in str(caught.value)


def test_an_effect_without_a_value_and_one_given_twice_are_refused():
    with pytest.raises(HiddenEffectError, match="0 values"):
        hidden_effects({"turn_slip": ()})
    with pytest.raises(HiddenEffectError, match="twice"):
        parse_hidden_effects(["turn_slip=0.1", "turn_slip=0.2"])


def test_the_table_shows_every_effect_with_meaning_and_units():
    table = effects_table()
    for name, spec in EFFECTS.items():
        assert f"  {name}=" in table
        assert spec.meaning in table
        assert all(f"{value.name}: {value.unit}, realistic" in table for value in spec.values)


@pytest.mark.parametrize("name", EFFECTS)
def test_realistic_sizes_are_possible(name):
    spec = EFFECTS[name]
    for place in (0, 1):
        assert hidden_effects({name: [value.realistic[place] for value in spec.values]})


def sizes_of(effect):
    """Every number of an effect that is no mere neutral zero, or without end, without its sign."""
    return {abs(number) for number in effect if number and math.isfinite(number)}


@pytest.mark.parametrize("name", [name for name in EFFECTS if not name.startswith("x_")])
def test_no_size_of_the_simulator_stands_in_the_model_too(name):
    """A study on robots drawn from the search's own figures would prove nothing of it."""
    simulated = [
        (*value.realistic, *value.bounds, value.neutral, value.default or 0.0) for value in EFFECTS[name].values
    ]
    searched = [
        (one.low, one.high, one.start, one.neutral, one.realistic or 0.0, one.expected, one.least_fitted or 0.0)
        for one in REGISTRY[name].parameters
    ]
    assert not sizes_of(chain(*simulated)) & sizes_of(chain(*searched))
