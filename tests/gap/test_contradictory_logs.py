"""`gap` on logs that contradict themselves: refused with the cause before any search, or warned of first."""

import re

import pytest

from disco_hw import gap
from disco_hw.errors import LogError
from disco_hw.gap import find_gap
from disco_hw.gap.report import GapReport
from disco_hw.gap.report.page import as_text, page
from disco_hw.log.consistency import find_contradictions
from disco_hw.model import Model
from tests.log.contradictory_drives import AXIAL_M, FAULTS, RADIUS_M, sound

MODEL = Model(RADIUS_M, AXIAL_M)


class SearchedError(Exception):
    """Ends the command where the search would begin."""


@pytest.fixture(autouse=True)
def no_search(monkeypatch):
    def search(*_):
        raise SearchedError

    monkeypatch.setattr(gap, "search_log", search)


WARNED_OF = {"a heading that stops for a third", "encoders doubled, no commands"}
QUICK = {"a heading that stops for a third", "y mirrored"}


@pytest.mark.parametrize(
    "fault",
    [pytest.param(fault, marks=() if fault in QUICK else pytest.mark.thorough) for fault in sorted(FAULTS)],
)
def test_what_says_nothing_is_refused_before_the_search_and_the_rest_is_searched(fault):
    change, _, hint = FAULTS[fault]
    log = change(sound())
    spoilt = any(each.spoils for each in find_contradictions(log, RADIUS_M, AXIAL_M))
    assert spoilt == (fault not in WARNED_OF)
    with pytest.raises(LogError if spoilt else SearchedError, match=re.escape(hint) if spoilt else None):
        find_gap(log, MODEL)


def test_a_sound_log_is_searched():
    with pytest.raises(SearchedError):
        find_gap(sound(), MODEL)


def test_a_warning_stands_first_in_every_form_of_the_report():
    warned = GapReport((), (), (), (), (), {}, MODEL, 0.0, warnings=("a.csv: the wheels count <2> times",))
    assert as_text(warned).splitlines()[0] == "warning: a.csv: the wheels count <2> times"
    assert list(warned.as_dict())[:2] == ["verdict", "warnings"]
    html = page(warned)
    assert html.index("the wheels count &lt;2&gt; times") < html.index('class="answer"')
