"""Tests of the control socket's place and whom to believe there, with a real second user where they run as root."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from disco_hw import daemon as client
from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.daemon import ask, believed_users, default_socket_path, passed_over, send_request, socket_path
from disco_hw.daemon.control_socket import ControlServer
from disco_hw.errors import WorkError
from tests.daemon.control_daemon import ControlDaemon
from tests.hil.stack import disco_here

ME = os.geteuid()
NOBODY = 65534
SHIPPED = SHIPPED_ROBOT.read_text(encoding="utf-8")
needs_root = pytest.mark.skipif(ME != 0, reason="needs root to act as a second user")

REPLY = b'{"ok": true, "text": "the stranger says", "robot_state": "ESTOP", "robot_state_ns": 9e18, "link": "up"}\n'

# The interpreter may lie where other users cannot read, so the command runs once before for what it imports.
AS_USER = """
import contextlib, io, json, os, sys
import can.interfaces.virtual, drivers.motor.reference, sim.unixcan
from disco_hw.cli import main

def run(arguments):
    printed, sys.argv, code = io.StringIO(), ["disco-hw", *arguments], 0
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main()
        except SystemExit as end:
            code = end.code
    return code, printed.getvalue()

calls = json.loads(sys.argv[1])
for verb, *_ in calls:
    run([verb, "/nowhere", *(["status"] if verb == "ctl" else [])])
