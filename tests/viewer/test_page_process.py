import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from disco_hw.viewer import TOKEN_VARIABLE, PageProcess, page_in_background
from tests.drivers.waiting import free_port, wait_until
from tools.viewer_run import ROBOT_FILE

_PARENT = """
import sys, time
from pathlib import Path
from disco_hw.viewer import page_in_background
with page_in_background(Path(sys.argv[1]), None, "127.0.0.1", int(sys.argv[2])) as page:
    print(page.pid, flush=True)
    time.sleep(60)
"""


def listens(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def state_of(pid):
    """State of a process: Z for a zombie, T for one that is stopped; empty where there is none."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.read_text().rpartition(")")[2].split()[0] if stat.exists() else ""


def test_the_page_lives_as_long_as_the_block_and_prints_on_standard_error_alone(capfd):
    port = free_port()
    captured = []
    with page_in_background(ROBOT_FILE, None, "127.0.0.1", port) as page:
        wait_until(
            lambda: captured.append(capfd.readouterr()) or f":{port}/" in "".join(it.err for it in captured), 60.0
        )
        wait_until(lambda: listens(port), 60.0)
        assert os.getsid(page.pid) == page.pid
        assert f"?token={page._environment[TOKEN_VARIABLE]}\n" in "".join(it.err for it in captured)
    assert page.returncode == 0
    assert not listens(port)
    captured.append(capfd.readouterr())
    assert not any(it.out for it in captured)


def test_the_page_ends_when_its_parent_is_killed():
    port = free_port()
    parent = subprocess.Popen(
        [sys.executable, "-c", _PARENT, str(ROBOT_FILE), str(port)], stdout=subprocess.PIPE, text=True
    )
    pid = int(parent.stdout.readline())
    wait_until(lambda: listens(port), 60.0)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until(lambda: state_of(pid) in {"", "Z"}, 60.0)


def test_a_page_that_ends_by_itself_is_reported_and_not_started_again():
    page = slim_page("raise SystemExit(2)")
    try:
        assert page.wait(60) == 2
        assert page.new_messages() == ("the page ended with exit code 2; start it again with `disco-hw view`",)
    finally:
        page.close()


@pytest.mark.thorough
def test_a_page_that_cannot_start_is_reported_and_not_started_again(tmp_path, capfd):
    with page_in_background(tmp_path / "none.toml", None, "127.0.0.1", 0) as page:
        assert page.wait(60) == 2
        assert page.new_messages() == ("the page ended with exit code 2; start it again with `disco-hw view`",)
    assert "none.toml" in capfd.readouterr().err


@pytest.mark.thorough
def test_the_link_that_the_daemon_was_given_is_the_pages_too(capfd):
    with page_in_background(ROBOT_FILE, None, "127.0.0.1", 0, "carrier pigeon") as page:
        assert page.wait(60) == 2
    assert "--link carrier pigeon" in capfd.readouterr().err


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_what_the_block_raises_is_passed_on(error):
    with pytest.raises(error), page_in_background(ROBOT_FILE, None, "127.0.0.1", free_port()):
        raise error


def slim_page(program):
    """A stand-in for the page's process that starts at once."""
    return PageProcess([sys.executable, "-S", "-c", program])


def test_a_killed_page_is_started_again_under_the_same_token(capfd):
    output = ["", ""]

    def tokens():
        output[:] = [before + new for before, new in zip(output, capfd.readouterr(), strict=True)]
        return re.findall(r"token=(\S+)\n", output[0])

    page = slim_page(f"import os, time; print('token=' + os.environ['{TOKEN_VARIABLE}'], flush=True); time.sleep(60)")
    try:
        wait_until(lambda: len(tokens()) == 1, 60.0)
        first = page.pid
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: len(tokens()) == 2, 60.0)
        assert len(set(tokens())) == 1
        assert not Path(f"/proc/{first}").exists(), "a zombie is left"
        assert page.new_messages() == ("the page was ended by SIGKILL; it is started again",)
        assert page.new_messages() == ()
    finally:
        page.close()
    assert page.returncode == -signal.SIGTERM
    assert "page: the page was ended by SIGKILL; it is started again" in output[1]


def test_a_page_that_hangs_is_killed():
    page = slim_page("import time; time.sleep(60)")
    os.kill(page.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(page.pid) == "T")
    page.close()
    assert page.returncode == -signal.SIGKILL
