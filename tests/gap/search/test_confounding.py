"""What no drive can tell apart is said; one cause seen twice is one."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.search import analysis as analysed
from disco_hw.gap.search.analysis import (
    FinalFit,
    GapAnalysis,
    _encoder,
    _free_asymmetry,
    _with_encoder,
    confounded_with,
    final_fit,
    one_encoder,
)
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.search.test_lacking import analysis_of, found

SETTINGS = DEFAULT_SETTINGS.selection


def estimates(**values):
    return SimpleNamespace(
        by_name={name.replace("__", "."): ParameterEstimate(v, v - 0.002, v + 0.002) for name, v in values.items()}
    )


@pytest.mark.parametrize(
    ("left", "right", "times_expected", "deviation", "possible", "cause"),
    [
        (0.0, 0.04, 1.0, 0.001, True, True),
        # The other way round, and none at all.
        (0.0, 0.04, -1.0, 0.001, False, False),
        (0.0, 0.04, 0.0, 0.001, False, False),
        (0.04, 0.04, 0.0, 0.001, True, False),
        # Too small to be named it still decides: four standard deviations from none, at what the encoder would make it.
        (0.0, 0.008, 1.0, 0.0007, True, True),
        # Three nats say so, and then two and a half.
        (0.0, 0.008, 1.0, 0.0011, True, True),
        (0.0, 0.008, 1.0, 0.0014, True, False),
        # Nobody knows: either.
        (0.0, 0.008, 0.5, 0.003, True, False),
        # None, and not what the encoder would make it.
        (0.0, 0.008, 0.0, 0.0007, False, False),
    ],
)
def test_a_gain_of_one_wheel_with_the_opposite_asymmetry_is_one_encoder(
    left, right, times_expected, deviation, possible, cause
):
    asymmetry = times_expected * -right / (2.0 + right)
    gains = estimates(wheel_gain__left=left, wheel_gain__right=right)
    assert one_encoder(gains, (asymmetry, deviation), SETTINGS) == (possible, cause)


def test_gains_that_are_hardly_known_are_no_encoder_however_clear_the_asymmetry():
    """As of a MuJoCo robot with larger wheels on the right, whose gains are what scrubbing makes of them."""
    gains = SimpleNamespace(
        by_name={
            "wheel_gain.left": ParameterEstimate(0.0006, -0.012, 0.0132),
            "wheel_gain.right": ParameterEstimate(-0.0043, -0.0154, 0.0069),
        }
    )
    assert one_encoder(gains, (0.0118, 0.0011), SETTINGS) == (True, False)


def test_lateral_offsets_are_one_class():
    assert confounded_with(("lateral_icr", "turn_slip"), False) == {"lateral_icr": ("pose_offset",)}
    assert confounded_with(("wheel_gain",), True) == {"wheel_gain": ("encoder_scale",)}
    assert confounded_with(("wheel_gain",), False) == {}


def gains_that_show(asymmetry, left_deviation=0.002, right_deviation=0.006):
    """Gains of both wheels that an encoder would have with this asymmetry, the left one's alone."""
    value = 2.0 * asymmetry / (1.0 - asymmetry)
    return SimpleNamespace(
        by_name={
            f"wheel_gain.{side}": ParameterEstimate(of, of - 1.96 * deviation, of + 1.96 * deviation)
            for side, of, deviation in (("left", value, left_deviation), ("right", 0.0, right_deviation))
        }
    )


def test_an_encoder_is_possible_within_three_deviations_and_the_cause_where_that_says_three_nats_more_than_none():
    # Of the body 3 per mil, of the gains 4 on the mean: 5 together.
    for sigmas, possible in ((2.9, True), (3.1, False), (-2.9, True), (-3.1, False)):
        value = 0.05 + 0.005 * sigmas
        assert one_encoder(gains_that_show(0.05), (value, 0.003), SETTINGS) == (possible, possible)
    for value, cause in ((0.0134, True), (0.0130, False)):
        # One deviation of 5 per mil away from what it would be.
        assert one_encoder(gains_that_show(value - 0.005), (value, 0.003), SETTINGS) == (True, cause)


@pytest.mark.parametrize("side", ["left", "right"])
def test_without_a_gain_of_either_wheel_no_encoder_is_the_cause(side):
    gains = gains_that_show(0.05)
    del gains.by_name[f"wheel_gain.{side}"]
    assert one_encoder(gains, (0.05, 0.003), SETTINGS) == (False, False)


def test_what_is_missing_beyond_a_delay_and_a_lag_is_said_of_either_channel():
    late, slipping = found(("motor_lag", "command_delay")), found(("slope",))
    with_term = found((), [("u |u|", 30.0)])
    given = found(("slope",), given=("slope",))
    for wheels, body, adds, any_found in (
        (late, None, False, True), (None, slipping, True, True), (late, slipping, True, True),
        (with_term, None, True, True), (with_term, found(()), True, True), (found(()), given, False, False),
    ):  # fmt: skip
        analysis = analysis_of(wheels, body)
        assert (analysis.adds_to_timed, analysis.found_any) == (adds, any_found)


