"""What happens once in a log is told as an event; what holds all the time is none."""

from dataclasses import replace
from functools import cache

import pytest

from disco_hw.effects import Channel
from disco_hw.gap import search_log
from disco_hw.gap.report import events as events_module
from disco_hw.gap.report.events import RareEvent, main_event, rare_events
from disco_hw.gap.report.page import as_text, page, summary_lines
from disco_hw.gap.report.remains import Remains
from disco_hw.model import Model
from tests.gap.report.eventful_robot import driven, moments
from tests.gap.report.test_remains import FLOOR, TIMED, errors
from tests.gap.test_write_report import report_of

MODEL = Model(0.0771, 0.541, 0.05)
LASTING = {"turn_slip_s": 0.1, "lag_s": 0.12, "delay_s": 0.06}


def middle(seed, duration_s, share=0.5):
    """A time (s) about the middle of a log from which the robot drives on for a second."""
    even = moments(seed, duration_s, 1.0)[1]
    return float(even[int(share * len(even))])


def start(seed, duration_s):
    """A time (s) about the middle of a log at which the robot starts from standstill."""
    starts = moments(seed, duration_s, 1.0)[0]
    return float(starts[len(starts) // 2])


@cache
def found(seed, duration_s, **happened):
    analysis, _ = search_log(driven(seed, duration_s, **happened), MODEL)
    names = {name for channel in analysis.channels for name in channel.names}
    return names, rare_events(analysis.channels, ("eventful",), (0.0,))


def is_told(events, begin_s, duration_s, kind, channel):
    (event,) = events
    assert (event.kind, event.channel) == (kind, channel)
    assert event.begin_s == pytest.approx(begin_s, abs=0.3)
    assert 0.5 * duration_s < event.duration_s < 2.0 * duration_s
    return event


def is_blocked(event):
    assert event.side == "left"
    assert event.text.startswith("the left wheels stood for 0.5 s under a command of ")


def is_slip(event):
    assert "less than the wheels say" in event.text
    assert event.side == "body"


def test_each_of_three_events_is_told():
    seed, duration_s = 2, 60.0
    begins_s = middle(seed, duration_s, 0.33), middle(seed, duration_s, 0.67), start(seed, duration_s)
    _, events = found(
        seed, duration_s, blocked=(begins_s[0], 0.5, (0,)), slipping=(begins_s[1], 1.0, 0.4), late=(begins_s[2], 0.4)
    )
    blocked, slip, late = sorted(events, key=lambda event: event.begin_s)
    is_blocked(is_told([blocked], begins_s[0], 0.5, "blocked", "command_to_wheel"))
    is_slip(is_told([slip], begins_s[1], 1.0, "slip", "wheel_to_body"))
    assert is_told([late], begins_s[2], 0.4, "late_start", "command_to_wheel").text.endswith("started 0.4 s late")


ONE_EVENT = pytest.mark.parametrize("seed", [1, 3, 4, 5])


@pytest.mark.thorough
@ONE_EVENT
def test_a_wheel_that_is_blocked_is_told(seed):
    begin_s = middle(seed, 90.0)
    events = found(seed, 90.0, blocked=(begin_s, 0.5, (0,)))[1]
    event = is_told(events, begin_s, 0.5, "blocked", "command_to_wheel")
    is_blocked(event)
    assert event.share > 0.5


@pytest.mark.thorough
@ONE_EVENT
def test_a_start_that_comes_late_is_told(seed):
    begin_s = start(seed, 90.0)
    event = is_told(found(seed, 90.0, late=(begin_s, 0.4))[1], begin_s, 0.4, "late_start", "command_to_wheel")
    assert event.text.endswith("started 0.4 s late")


@pytest.mark.thorough
@ONE_EVENT
def test_a_slip_is_told(seed):
    begin_s = middle(seed, 90.0)
    is_slip(is_told(found(seed, 90.0, slipping=(begin_s, 1.0, 0.4))[1], begin_s, 1.0, "slip", "wheel_to_body"))


# In the quick test three are told, and no more.
@pytest.mark.thorough
@pytest.mark.parametrize(("seed", "duration_s"), [(1, 60.0), *((seed, 90.0) for seed in range(1, 21))])
def test_without_an_event_none_is_told(seed, duration_s):
    assert found(seed, duration_s)[1] == ()


@pytest.mark.thorough
@ONE_EVENT
def test_what_holds_all_the_time_is_no_event(seed):
    names, events = found(seed, 90.0, **LASTING)
    assert {"turn_slip", "motor_lag", "command_delay"} <= names
    assert events == ()


# With this event the search names a speed limit that is none, which makes up for it in part.
SWALLOWED = pytest.param(4, 90.0, marks=pytest.mark.xfail(strict=True, reason="named speed_limit"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("seed", "duration_s"),
    [(1, 60.0), *((seed, 90.0) for seed in (1, 3, 5)), SWALLOWED],
)
def test_an_event_is_told_beside_what_holds_all_the_time(seed, duration_s):
    begin_s = middle(seed, duration_s)
    names, events = found(seed, duration_s, blocked=(begin_s, 0.5, (1,)), **LASTING)
    assert {"turn_slip", "motor_lag", "command_delay"} <= names
    assert is_told(events, begin_s, 0.5, "blocked", "command_to_wheel").share > 0.5


def event_at(begin_s, share, channel=Channel.COMMAND_TO_WHEEL):
    return RareEvent(begin_s, 0.5, channel.value, "left", "blocked", -1.0, "rad", share, "the left wheels stood")


def test_an_event_that_is_most_of_a_channel_s_mismatch_stands_in_place_of_the_regime():
    events = (event_at(3.0, 0.3), event_at(7.0, 0.6))
    assert main_event(events, Channel.WHEEL_TO_BODY) is None
    assert main_event(events, None) is None
    assert main_event(events[:1], Channel.COMMAND_TO_WHEEL) is None
    told = main_event(events, Channel.COMMAND_TO_WHEEL)
    assert told == "at 7.0 s the left wheels stood"
    remains = replace(Remains.of(TIMED, errors(0.05, 0.1), FLOOR, None), event=told)
    assert remains.describe().endswith("Most of the rest is one event: at 7.0 s the left wheels stood.")
    assert remains.as_dict()["event"] == told


def test_the_answer_tells_three_events_in_one_line_and_counts_the_rest():
    plain = report_of("motor_lag", 0.05, 0.02)
    events = tuple(event_at(float(k), share) for k, share in enumerate((0.1, 0.02, 0.3, 0.2)))
    full = replace(plain, events=events)
    (line,) = set(summary_lines(full)) - set(summary_lines(plain))
    said = "; ".join(f"at {k}.0 s the left wheels stood" for k in (0, 2, 3))
    assert line == f"Rare events: {said}. And 1 more, listed below."
    assert len(summary_lines(full)) <= 10
    assert [one["begin_s"] for one in full.as_dict()["events"]] == [0.0, 1.0, 2.0, 3.0]
    assert "event: at 1.0 s the left wheels stood (2% of the mismatch of command_to_wheel)" in as_text(full)
    assert "<h2>Rare events</h2>" in page(full)
    assert "Rare events" not in page(plain)


def test_of_several_logs_an_event_names_its_log_and_the_time_in_it(monkeypatch):
    at_s = (250.0, 20.0, 99.8)
    monkeypatch.setattr(events_module, "_events_of", lambda *_: (event_at(begin_s, 0.6) for begin_s in at_s))
    names, begins_s = ("a.csv", "b <1>.csv", "c.csv"), (0.0, 100.0, 207.8)
    events = rare_events([None], names, begins_s)
    # What begins at the edge belongs where most of it is.
    assert [(event.source, round(event.begin_s, 6)) for event in events] == [
        ("a.csv", 20.0), ("b <1>.csv", -0.2), ("c.csv", 42.2)
    ]  # fmt: skip
    full = replace(report_of("motor_lag", 0.05, 0.02), events=events)
    assert main_event(events[2:], Channel.COMMAND_TO_WHEEL) == "at 42.2 s of c.csv the left wheels stood"
    (line,) = (line for line in summary_lines(full) if line.startswith("Rare events"))
    assert line.startswith("Rare events: at 20.0 s of a.csv the left wheels stood; at -0.2 s of b <1>.csv the left")
    assert "event: at 42.2 s of c.csv the left wheels stood" in as_text(full)
    assert "of b &lt;1&gt;.csv" in page(full)
    assert [one["source"] for one in full.as_dict()["events"]] == list(names)
    # Whose logs begin where is not known, and one log needs no name.
    for one_time in (rare_events([None], names, (0.0,)), rare_events([None], names[:1], (0.0,))):
        assert [event.describe() for event in one_time][-1] == "at 250.0 s the left wheels stood"
