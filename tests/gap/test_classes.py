"""What no drive can tell apart is said; one cause seen twice is one."""

from types import SimpleNamespace

from disco_hw.gap.classes import alike, one_encoder
from disco_hw.gap.intervals import Estimate


def estimates(**values):
    return SimpleNamespace(
        by_name={name.replace("__", "."): Estimate(v, v - 0.002, v + 0.002) for name, v in values.items()}
    )


def test_a_gain_of_one_wheel_with_the_opposite_asymmetry_is_one_encoder():
    gains = estimates(wheel_gain__left=0.0, wheel_gain__right=0.04)
    expected = -0.04 / 2.04
    agreeing = estimates(wheel_radius_asymmetry__ratio=expected)
    assert one_encoder(gains, agreeing, 0.001) == (True, True)
    against = estimates(wheel_radius_asymmetry__ratio=-expected)
    assert one_encoder(gains, against, 0.001) == (False, False)


def test_without_an_asymmetry_a_gain_of_one_wheel_is_a_gain():
    gains = estimates(wheel_gain__left=0.0, wheel_gain__right=0.04)
    assert one_encoder(gains, estimates(), 0.001) == (False, False)
    both = estimates(wheel_gain__left=0.04, wheel_gain__right=0.04)
    assert one_encoder(both, estimates(), 0.001) == (True, False)


def test_lateral_offsets_are_one_class():
    assert alike(("lateral_icr", "turn_slip"), False) == {"lateral_icr": ("pose_offset",)}
    assert alike(("wheel_gain",), True) == {"wheel_gain": ("encoder_scale",)}
    assert alike(("wheel_gain",), False) == {}
