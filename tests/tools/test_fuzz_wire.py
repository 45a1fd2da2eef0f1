import random

import pytest

from tools.check import fuzz_wire
from tools.check.fuzz_wire import TARGETS, campaign


@pytest.mark.parametrize("frames", [500, pytest.param(1500, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("name", TARGETS)
def test_a_short_campaign_is_sound(name, frames):
    assert campaign(name, frames, 1) == []


def test_what_raises_or_keeps_what_it_is_given_is_reported(monkeypatch):
    kept = []

    def keep(generator: random.Random):
        kept.append(generator.randbytes(1000))

    def fail(generator: random.Random):
        raise IndexError("a bug")

    monkeypatch.setitem(fuzz_wire.TARGETS, "keeper", lambda: keep)
    monkeypatch.setitem(fuzz_wire.TARGETS, "failing", lambda: fail)
    assert "memory grew" in campaign("keeper", 1000, 1)[0]
    assert "IndexError: a bug" in campaign("failing", 10, 1)[0]
