"""A name that only acts like what is missing is disputed, with the reason."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.report.misspecification import _answers_otherwise, _apart, disputed_names
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.search.unnamed_terms import motion
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import body_channel, body_on, line_of, poses_of, searched, selector_of, vector_of

# Turns at four rates: at two of them a wrong axial distance makes up for any form.
DRIVE = ((4, 4), (0, 0), (-1, 1), (1, -1), (-2, 2), (2, -2), (-3.5, 3.5), (3.5, -3.5), (-6, 6), (6, -6), (3, 6), (6, 3))


def aside(of_left_m, of_right_m):
    """What is found of a robot that turns about a point so far to its left, in turns to the left and to the right."""
    line, truth = line_of(np.repeat(np.array(DRIVE * 3, dtype=float), 200, axis=0)), vector_of()
    rate = motion(line, truth)[1]
    ahead = np.where(rate > 0.0, of_left_m, of_right_m) * rate
    poses = poses_of(line, truth, np.column_stack([ahead, np.zeros((rate.size, 2))]), seed=5)
    return searched(body_on(line, poses), ("lateral_icr",))


def test_a_name_whose_value_is_another_where_the_robot_drives_differently_is_disputed():
    (why,) = disputed_names(aside(0.05, 0.0)).values()
    assert why.startswith("something acts like it and has another form: lateral_icr.offset_m is ")
    small, large = (float(part.split()[0]) for part in why.split(" is ")[1].split(" and "))
    assert abs(large - small) > 0.02
    # A third of it more on one side is the same name still.
    assert disputed_names(aside(0.05, 0.035)) == {}
    assert disputed_names(aside(0.05, 0.05)) == {}


def test_what_the_model_has_is_not_disputed():
    found = aside(0.05, 0.0)
    assert disputed_names(replace(found, selector=replace(found.selector, given=("lateral_icr",)))) == {}


@pytest.mark.parametrize(("offset_m", "disputed"), [(0.0, False), (0.1, True)])
def test_a_name_that_takes_little_of_what_its_channel_lacks_is_disputed(offset_m, disputed):
    channel, _ = body_channel(turn_slip=0.02, lateral_icr=offset_m)
    selector = selector_of(channel)
    richest = selector.fit(("turn_slip", "lateral_icr")).residual
    found = ChannelResult(selector, ("turn_slip",), channel, richest=richest, richest_parameters=6)
    why = disputed_names(found).get("turn_slip", "")
    assert ("it takes " in why and " % of what its channel lacks" in why) == disputed
    assert disputed or not why


def test_a_value_in_two_regimes_is_what_each_says_and_as_far_apart_as_its_blocks_scatter():
    generator, settings = np.random.default_rng(3), DEFAULT_SETTINGS
    slope, block = generator.standard_normal((4000, 2)), np.repeat(np.arange(200), 20)
    one = np.repeat(generator.random(200) < 0.4, 20)
    noise = generator.standard_normal(4000)

    def apart(true_shift, noise, inside=(one, ~one)):
        # A residual is what was measured less what was predicted: a value that is larger by d leaves -d of its slope.
        left = noise - slope[:, 0] * np.where(one, true_shift[0], true_shift[1])
        best = Fit(np.zeros(2), (0, 1), 0.0, left - slope @ np.linalg.lstsq(slope, left, rcond=None)[0], slope)
        return _apart(best, block, 0, inside, settings)

    first, second, sigmas = apart((0.5, -0.5), noise)
    assert first - second == pytest.approx(1.0, abs=0.1)
    # 0.4 and 0.6 of 4000 samples of unit noise and slope.
    assert sigmas == pytest.approx(1.0 / np.sqrt(1.0 / 1600 + 1.0 / 2400), rel=0.15)
    assert abs(apart((0.2, 0.2), noise)[2]) < 3.0
    # Noise that is as the slope in whole blocks at a time tells less than its samples seem to.
    bursts = noise + 0.7 * slope[:, 0] * np.repeat(generator.standard_normal(200), 20)
    assert abs(apart((0.5, -0.5), bursts)[2]) < 0.6 * abs(sigmas)
    assert apart((0.5, -0.5), noise, (np.arange(4000) < 100, ~one)) is None
    # Noise that happens to agree from block to block is no better known than samples of its size allow.
    assert abs(apart((0.5, -0.5), 0.01 * noise)[2]) == pytest.approx(abs(sigmas), rel=0.15)


def test_values_that_scatter_as_noise_does_are_not_called_different(monkeypatch):
    found, asked = aside(0.05, 0.0), []

    def apart(best, block, place, inside, settings):
        asked.append(place)
        return 0.02, -0.02, times * settings.report.form_apart_sigmas

    monkeypatch.setattr("disco_hw.gap.report.misspecification._apart", apart)
    times = 0.95
    assert disputed_names(found) == {}
    times = -1.05
    assert disputed_names(found) != {}
    assert asked


@pytest.mark.parametrize("timed", [True, False])
def test_of_wheels_that_answer_like_no_lag_a_delay_is_disputed(timed):
    found = SimpleNamespace(channel=SimpleNamespace(drive=SimpleNamespace(commands_timed=timed)))
    assert [_answers_otherwise(found, name) is None for name in ("motor_lag", "command_delay", "stiction")] == [
        timed,
        timed,
        True,
    ]
