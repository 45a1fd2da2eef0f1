"""Fields of a robot.toml changed in its text."""

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from disco_hw.first_use import in_toml, with_fields

TEXT = """# a robot
[robot]
name = "a"   # its name
[wheels]  # the wiring
motor_direction = [1, 1] # left, right

[pose]
port = 5005
"""


def test_a_value_changes_and_its_comment_stays():
    assert 'name = "b"   # its name\n' in with_fields(TEXT, {("robot", "name"): "b"})
    assert "motor_direction = [1, -1] # left, right\n" in with_fields(TEXT, {("wheels", "motor_direction"): [1, -1]})


def test_what_is_not_there_comes_into_its_section_or_a_new_one():
    changed = with_fields(TEXT, {("pose", "clockwise"): True, ("drive", "speed_share"): 0.5})
    assert tomllib.loads(changed) == {
        **tomllib.loads(TEXT),
        "pose": {"port": 5005, "clockwise": True},
        "drive": {"speed_share": 0.5},
    }


@given(st.text(st.characters(exclude_categories=("Cs", "Cc"))))
def test_any_text_comes_back_as_it_was(text):
    assert tomllib.loads(f"x = {in_toml(text)}") == {"x": text}
