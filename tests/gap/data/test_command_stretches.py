"""How commands in the stretches of a log are laid beside the wheels, as the clock that stamped them is sought."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import command_timing
from disco_hw.gap.data.command_timing import CommandAlignment, Response, Turned, WheelResponse, command_clock
from disco_hw.gap.data.stamp_clock import StampClock
from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands

SETTINGS = GridSettings(delay_step_s=0.02, most_pose_delay_s=1.0, least_delay_nats=0.05, fewest_samples=60)
COMMANDS = Commands(np.array([0.0, 10.0, 30.0]), np.ones(3), np.ones(3), np.zeros(3))


def pairs(begin_s):
    return Turned(np.asarray(begin_s, dtype=float), *(np.zeros(len(begin_s)),) * 4)


PLAIN = Response()


def beside(begin_s=range(30), first=PLAIN, commands=COMMANDS):
    return CommandAlignment(pairs(begin_s), first, WheelResponse.of(commands, 0.1), SETTINGS)


@pytest.mark.parametrize(("period_s", "stretch_s"), [(0.05, 12.0), (0.1333, 12.0), (0.1334, 12.006), (0.5, 45.0)])
def test_stretches_are_longer_where_speeds_come_less_often(period_s, stretch_s):
    assert beside(period_s * np.arange(90)).stretch_s == pytest.approx(stretch_s)
    assert beside([3.0, 3.0 + period_s]).stretch_s == pytest.approx(stretch_s)
    for few in ([], [3.0]):
        assert beside(few).stretch_s == np.inf


@pytest.mark.parametrize(
    ("asked", "span_s"), [([1, 1, 1], (0, 30)), ([1, 1, None], (0, 10)), ([None, 1, 1], (10, 30)), ([None] * 3, (0, 0))]
)
def test_the_commands_that_are_known_span_what_is_looked_at(asked, span_s):
    commands = replace(COMMANDS, left_rad_s=np.array(asked, dtype=float))
    assert beside(commands=commands).span_s == span_s


@pytest.mark.parametrize(("known", "misfit"), [(True, 3.0), (False, np.inf)])
def test_all_commands_are_laid_as_at_first_sight_or_by_their_corrected_stamps(monkeypatch, known, misfit):
    asked = []

    def response(turned, commands, settings):
        asked.append(commands.t_s.tolist())
        return Response(0.4, 0.1, 3.0, known)

    monkeypatch.setattr(command_timing, "response", response)
    align = beside(first=Response(0.3, 0.1, 5.0, known))
    assert align.fitted(StampClock(0.7)) == (-0.3, 5.0 if known else np.inf)
    assert asked == []
    assert align.fitted(StampClock(0.0, jump_s=2.0, jump_at_s=10.0)) == (-0.4, misfit)
    assert asked == [[1.0, 9.0, 29.0]]


@pytest.fixture
def shown(monkeypatch):
    """A stretch whose misfit is a parabola about a delay, of some depth, from -0.9 s on; and what was asked."""
    asked = []

    def told(at_s, depth, known_s=0.9, begin_s=range(30)):
        asked.clear()

        def misfits(answer, turned, delays, fewest):
            asked.append((turned.begin_s.tolist(), delays))
            assert fewest == SETTINGS.fewest_samples
            there = -np.maximum(depth - 100.0 * (delays - at_s) ** 2, 0.0)
            return np.where(np.abs(delays) <= known_s, there, np.inf)

        monkeypatch.setattr(WheelResponse, "mismatches", misfits)
        return beside(begin_s)

    told.asked = asked
    return told


def test_the_age_of_commands_in_a_stretch_is_minus_the_delay_that_stands_out_in_it(shown):
    assert shown(0.247, 1.0).part_delay_s(5.0, 9.0) == pytest.approx(-0.247, abs=1e-3)
    begin_s, delays = shown.asked[0]
    assert begin_s == [5.0, 6.0, 7.0, 8.0]
    assert delays == pytest.approx(0.04 * np.arange(-25, 26))
    # Within a step of the best of the scan.
    assert all(abs(delays[0] - 0.24) < 0.04 for _, delays in shown.asked[1:])
    assert shown(0.24, 0.051).part_delay_s(5.0, 9.0) == pytest.approx(-0.24, abs=1e-3)
    assert shown(0.24, 0.049).part_delay_s(5.0, 9.0) is None
    assert shown(0.24, 1.0, known_s=-1.0).part_delay_s(5.0, 9.0) is None


def test_the_misfit_of_a_stretch_at_an_age_is_that_of_all_its_pairs(shown):
    align = shown(0.2, 3.0)
    # At 0.1 s of 0.2 s a nat less for each of four.
    assert align.part_mismatch(5.0, 9.0, -0.1) == pytest.approx(-8.0)
    assert [(begin_s, delays.tolist()) for begin_s, delays in shown.asked] == [([5.0, 6.0, 7.0, 8.0], [0.1])]
    assert align.part_mismatch(5.0, 9.0, -0.95) == 0.0


@pytest.mark.parametrize(
    ("first", "told"),
    [
        (Response(0.3, 0.1), ("sought", True)),
        (Response(0.0, 0.1), (StampClock(0.0), True)),
        (Response(0.3, 0.1, known=False), (StampClock(-0.3), False)),
        (Response(0.0, 0.1, known=False), (StampClock(0.0), False)),
    ],
)
def test_a_clock_is_sought_where_a_delay_is_known(monkeypatch, first, told):
    def clock_of(align, settings, least_error_s, least_nats):
        assert (align.first, align.response_model.lag_s) == (first, 0.1)
        assert (least_error_s, least_nats) == (settings.least_link_error_s, settings.least_delay_nats)
        return "sought"

    monkeypatch.setattr(Turned, "of", lambda wheels, settings: pairs([1.0, 2.0]))
    monkeypatch.setattr(command_timing, "response", lambda turned, commands, settings: first)
    monkeypatch.setattr(command_timing, "clock_of", clock_of)
    assert command_clock(None, COMMANDS, SETTINGS) == told
