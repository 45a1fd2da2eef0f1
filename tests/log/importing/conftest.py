"""A robot.toml for the importers."""

import tempfile

import pytest

from tests.inference.drives import ROBOT


@pytest.fixture(scope="module", autouse=True)
def runtime_root():
    """Where sockets would go; importers make none, so that one for all tests of a file does."""
    with tempfile.TemporaryDirectory(prefix="dh-") as name, pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_RUNTIME_DIR", name)
        yield name


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path
