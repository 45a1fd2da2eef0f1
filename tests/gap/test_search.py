"""Of a floor that is different from some time on, and one that is different at some place, the right one is told."""

from functools import cache

import pytest

from disco_hw.gap.candidates import CHANGE
from disco_hw.gap.classes import PATCH, alike
from disco_hw.gap.layout import BODY
from disco_hw.gap.search import search_body
from disco_hw.gap.timeline import timeline
from tools.gap_logs import simulated_drive

pytestmark = pytest.mark.long


@cache
def found_in(name, values, seed):
    start = BODY.neutral.copy()
    start[:3] = 0.061, 0.415, 0.238
    return search_body(timeline(simulated_drive({name: values}, seed=seed)), start)


def test_a_patch_that_is_entered_again_is_a_patch():
    found = found_in("x_carpet_patch", (0.28,), 503)
    assert CHANGE not in found.names
    x, y, radius = found.unnamed[0].term.disc
    assert (x, y, radius) == pytest.approx((0.5, 0.0, 0.75), abs=0.45)


def test_a_change_is_a_change():
    found = found_in(CHANGE, (0.16, 58.0, -0.03), 502)
    assert found.names == (CHANGE,)
    assert not found.unnamed
    assert not found.patch


def test_a_change_that_may_be_a_patch_is_reported_with_it():
    assert alike((CHANGE,), False, patch_possible=True) == {CHANGE: (PATCH,)}
    assert alike((CHANGE,), False) == {}
