import pytest

from disco_hw.viewer.recording import Recording
from disco_hw.viewer.timeline import Timeline
from tools.browser import chromium
from tools.viewer_run import tick_records, write_log


@pytest.fixture
def timeline():
    line = Timeline()
    for tick in range(200):
        now_ns, got = tick_records(tick)
        for record in got:
            line.add(now_ns, record)
    return line


@pytest.fixture(scope="session")
def log_file(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("run") / "run.mcap")


@pytest.fixture
def recording(log_file):
    with Recording(log_file) as opened:
        yield opened


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started
