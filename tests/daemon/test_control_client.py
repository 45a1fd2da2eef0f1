import socket
import threading
from contextlib import closing

import pytest

from disco_hw.daemon import send_request
from disco_hw.daemon.control_socket import ControlServer
from disco_hw.errors import WorkError


class Daemon:
    """A control server polled by a thread of its own, answering every request."""

    def __init__(self, path, body):
        self.server = ControlServer(path, ["status", "arm"])
        self.body = body
        self.stopping = threading.Event()
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self):
        while not self.stopping.wait(0.002):
            for message in self.server.poll():
                self.server.reply(message, {"ok": True, "arguments": message.arguments, **self.body})

    def close(self):
        self.stopping.set()
        self.thread.join()
        self.server.close()


@pytest.fixture
def daemon(tmp_path):
    daemon = Daemon(tmp_path / "robot.sock", {})
    yield daemon
    daemon.close()


def raw_server(path, reply):
    """Whatever else may listen there: takes one request, sends `answer`, hangs up."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen(1)

    def serve():
        connection, _ = listener.accept()
        with connection, listener:
            connection.recv(4096)
            connection.sendall(reply)

    thread = threading.Thread(target=serve)
    thread.start()
    return thread


def test_a_request_gets_its_reply(daemon):
    assert send_request(daemon.server.path, {"do": "arm", "why": "test"}) == {
        "do": "arm",
        "ok": True,
        "arguments": {"why": "test"},
    }


def test_a_long_reply_arrives_whole(tmp_path):
    with closing(Daemon(tmp_path / "robot.sock", {"text": "x" * 60_000})) as daemon:
        assert len(send_request(daemon.server.path, {"do": "status"})["text"]) == 60_000


def test_a_refused_request_comes_back_as_a_reply(daemon):
    assert "must be one of" in send_request(daemon.server.path, {"do": "fly"})["error"]


def test_no_daemon_is_one_clear_line(tmp_path):
    with pytest.raises(WorkError, match=r"robot\.sock: no daemon listens there; start it with `disco-hw run`"):
        send_request(tmp_path / "robot.sock", {"do": "status"})


def test_what_a_dead_daemon_left_is_reported_as_no_daemon(tmp_path):
    path = tmp_path / "robot.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    with pytest.raises(WorkError, match="no daemon listens there"):
        send_request(path, {"do": "status"})


def test_a_daemon_that_does_not_answer_is_given_up(tmp_path):
    path = tmp_path / "robot.sock"
    server = ControlServer(path, ["status"])
    with pytest.raises(WorkError, match=r"no answer from the daemon within 0\.05 s"):
        send_request(path, {"do": "status"}, timeout_s=0.05)
    server.close()


def test_a_stranger_that_drips_without_end_is_given_up(tmp_path):
    path = tmp_path / "robot.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen(1)
        given_up = threading.Event()

        def drip():
            connection, _ = listener.accept()
            with connection:
                while not given_up.wait(0.01):
                    connection.sendall(b"x")

        thread = threading.Thread(target=drip)
        thread.start()
        with pytest.raises(WorkError, match="no answer"):
            send_request(path, {"do": "status"}, timeout_s=0.1)
        given_up.set()
        thread.join()


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (b"", "closed the connection"),
        (b"half", "closed the connection"),
        (b"HTTP/1.1 400\n", "is not a disco"),
        (b"5\n", "is not"),
    ],
)
def test_a_stranger_on_the_socket_is_reported(tmp_path, reply, message):
    path = tmp_path / "robot.sock"
    thread = raw_server(path, reply)
    with pytest.raises(WorkError, match=message):
        send_request(path, {"do": "status"})
    thread.join()


def test_a_path_that_cannot_be_is_reported(tmp_path):
    with pytest.raises(WorkError, match="too long"):
        send_request(tmp_path / ("x" * 200), {"do": "status"})
