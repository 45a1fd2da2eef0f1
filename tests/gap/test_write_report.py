"""What the command hands to the search."""

from pathlib import Path
from types import SimpleNamespace

import pytest

import disco_hw
from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.gap import find


class EnoughError(Exception):
    """Ends the command where the search would begin."""


def test_the_search_knows_what_the_robot_can_do(monkeypatch, tmp_path):
    handed = SimpleNamespace()

    def search(*_, **options):
        vars(handed).update(options)
        raise EnoughError

    monkeypatch.setattr(find, "load_drive", lambda *_: None)
    monkeypatch.setattr(find, "find_gap", search)
    robot = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
    with pytest.raises(EnoughError):
        find.gap([], robot, tmp_path)
    assert handed.top_rad_s == load_robot_config(robot).robot.max_wheel_speed_rad_s


def test_a_directory_that_cannot_be_used_is_refused_before_the_search(monkeypatch, tmp_path):
    def search(*_, **__):
        raise EnoughError

    monkeypatch.setattr(find, "load_drive", search)
    robot = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
    given = tmp_path / "model.toml"
    given.write_bytes((robot.parent / "wombot_model.toml").read_bytes())
    with pytest.raises(InputError, match="is there and is no directory"):
        find.gap([], robot, given)
    with pytest.raises(InputError, match=r"model\.toml: would be written over, and is read here"):
        find.gap([], robot, tmp_path, given)
    with pytest.raises(EnoughError):
        find.gap([], robot, tmp_path / "gap", given)
