"""Fields of a robot.toml changed in its text."""

import tomllib

import pytest
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


ONE_AND_FURTHER = """[pose]
source = "udp"
{between}
yaw_offset_rad = 0.0  # of the further one
[task]
yaw_offset_rad = 3.0
"""


@pytest.mark.parametrize(
    "between",
    [
        "[[pose.also]]",
        "  [[ pose . also ]]  # two antennas [pose]",
        "[pose.more]",
        "[ 'pose'.more ]# [pose]",
        "[[pose.also]]\n[pose.also.more]",
    ],
)
def test_a_field_of_a_further_source_or_a_table_within_stays(between):
    text = ONE_AND_FURTHER.format(between=between)
    expected = tomllib.loads(text)
    expected["pose"]["yaw_offset_rad"] = 1.5
    assert tomllib.loads(with_fields(text, {("pose", "yaw_offset_rad"): 1.5})) == expected


@pytest.mark.parametrize("header", ["[pose]#", "  [ pose ]  # [[pose]]", '["pose"]'])
def test_a_header_is_found_however_it_is_written(header):
    text = f"[[task.also]]\nclockwise = false\n{header}\nport = 5005\nclockwise = false\n"
    changed = with_fields(text, {("pose", "clockwise"): True})
    assert tomllib.loads(changed)["pose"] == {"port": 5005, "clockwise": True}
    assert changed.count("\n") == text.count("\n")


@pytest.mark.parametrize(
    "value",
    [
        "[\n  [0.0, 1.0],\n  [2.0, 3.0]\n]",
        "[\n  [pose]\n]".replace("pose", '"pose"'),
        '[\n["pose"],\n["task"]  # last\n, []]',
        '"""\n[pose]\nclockwise = false\n[task]\n"""',
        "'''\n[[pose]]\nclockwise = 1\n'''",
    ],
)
def test_a_value_that_looks_like_a_header_is_a_value(value):
    text = f"[fence]\nkeep_in = {value}\n[pose]\nalso = {value}\nclockwise = false\n[task]\n"
    expected = tomllib.loads(text)
    expected["pose"]["clockwise"] = True
    assert tomllib.loads(with_fields(text, {("pose", "clockwise"): True})) == expected


@given(st.text(st.characters(exclude_categories=("Cs", "Cc"))))
def test_any_text_comes_back_as_it_was(text):
    assert tomllib.loads(f"x = {in_toml(text)}") == {"x": text}
