"""What no drive can tell apart is said; one cause seen twice is one."""

from types import SimpleNamespace

from disco_hw.gap.search.analysis import ParameterEstimate, confounded_with, one_encoder
from disco_hw.gap.settings import DEFAULT_SETTINGS

SETTINGS = DEFAULT_SETTINGS.selection


def estimates(**values):
    return SimpleNamespace(
        by_name={name.replace("__", "."): ParameterEstimate(v, v - 0.002, v + 0.002) for name, v in values.items()}
    )


def test_a_gain_of_one_wheel_with_the_opposite_asymmetry_is_one_encoder():
    gains = estimates(wheel_gain__left=0.0, wheel_gain__right=0.04)
    expected = -0.04 / 2.04
    assert one_encoder(gains, (expected, 0.001), True, SETTINGS) == (True, True)
    assert one_encoder(gains, (-expected, 0.001), True, SETTINGS) == (False, False)


def test_an_asymmetry_too_small_to_be_named_still_decides():
    gains = estimates(wheel_gain__left=0.0, wheel_gain__right=0.008)
    expected = -0.008 / 2.008
    # Four standard deviations from none, at what the encoder would make it.
    assert one_encoder(gains, (expected, 0.0007), False, SETTINGS) == (True, True)
    # Three nats say so, and then two and a half.
    assert one_encoder(gains, (expected, 0.0011), False, SETTINGS) == (True, True)
    assert one_encoder(gains, (expected, 0.0014), False, SETTINGS) == (True, False)
    # Nobody knows: either.
    assert one_encoder(gains, (0.5 * expected, 0.003), False, SETTINGS) == (True, False)
    # None, and not what the encoder would make it.
    assert one_encoder(gains, (0.0, 0.0007), False, SETTINGS) == (False, False)


def test_without_an_asymmetry_a_gain_of_one_wheel_is_a_gain():
    gains = estimates(wheel_gain__left=0.0, wheel_gain__right=0.04)
    assert one_encoder(gains, (0.0, 0.001), False, SETTINGS) == (False, False)
    both = estimates(wheel_gain__left=0.04, wheel_gain__right=0.04)
    assert one_encoder(both, (0.0, 0.001), False, SETTINGS) == (True, False)


def test_lateral_offsets_are_one_class():
    assert confounded_with(("lateral_icr", "turn_slip"), False) == {"lateral_icr": ("pose_offset",)}
    assert confounded_with(("wheel_gain",), True) == {"wheel_gain": ("encoder_scale",)}
    assert confounded_with(("wheel_gain",), False) == {}
