"""A robot.toml for the importers."""

import pytest

from tests.inference.test_infer_command import ROBOT


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path