@pytest.fixture
def fitted(monkeypatch):
    """The last fit of an analysis whose encoders are the cause, or not."""
    monkeypatch.setattr(analysed, "estimate_parameters", lambda found: f"estimates of {found.fit}")
    monkeypatch.setattr(analysed, "in_motion", lambda wheels, body: f"{wheels} beside {body}")
    monkeypatch.setattr(analysed, "_with_encoder", lambda body, wheels: (f"{body.fit} with encoder", "its estimates"))

    def made(body, wheels, cause):
        monkeypatch.setattr(analysed, "_encoder", lambda analysis, body, wheels: ((body, wheels), cause))
        parts = [None if name is None else SimpleNamespace(fit=name) for name in (body, wheels)]
        return final_fit(GapAnalysis(None, None, None, *parts))

    return made


def test_the_last_fit_is_that_of_the_body_as_it_was_found_or_with_the_encoders(fitted):
    body, wheels = "estimates of body", "estimates of wheels"
    beside = f"{wheels} beside {body}"
    assert fitted("body", "wheels", False) == FinalFit(body, beside, (body, beside), False, "body", body)
    whole = FinalFit(body, beside, (body, beside), True, "body with encoder", "its estimates")
    assert fitted("body", "wheels", True) == whole
    assert fitted("body", None, True) == FinalFit(body, None, (body, None), True, "body", body)
    assert fitted(None, "wheels", True) == FinalFit(None, wheels, (None, wheels), True, None, None)


def test_encoders_are_asked_for_where_a_gain_was_found_and_both_channels_say_something(monkeypatch):
    asked = []
    monkeypatch.setattr(analysed, "_free_asymmetry", lambda body: (0.3, 0.03))
    monkeypatch.setattr(analysed, "one_encoder", lambda *given: asked.append(given) or ("possible", "cause"))
    drive = SimpleNamespace(settings=DEFAULT_SETTINGS)

    def told(wheels, body, of_body):
        analysis = GapAnalysis(drive, None, None, body, wheels)
        return _encoder(analysis, of_body, None if wheels is None else "of wheels")

    gain, plain = found(("wheel_gain",)), found(("motor_lag",))
    nothing = SimpleNamespace(by_name={})
    assert told(gain, None, None) == (True, False)
    assert told(plain, None, None) == (False, False)
    assert told(None, plain, nothing) == (False, False)
    assert told(plain, plain, nothing) == (False, False)
    assert told(found(("wheel_gain",), given=("wheel_gain",)), plain, nothing) == (False, False)
    assert asked == []
    assert told(gain, plain, nothing) == ("possible", "cause")
    seen = SimpleNamespace(by_name={"wheel_radius_asymmetry.ratio": ParameterEstimate(0.2, 0.2 - 0.196, 0.2 + 0.196)})
    assert told(gain, plain, seen) == ("possible", "cause")
    assert asked[0] == ("of wheels", (0.3, 0.03), SETTINGS)
    assert asked[1] == ("of wheels", (0.2, pytest.approx(0.1)), SETTINGS)


PLACE = {"wheel_radius_asymmetry.ratio": 3, "encoder_scale.left": 1, "encoder_scale.right": 2}


def test_an_asymmetry_that_was_not_found_is_freed_beside_what_was(monkeypatch):
    covariance = np.array([[9.0, 9.0, 2.0], [9.0, 9.0, 3.0], [5.0, 6.0, 0.04]])

    def fit(channel, vector, active):
        assert active == (0, 1, 3)
        return SimpleNamespace(vector=np.array([7.0, 7.0, 7.0, 0.25]), covariance=lambda: covariance)

    monkeypatch.setattr(analysed, "fit", fit)
    monkeypatch.setattr(analysed, "inflation", lambda free, channel, of: 2.25 if of == (3,) else None)
    channel = SimpleNamespace(layout=SimpleNamespace(place=PLACE))
    body = SimpleNamespace(
        selector=SimpleNamespace(channel=channel), fit=SimpleNamespace(vector=np.zeros(4), active=(0, 1))
    )
    assert _free_asymmetry(body) == pytest.approx((0.25, 0.2 * 1.5))


@dataclass(frozen=True)
class Selected:
    """What is looked at of a selector."""

    channel: object
    fits: dict = field(default_factory=dict)
    proofs: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """What is looked at of a body's search."""

    names: tuple
    selector: Selected
    fit: object


def test_with_the_encoders_the_body_has_their_scale_and_no_asymmetry(monkeypatch):
    monkeypatch.setattr(analysed, "fit", lambda channel, vector, active: ("fit", vector.tolist(), active))
    monkeypatch.setattr(analysed, "indices", lambda channel, names: ("free", *names))
    monkeypatch.setattr(analysed, "estimate_parameters", lambda found: found)
    channel = SimpleNamespace(layout=SimpleNamespace(place=PLACE))
    body = Body(
        ("slope", "wheel_radius_asymmetry"), Selected(channel, {"old": 1}, {"old": 1}),
        SimpleNamespace(vector=np.array([0.5, 0.0, 0.0, 0.9])),
    )  # fmt: skip
    gains = SimpleNamespace(layout=SimpleNamespace(place={"wheel_gain.left": 0, "wheel_gain.right": 1}))
    wheels = SimpleNamespace(reported=SimpleNamespace(vector=np.array([0.11, 0.22])), selector=Selected(gains))
    refitted, estimated = _with_encoder(body, wheels)
    assert refitted == ("fit", [0.5, 0.11, 0.22, 0.0], ("free", "slope"))
    assert estimated.names == ("slope",)
    assert (estimated.selector.fits, estimated.selector.proofs) == ({frozenset(("slope",)): refitted}, {})