os.setgroups([]); os.setgid({uid}); os.setuid({uid})
print(json.dumps([run(call) for call in calls]))
"""


@pytest.fixture
def temporary(monkeypatch):
    """A directory in the place of /tmp, short enough for socket paths and open to every user."""
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    with tempfile.TemporaryDirectory(prefix="place", dir="/tmp") as name:
        Path(name).chmod(0o1777)
        monkeypatch.setattr(client, "_TEMPORARY", Path(name))
        yield Path(name)


@contextmanager
def as_nobody(act):
    """Run `act` in a process of the user nobody, which says when it is ready, until the block ends."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            act(lambda: os.write(writing, b"!"))
        finally:
            os._exit(1)
    os.close(writing)
    try:
        assert os.read(reading, 1) == b"!"
        yield
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def serve_as_a_daemon(path):
    """Serve at `path` as another user: every request gets the reply of an e-stopped robot's daemon."""

    def act(ready):
        path.parent.mkdir(mode=0o755, exist_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(str(path))
        path.chmod(0o777)
        listener.listen(8)
        ready()
        while True:
            connection, _ = listener.accept()
            connection.recv(4096)
            connection.sendall(REPLY)
            connection.close()

    return act


@pytest.fixture
def service():
    """A directory of a service user's alone, put by root where only root can."""
    place = Path(tempfile.mkdtemp(prefix="dhw", dir="/run"))
    os.chown(place, NOBODY, NOBODY)
    yield place
    shutil.rmtree(place)


def robot_file(directory, extra=""):
    path = directory / "robot.toml"
    text = SHIPPED.replace("/tmp/disco-hw-wombot.can", "/nowhere/bus")
    path.write_text(text + extra, encoding="utf-8")
    return path


# --- the rule ---------------------------------------------------------------------------------------------------------


def test_the_place_is_the_runtime_directory_of_this_user(tmp_path, monkeypatch, temporary):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    assert default_socket_path("wom bot/../1") == tmp_path / "disco-hw" / "wom_bot____1.sock"
    tmp_path.chmod(0o777)
    assert default_socket_path("wombot").parent == temporary / f"disco-hw-{ME}"
    assert passed_over(default_socket_path("wombot"))[0].startswith(f"{tmp_path}: others can write to it")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    assert default_socket_path("wombot") == temporary / f"disco-hw-{ME}" / "wombot.sock"


def test_a_place_that_is_not_believed_is_passed_over_by_both_sides_and_its_going_changes_nothing(temporary):
    occupied = temporary / f"disco-hw-{ME}"
    occupied.mkdir()
    occupied.chmod(0o777)
    path = default_socket_path("wombot")
    assert path.parent == temporary / f"disco-hw-{ME}-2"
    with closing(ControlServer(path, ["status"])):
        (line,) = passed_over(default_socket_path("wombot"))
        assert line.startswith(f"{occupied}: others can write to it")
        occupied.rmdir()
        assert default_socket_path("wombot") == path
        occupied.touch()
        assert default_socket_path("wombot") == path


def test_the_places_of_other_users_and_other_names_are_not_looked_at(temporary):
    for name in (f"disco-hw-{ME}0", f"disco-hw-{ME}-1", f"disco-hw-{ME}-x", f"disco-hw-{ME}-02"):
        (temporary / name).mkdir(mode=0o700)
    assert default_socket_path("wombot").parent == temporary / f"disco-hw-{ME}"


def test_a_directory_of_another_user_is_not_believed(tmp_path, monkeypatch):
    # Without a second user: the files are those of whoever runs this, and the client takes itself for another.
    directory = tmp_path / "run"
    directory.mkdir(mode=0o700)
    monkeypatch.setattr(client.os, "geteuid", lambda: ME + 4242)
    monkeypatch.setattr(client, "_ROOT", ME + 4243)
    with pytest.raises(WorkError, match=rf"run: belongs to .*\({ME}\); nothing is sent there, set daemon\.control"):
        believed_users(directory / "x.sock")


def test_a_listener_of_another_user_is_not_believed(tmp_path, monkeypatch):
    monkeypatch.setattr(client, "peer_uid", lambda connection: NOBODY)
    with (
        closing(ControlServer(tmp_path / "x.sock", ["status"])),
        pytest.raises(WorkError, match=r"a process of .*65534.* listens there; nothing is sent"),
    ):
        send_request(tmp_path / "x.sock", {"do": "status"})


# --- a second user ----------------------------------------------------------------------------------------------------


@needs_root
def test_what_another_user_made_first_is_passed_over_and_named(temporary, tmp_path, capsys):
    occupied = temporary / f"disco-hw-{ME}"
    with as_nobody(serve_as_a_daemon(occupied / "wombot.sock")):
        robot = robot_file(tmp_path)
        daemon = ControlDaemon(default_socket_path("wombot"), lambda _: {"ok": True, "text": "the daemon says"})
        with closing(daemon):
            assert ask(robot, "disarm")["text"] == "the daemon says"
        assert capsys.readouterr().err == f"disco-hw: {occupied}: belongs to nobody (65534); not used\n"


@needs_root
@pytest.mark.skipif(
    not all(folder.stat().st_mode & 0o005 == 0o005 for folder in Path(__file__).resolve().parents),
    reason="a second user could not read this checkout",
)
def test_a_false_daemon_confirms_no_estop(tmp_path):
    # The real command against the real /tmp, under the name of a user whom this machine lacks, another in each run.
    uid = 200_000_000 + os.getpid()
    occupied = Path(f"/tmp/disco-hw-{uid}")
    home = Path(tempfile.mkdtemp(prefix="estop", dir="/tmp"))
    home.chmod(0o755)
    try:
        robot = robot_file(home)
        with as_nobody(serve_as_a_daemon(occupied / "wombot.sock")):
            calls = [["estop", str(robot)], ["ctl", str(robot), "disarm"], ["ctl", str(robot), "status"]]
            environment = {**os.environ, "HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
            environment.pop("XDG_RUNTIME_DIR", None)
            done = subprocess.run(
                [sys.executable, "-c", AS_USER.format(uid=uid), json.dumps(calls)],
                env=environment, capture_output=True, text=True, timeout=120, check=True,
            )  # fmt: skip
            for code, output in json.loads(done.stdout):
                assert code == 1, output
                assert f"{occupied}: belongs to nobody (65534)" in output
                assert "reports ESTOP" not in output
                assert "the stranger says" not in output
    finally:
        shutil.rmtree(home)
        shutil.rmtree(occupied)


@needs_root
def test_a_configured_socket_of_another_user_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    with tempfile.TemporaryDirectory(prefix="asked", dir="/tmp") as name:
        Path(name).chmod(0o777)
        path = Path(name) / "mine" / "x.sock"
        robot = robot_file(tmp_path, f'[daemon]\ncontrol_socket = "{path}"\n')
        with as_nobody(serve_as_a_daemon(path)):
            for verb in (["estop", str(robot)], ["ctl", str(robot), "status"]):
                code, output = disco_here(*verb)
                assert code == 1, output
                assert f"{path.parent}: belongs to nobody (65534)" in output
                assert "reports ESTOP" not in output


@needs_root
def test_root_reaches_the_daemon_of_a_service_user(service):
    # As /run/disco-hw-NAME of the service: put there by root, and the service user's alone.
    path = service / "disco-hw" / "wombot.sock"
    with as_nobody(serve_as_a_daemon(path)):
        path.parent.chmod(0o700)
        assert believed_users(path) == {0, NOBODY}
        assert send_request(path, {"do": "disarm"})["text"] == "the stranger says"


@needs_root
def test_root_finds_it_by_the_runtime_directory_of_the_service(monkeypatch, temporary, service):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(service))
    assert default_socket_path("wombot").parent == temporary / "disco-hw-0"
    with as_nobody(serve_as_a_daemon(service / "disco-hw" / "wombot.sock")):
        assert default_socket_path("wombot") == service / "disco-hw" / "wombot.sock"
        assert passed_over(default_socket_path("wombot")) == ()


@needs_root
def test_root_does_not_believe_a_user_in_a_place_that_anybody_can_make(temporary):
    with as_nobody(serve_as_a_daemon(temporary / "mine" / "x.sock")):
        (temporary / "mine").chmod(0o700)
        with pytest.raises(WorkError, match=r"mine: belongs to nobody \(65534\)"):
            send_request(temporary / "mine" / "x.sock", {"do": "status"})


@needs_root
def test_a_listener_of_another_user_in_ones_own_directory_is_not_believed(temporary):
    directory = temporary / "mine"
    directory.mkdir(mode=0o700)
    os.chown(directory, NOBODY, NOBODY)
    with as_nobody(serve_as_a_daemon(directory / "x.sock")):
        os.chown(directory, 0, 0)
        with pytest.raises(WorkError, match=r"x\.sock: a process of nobody \(65534\) listens there"):
            send_request(directory / "x.sock", {"do": "status"})


def test_the_configured_socket_is_where_it_is_said(tmp_path):
    robot = robot_file(tmp_path, '[daemon]\ncontrol_socket = "/run/user/1000/x"\n')
    assert socket_path(load_robot_config(robot)) == Path("/run/user/1000/x")
