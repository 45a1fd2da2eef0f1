"""Tests of what all sources promise: input that is older than the limit no longer drives."""

import pytest

from disco_hw.drive import INPUT_LIMIT_NS, GamepadSource, ManualInput, ManualSource, PageSource, RobotView
from disco_hw.drive.script import ScriptSource
from disco_hw.drive.terminal import Keyboard
from disco_hw.runtime import State


def test_input_counts_for_200_ms():
    assert INPUT_LIMIT_NS == 200_000_000


@pytest.mark.parametrize("source", [GamepadSource, Keyboard, PageSource, ScriptSource])
def test_every_source_has_all_that_the_pilot_asks_for(source):
    required = [name for name in vars(ManualSource) if not name.startswith("_")]
    assert sorted(required) == ["close", "completed", "ended", "poll", "status_text", "task"]
    assert all(hasattr(source, name) for name in required)


def test_what_was_said_cannot_be_changed():
    manual, seen = ManualInput(1, 0.0, 0.0, deadman=False), RobotView(State.READY, driving=False)
    with pytest.raises(AttributeError):
        manual.deadman = True
    with pytest.raises(AttributeError):
        seen.driving = True
