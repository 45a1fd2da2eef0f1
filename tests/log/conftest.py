import tempfile
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def runtime_root(monkeypatch):
    """Where sockets go; not below tmp_path, since the path of a socket must be short."""
    with tempfile.TemporaryDirectory(prefix="dh-") as name:
        monkeypatch.setenv("XDG_RUNTIME_DIR", name)
        yield Path(name)


@pytest.fixture
def forked_keepers(monkeypatch):
    # Mutants of what these modules do when they are imported are tried where a test is the first to import them.
    from disco_hw.log import writer_link
    from tests.log.processes import ForkedKeeper

    monkeypatch.setattr(writer_link, "spawn_at_normal_priority", ForkedKeeper)
