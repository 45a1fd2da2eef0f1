"""The e-stop of the page while another user of the machine holds 4000 connections to it, with few descriptors."""

import os
import resource
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.drivers.waiting import free_port, wait_until
from tests.viewer.test_operator_controls import COOKIES, Daemon, line_to, request_reply
from tests.viewer.test_server import get
from tools.viewer_run import ROBOT_FILE

TOKEN = "a-token-of-the-test"
CONNECTIONS, PRESSES = 4000, 12


@contextmanager
def limited_page(robot, output, descriptors):
    """The live page of `robot` in a process that may open so many files; its port. What it says goes to `output`."""
    port = free_port()
    command = [sys.executable, "-m", "disco_hw.viewer.commands", str(os.getpid()), "127.0.0.1", str(port), str(robot)]
    with output.open("wb") as sink:
        page = subprocess.Popen(
            [*command, "", ""], stdout=sink, stderr=sink, env=os.environ | {"DISCO_HW_PAGE_TOKEN": TOKEN}
        )
    resource.prlimit(page.pid, resource.RLIMIT_NOFILE, (descriptors, descriptors))
    try:
        wait_until(lambda: b"?token=" in output.read_bytes(), 60.0)
        COOKIES[port] = f"disco-hw-token-{port}={TOKEN}"
        yield port
    finally:
        page.terminate()
        page.wait()


@contextmanager
def page_process(directory, descriptors):
    """A page that may open so many files, beside a daemon; the daemon, the port and what the page says."""
    daemon = Daemon(directory / "run")
    shutil.copytree(ROBOT_FILE.parent, directory / "robots")
    robot = directory / "robots" / ROBOT_FILE.name
    text = ROBOT_FILE.read_text()
    assert "[daemon]" not in text
    robot.write_text(f'{text}\n[daemon]\ncontrol_socket = "{daemon.server.path}"\n')
    output_file = directory / "said.txt"
    try:
        with limited_page(robot, output_file, descriptors) as port:
            yield daemon, port, output_file
    finally:
        daemon.close()


@contextmanager
def attack(port):
    with subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("attacker.py")), str(port), str(CONNECTIONS)],
        stdout=subprocess.PIPE,
    ) as attacker:
        try:
            assert attacker.stdout.readline() == b"open\n"
            yield
        finally:
            attacker.kill()


@pytest.mark.long
@pytest.mark.parametrize("descriptors", [1024, 256])
def test_every_press_reaches_the_daemon_and_new_pages_get_in_during_an_attack(tmp_path, descriptors):
    with page_process(tmp_path, descriptors) as (daemon, port, output_file), line_to(port) as line:
        request_reply(line, do="stop")
        with attack(port):
            for press in range(PRESSES):
                # A machine that is busy with other things may confirm late; it is sent all the same.
                assert "NOT SENT" not in str(request_reply(line, do="estop"))
                assert daemon.actions("status", "drive").count("estop") > press
            assert get(port, "/", Cookie=COOKIES[port])[0].status == 200
            with line_to(port) as another:
                assert "NOT SENT" not in str(request_reply(another, do="estop"))
        assert len(output_file.read_bytes()) < 20_000
