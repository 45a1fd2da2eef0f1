"""The floor as text: where a point comes to lie, and what does not belong to it."""

import math

import pytest

from disco_hw.experiments.circle_report import circle_points, picture
from disco_hw.experiments.demo import DemoOptions, what_next


def test_corners_come_to_lie_in_the_corners():
    lines = picture([[(0.01, 0.99), (0.99, 0.01)]], (0.0, 0.0), (1.0, 1.0), 2)
    assert lines == ["\u2801", "\u2800\u2800\u2800\u2880"]


def test_what_is_outside_or_no_number_is_left_out():
    assert picture([[(2.0, 0.5), (math.nan, 0.5)]], (0.0, 0.0), (1.0, 1.0), 3) == ["", "", ""]


def test_a_circle_is_as_wide_as_it_is_high():
    lines = picture([circle_points((0.0, 0.0), 1.0, 400)], (-1.1, -1.1), (1.1, 1.1), 12)
    inked = [line for line in lines if line]
    assert max(map(len, lines)) == pytest.approx(2 * len(inked), abs=2)


def test_corners_that_are_one_are_refused():
    with pytest.raises(ValueError, match="apart"):
        picture([], (0.0, 0.0), (0.0, 1.0), 3)


def test_the_end_says_what_to_type_and_every_verb_of_it_is_there(tmp_path):
    from disco_hw.cli import app

    verbs = {(command.name or command.callback.__name__).replace("_", "-") for command in app().registered_commands}
    verbs |= {group.name for group in app().registered_groups}
    lines = what_next(DemoOptions(), tmp_path / "demo.mcap", tmp_path / "circle.png")
    typed = [line.split()[1] for line in lines if line.startswith("  disco-hw ")]
    assert set(typed) <= verbs
    assert len(typed) == 5
