"""The buttons' way to the daemon, over a real control socket."""

import threading
import time

import pytest

from disco_hw.daemon.client import ACTIONS
from disco_hw.daemon.control_socket import ControlServer
from disco_hw.viewer.controls import BUTTONS, asking, estop_asking, in_words
from tests.viewer.run import ROBOT_FILE


@pytest.fixture
def socket_dir(tmp_path):
    directory = tmp_path / "run"
    directory.mkdir(mode=0o700)
    return directory


@pytest.fixture
def daemon(socket_dir):
    """A control socket that accepts everything but `arm`; yields its path and what it was asked."""
    server = ControlServer(socket_dir / "control.sock", ACTIONS)
    asked, ending = [], threading.Event()

    def serve():
        while not ending.is_set():
            for message in server.poll():
                asked.append(message.action)
                refused = message.action == "arm"
                server.reply(message, {"ok": not refused, "text": "done it", "error": "not now"})
            time.sleep(0.005)

    thread = threading.Thread(target=serve)
    thread.start()
    yield server.path, asked
    ending.set()
    thread.join()
    server.close()


def test_every_button_asks_the_daemon_and_shows_its_answer(daemon):
    path, asked = daemon
    ask = asking(path)
    answers = {action: ask(action) for action in BUTTONS.values()}
    assert asked == list(BUTTONS.values())
    assert answers["arm"] == "arm refused: not now"
    assert answers["stop"] == "stop: done it"
    assert set(BUTTONS.values()) <= set(ACTIONS)


def test_the_estop_asks_the_daemon_first(daemon, tmp_path):
    path, asked = daemon
    assert estop_asking(path, tmp_path / "none.toml")("estop") == "estop: done it"
    assert asked == ["estop"]


def test_without_a_daemon_the_answer_says_so(tmp_path):
    assert "disco-hw run" in asking(tmp_path / "none.sock")("arm")


def test_without_a_daemon_the_estop_takes_the_link(tmp_path):
    robot = tmp_path / "robot.toml"
    text = ROBOT_FILE.read_text().replace("/tmp/disco-hw-wombot.can", str(tmp_path / "no-bus"))
    robot.write_text(text + f'\n[daemon]\ncontrol_socket = "{tmp_path / "none.sock"}"\n')
    answer = estop_asking(tmp_path / "none.sock", robot)("estop")
    assert "NOT SENT: use the robot's own e-stop button" in answer
    assert "NOT SENT" in estop_asking(tmp_path / "none.sock", tmp_path / "none.toml")("estop")


def test_words():
    assert in_words("stop", {"ok": True}) == "stop: done"
