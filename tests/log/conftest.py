import tempfile
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def runtime_root(monkeypatch):
    """Where sockets go; not below tmp_path, since the path of a socket must be short."""
    with tempfile.TemporaryDirectory(prefix="dh-") as name:
        monkeypatch.setenv("XDG_RUNTIME_DIR", name)
        yield Path(name)
