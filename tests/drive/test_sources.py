"""Tests of what all sources promise: input that is older than the limit no longer drives."""

import pytest

from disco_hw.drive import INPUT_LIMIT_NS, ManualInput, RobotView
from disco_hw.runtime import State


def test_input_counts_for_200_ms():
    assert INPUT_LIMIT_NS == 200_000_000


def test_what_was_said_cannot_be_changed():
    manual, seen = ManualInput(1, 0.0, 0.0, deadman=False), RobotView(State.READY, driving=False)
    with pytest.raises(AttributeError):
        manual.deadman = True
    with pytest.raises(AttributeError):
        seen.driving = True
