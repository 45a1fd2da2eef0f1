import socket
import threading
from contextlib import closing

import pytest

from disco_hw.daemon import send_request
from disco_hw.daemon.control_socket import ControlServer
from disco_hw.errors import WorkError
from tests.daemon.control_daemon import ControlDaemon

STATUS = {"do": "status"}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "robot.sock"


def raw_server(path, reply):
    """Whatever else may listen there: takes one request, sends `reply`, hangs up."""
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


def test_a_request_gets_its_reply_however_long_and_a_refused_one_what_is_wrong(path):
    reply = {"ok": True, "text": "x" * 60_000}
    with closing(ControlDaemon(path, lambda message: {**reply, "arguments": message.arguments})):
        arguments = {"why": "test"}
        assert send_request(path, {"do": "arm", **arguments}) == {"do": "arm", "arguments": arguments, **reply}
        assert "must be one of" in send_request(path, {"do": "fly"})["error"]


def test_no_daemon_is_one_clear_line(path):
    with pytest.raises(WorkError, match=r"robot\.sock: no daemon listens there; start it with `disco-hw run`"):
        send_request(path, STATUS)


def test_what_a_dead_daemon_left_is_reported_as_no_daemon(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    with pytest.raises(WorkError, match="no daemon listens there"):
        send_request(path, STATUS)


def test_a_daemon_that_does_not_answer_is_given_up(path):
    with (
        closing(ControlServer(path, ["status"])),
        pytest.raises(WorkError, match=r"no answer from the daemon within 0\.05 s"),
    ):
        send_request(path, STATUS, timeout_s=0.05)


def test_a_stranger_that_drips_without_end_is_given_up(path):
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
            send_request(path, STATUS, timeout_s=0.1)
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
def test_a_stranger_on_the_socket_is_reported(path, reply, message):
    thread = raw_server(path, reply)
    with pytest.raises(WorkError, match=message):
        send_request(path, STATUS)
    thread.join()


def test_a_path_that_cannot_be_is_reported(tmp_path):
    with pytest.raises(WorkError, match="too long"):
        send_request(tmp_path / ("x" * 200), STATUS)
