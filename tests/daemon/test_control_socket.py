import json
import os
import resource
import shutil
import signal
import socket
import stat
import tempfile
import time
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
from hypothesis import strategies as st

from disco_hw.daemon.control_socket import ControlServer, refuse_served
from disco_hw.errors import InputError
from tests.tables import examples

ACTIONS = ("arm", "start", "stop", "disarm", "estop", "reset", "status", "set_task")


def served(folder):
    return closing(ControlServer(folder / "private" / "robot.sock", ACTIONS))


@pytest.fixture
def server(tmp_path):
    with served(tmp_path) as server:
        yield server


def connect(server):
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(5.0)
    connection.connect(str(server.path))
    return connection


def send(connection, *requests):
    connection.sendall(b"".join(json.dumps(request).encode() + b"\n" for request in requests))


def lines_from(connection):
    return [json.loads(line) for line in connection.recv(1 << 20).splitlines()]


def polled(server):
    """The actions that a poll hands over."""
    return [message.action for message in server.poll()]


def assert_takes_an_estop(server):
    with connect(server) as client:
        send(client, {"do": "estop"})
        assert polled(server) == ["estop"]


@contextmanager
def without_a_free_descriptor():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    taken = []
    try:
        with suppress(OSError):
            while True:
                taken.append(os.dup(0))
        yield
    finally:
        for descriptor in taken:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_estop_gets_in_where_no_file_can_be_opened_any_more(server):
    with connect(server) as first, connect(server) as second, without_a_free_descriptor():
        for client in (first, second):
            send(client, {"do": "estop"})
            assert polled(server) == ["estop"]


def hung_up(connection):
    with suppress(ConnectionResetError):
        while connection.recv(1 << 16):
            pass
    return True


