"""Whose a directory is: the rule, with real files."""

import os
from pathlib import Path

import pytest

from drivers.ownership import placed_by, user_name, why_not_private

ME = os.geteuid()


def test_a_directory_of_ones_own_is_private(tmp_path):
    tmp_path.chmod(0o755)
    assert why_not_private(tmp_path, {ME}) is None


def test_a_directory_of_another_user_is_told_with_its_owner(tmp_path):
    assert why_not_private(tmp_path, {ME + 1}) == f"belongs to {user_name(ME)}"
    assert user_name(0) == "root (0)"
    assert user_name(4_000_000) == "user 4000000"


@pytest.mark.parametrize("mode", [0o775, 0o757, 0o1777])
def test_what_others_can_write_to_is_not_private(tmp_path, mode):
    tmp_path.chmod(mode)
    assert "others can write" in why_not_private(tmp_path, {ME})


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert "a link" in why_not_private(tmp_path / "link", {ME})


def test_a_directory_below_one_that_others_can_write_to_can_have_been_put_there(tmp_path):
    middle = tmp_path / "middle"
    inner = middle / "inner"
    inner.mkdir(parents=True, mode=0o700)
    middle.chmod(0o777)
    assert not placed_by(inner, {ME, 0})
    assert not placed_by(Path("/tmp/any"), {ME, 0})
    assert placed_by(Path("/usr/lib/any"), {0})