@contextmanager
def serving_elsewhere(path, with_child=False):
    """Serve at `path` in another process, and perhaps a child of its; yields its id, and kills both at the end."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            os.setsid()
            _server = ControlServer(path, ["status"])
            if not with_child or os.fork() == 0:
                os.write(writing, b"!")
            time.sleep(60)
        finally:
            os._exit(1)
    os.close(writing)
    try:
        assert os.read(reading, 1) == b"!"
        yield process
    finally:
        os.close(reading)
        with suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)


def kill(process):
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)


# --- requests and replies ---------------------------------------------------------------------------------------------


def test_a_request_arrives_with_its_arguments_and_gets_its_reply(server):
    with connect(server) as client:
        assert server.poll() == []
        send(client, {"do": "set_task", "kind": "circle", "radius_m": 0.5})
        (message,) = server.poll()
        assert (message.action, message.arguments) == ("set_task", {"kind": "circle", "radius_m": 0.5})
        server.reply(message, {"ok": True, "text": "set"})
        assert lines_from(client) == [{"do": "set_task", "ok": True, "text": "set"}]


def test_a_request_in_pieces_is_put_together(server):
    with connect(server) as client:
        for piece in (b'{"d', b'o": "sta', b'tus"}'):
            client.sendall(piece)
            assert server.poll() == []
        client.sendall(b"\n\n  \n")
        assert polled(server) == ["status"]


def test_replies_that_are_not_numbers_are_still_json(server):
    with connect(server) as client:
        send(client, {"do": "status"})
        server.reply(server.poll()[0], {"ok": True, "age_s": float("nan")})
        assert lines_from(client)[0]["age_s"] is None


def test_a_client_that_shuts_its_sending_end_still_gets_its_reply_and_is_then_let_go(server):
    with connect(server) as client:
        send(client, {"do": "status"})
        client.shutdown(socket.SHUT_WR)
        (message,) = server.poll()
        server.reply(message, {"ok": True})
        assert lines_from(client) == [{"do": "status", "ok": True}]
        server.poll()
        assert hung_up(client)


def test_a_reply_to_a_client_that_has_gone_is_no_error(server):
    with connect(server) as client:
        send(client, {"do": "status"})
        (message,) = server.poll()
    server.reply(message, {"ok": True})
    server.poll()
    server.reply(message, {"ok": True})


# --- e-stop first -----------------------------------------------------------------------------------------------------


def test_estop_comes_first_across_clients_and_within_one(server):
    with connect(server) as eager, connect(server) as worried:
        send(eager, {"do": "arm"}, {"do": "start"}, {"do": "status"}, {"do": "status"}, {"do": "status"})
        send(worried, {"do": "status"}, {"do": "estop"})
        assert polled(server) == ["estop", "arm", "start", "status", "status", "status"]
        assert polled(server) == ["status"]


def test_estop_gets_in_although_idle_clients_hold_every_place(server):
    idle = [connect(server) for _ in range(8)]
    for _ in range(3):
        server.poll()
    send(idle[0], {"do": "status"})
    server.poll()
    assert_takes_an_estop(server)
    # The one that waited longest without a word had to go, not the first to come.
    assert hung_up(idle[1])
    send(idle[0], {"do": "status"})
    assert polled(server) == ["status"]
    for client in idle:
        client.close()


def test_estop_passes_a_flood_of_another_client(server):
    with connect(server) as flood, connect(server) as worried:
        flood.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                flood.send(b'{"do":"status"}\n' * 1000)
        send(worried, {"do": "estop"})
        assert server.poll()[0].action == "estop"


# --- clients that misbehave -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"arm", "not a JSON object"),
        (b"[1, 2]", "not a JSON object"),
        (b'{"do": "arm"', "not a JSON object"),
        (b"\xff\xfe\x00", "not a JSON object"),
        (b"[" * 900, "not a JSON object"),
        (b'{"do": "arm", "a": ' + b"[" * 4000, "not a JSON object"),
        (b"{}", '"do" must be one of arm, disarm'),
        (b'{"do": 5}', '"do" must be one of'),
        (b'{"do": "fly"}', '"do" must be one of'),
        (b'{"do": ["estop"]}', '"do" must be one of'),
    ],
)
def test_garbage_gets_one_clear_line_and_is_hung_up_on(server, line, message):
    with connect(server) as client:
        client.sendall(line + b"\n")
        for _ in range(5):
            assert server.poll() == []
        (reply,) = lines_from(client)
        assert reply["ok"] is False
        assert message in reply["error"]
        assert hung_up(client)


def test_a_request_before_garbage_still_gets_its_reply(server):
    with connect(server) as client:
        client.sendall(b'{"do": "disarm"}\ngarbage\n')
        (message,) = server.poll()
        server.reply(message, {"ok": True})
        assert [reply.get("do") for reply in lines_from(client)] == [None, "disarm"]
        server.poll()
        assert hung_up(client)


def test_a_line_without_end_is_hung_up_on(server):
    with connect(server) as client:
        client.sendall(b"x" * 20_000)
        for _ in range(10):
            server.poll()
        assert "4096" in lines_from(client)[0]["error"]
        assert hung_up(client)


def test_a_flood_is_hung_up_on_after_what_was_waiting(server):
    with connect(server) as client:
        send(client, *[{"do": "status"}] * 500)
        seen = [server.poll() for _ in range(10)]
        assert [len(messages) for messages in seen[:5]] == [4, 4, 4, 4, 0]
        assert "at once" in lines_from(client)[0]["error"]
        assert hung_up(client)


def test_an_estop_behind_as_many_requests_as_may_wait_is_taken(server):
    with connect(server) as client:
        send(client, *[{"do": "status"}] * 16, {"do": "estop"})
        assert server.poll()[0].action == "estop"


def test_a_client_that_never_reads_its_replies_is_let_go(server):
    with connect(server) as client:
        for _ in range(2000):
            try:
                send(client, {"do": "status"})
            except BrokenPipeError:
                break
            for message in server.poll():
                server.reply(message, {"text": "x" * 1000})
        assert hung_up(client)


def test_more_connections_than_places_at_once_do_no_harm(server):
    clients = []
    for _ in range(40):
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.setblocking(False)
        try:
            client.connect(str(server.path))
        except BlockingIOError:
            server.poll()
        clients.append(client)
    for _ in range(20):
        server.poll()
    assert_takes_an_estop(server)
    for client in clients:
        client.close()
    server.poll()


@examples(
    quick=40,
    every=150,
    pieces=st.lists(
        st.binary(max_size=200)
        | st.just(b"\n")
        | st.sampled_from([b'{"do": "arm"}\n', b'{"do": "estop"}\n', b'{"do":', b'"arm"}\n']),
        max_size=12,
    ),
)
def test_whatever_bytes_come_nothing_raises_and_only_known_actions_pass(pieces):
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as server:
        with connect(server) as client:
            for piece in pieces:
                try:
                    client.sendall(piece)
                except (BrokenPipeError, ConnectionResetError):
                    break
                for message in server.poll():
                    assert message.action in ACTIONS
                    server.reply(message, {"ok": True})
        server.poll()
        server.poll()
        with connect(server) as client:
            send(client, {"do": "status"})
            assert polled(server) == ["status"]


# --- whose it is ------------------------------------------------------------------------------------------------------


def test_socket_and_directory_are_the_owners_alone(server):
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700


def test_other_users_are_hung_up_on(tmp_path):
    others = {os.geteuid() + 1}
    with closing(ControlServer(tmp_path / "robot.sock", ACTIONS, others)) as server, connect(server) as client:
        send(client, {"do": "arm"})
        assert server.poll() == []
        assert hung_up(client)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become another user")
def test_another_user_is_distinguished_even_when_the_files_let_it_in():
    with tempfile.TemporaryDirectory() as folder, closing(ControlServer(Path(folder) / "x", ACTIONS)) as server:
        server.path.chmod(0o666)
        server.path.parent.chmod(0o711)
        child = os.fork()
        if child == 0:
            os.setgroups([])
            os.setuid(65534)
            connection = connect(server)
            send(connection, {"do": "arm"})
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert server.poll() == []


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_a_directory_that_others_can_write_to_is_refused(tmp_path, mode):
    tmp_path.chmod(mode)
    with pytest.raises(InputError, match=r"others can write to it; set daemon\.control_socket"):
        ControlServer(tmp_path / "robot.sock", ACTIONS)


def test_a_directory_that_is_a_link_or_a_file_is_refused(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    (tmp_path / "file").write_text("")
    for name in ("link", "file"):
        with pytest.raises(InputError, match="not a directory"):
            ControlServer(tmp_path / name / "robot.sock", ACTIONS)


# --- one daemon, and what a dead one leaves ---------------------------------------------------------------------------


def test_a_living_daemon_is_not_displaced_and_what_a_killed_one_left_is_replaced(tmp_path):
    path = tmp_path / "robot.sock"
    refuse_served(path)
    with serving_elsewhere(path) as process:
        for refuse in (refuse_served, partial(ControlServer, actions=ACTIONS)):
            with pytest.raises(InputError, match=rf"already serves this socket \(process {process}\); stop it first"):
                refuse(path)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.connect(str(path))
        kill(process)
    assert path.is_socket()
    refuse_served(path)
    with closing(ControlServer(path, ACTIONS)) as server:
        assert_takes_an_estop(server)


def test_a_child_of_a_killed_daemon_does_not_keep_the_socket(tmp_path):
    path = tmp_path / "robot.sock"
    with serving_elsewhere(path, with_child=True) as process:
        kill(process)
        ControlServer(path, ACTIONS).close()


def test_a_closed_server_leaves_no_socket_and_can_be_closed_twice(tmp_path):
    path = tmp_path / "robot.sock"
    for _ in range(2):
        server = ControlServer(path, ACTIONS)
        server.close()
        server.close()
        assert not path.exists()


def is_refused_elsewhere(path):
    """Whether a daemon of another process is refused at this path: the lock is no bar to the same process."""
    child = os.fork()
    if child == 0:
        try:
            ControlServer(path, ACTIONS)
        except InputError:
            os._exit(7)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


@pytest.mark.parametrize("removed", ["directory", "socket", "lock"])
def test_a_socket_that_was_removed_is_made_again_and_keeps_other_daemons_out(tmp_path, removed):
    """As at the last logout, which removes /run/user/UID, or by what cleans /tmp."""
    with served(tmp_path) as server, connect(server) as before:
        server.poll()
        assert server.restore() is None
        if removed == "directory":
            shutil.rmtree(server.path.parent)
        else:
            server.path.with_name(server.path.name + (".lock" if removed == "lock" else "")).unlink()
        assert server.restore() == f"{server.path}: was removed, and is made again; see `loginctl enable-linger`"
        assert server.restore() is None
        assert is_refused_elsewhere(server.path)
        assert_takes_an_estop(server)
        send(before, {"do": "arm"})
        assert polled(server) == ["arm"]
        assert stat.S_IMODE(server.path.parent.stat().st_mode) == 0o700


def test_a_socket_that_cannot_be_made_again_yet_is_said_once_and_made_when_it_can(tmp_path):
    with served(tmp_path) as server:
        shutil.rmtree(server.path.parent)
        server.path.parent.write_text("")
        assert "was removed, and cannot be made again: " in server.restore()
        assert server.restore() is None
        server.path.parent.unlink()
        assert "is made again" in server.restore()
        assert_takes_an_estop(server)


def test_a_daemon_that_has_taken_the_place_of_a_removed_socket_keeps_it(tmp_path):
    server = ControlServer(tmp_path / "private" / "robot.sock", ACTIONS)
    shutil.rmtree(server.path.parent)
    server.path.parent.mkdir(mode=0o700)
    with serving_elsewhere(server.path) as process:
        assert f"a daemon already serves this socket (process {process})" in server.restore()
        server.close()
        with connect(server):
            pass


def test_a_file_that_is_no_socket_is_not_removed(tmp_path):
    path = tmp_path / "robot.sock"
    path.write_text("precious")
    with pytest.raises(InputError, match="not a socket; remove it"):
        ControlServer(path, ACTIONS)
    assert path.read_text() == "precious"


def test_a_path_that_is_too_long_is_said(tmp_path):
    with pytest.raises(InputError, match=r"too long.*; set daemon\.control_socket"):
        ControlServer(tmp_path / ("x" * 120), ACTIONS)


def test_a_poll_with_eight_flooding_clients_stays_bounded(server):
    clients = [connect(server) for _ in range(8)]
    for client in clients:
        send(client, *[{"do": "status"}] * 100)
    started_ns = time.thread_time_ns()
    handed_over = [len(server.poll()) for _ in range(5)]
    assert max(handed_over) <= 32
    # CPU time of this thread, with a hundredfold margin: a bound on the work, not a measure of speed.
    assert time.thread_time_ns() - started_ns < 500_000_000
    for client in clients:
        client.close()
