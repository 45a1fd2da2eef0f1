"""The desk's way to the daemon, over a real page server and a real control socket."""

import asyncio
import json
import os
import pty
import threading
import time
from contextlib import closing, contextmanager
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from disco_hw.daemon.emergency import EstopOutcome
from disco_hw.viewer import operator_controls as desk_module
from disco_hw.viewer.operator_controls import Desk, shown
from disco_hw.viewer.server import serving
from firmware_protocol.codec import Codec
from firmware_protocol.serial_framing import encode_frame
from tests.daemon.control_daemon import ControlDaemon
from tests.drivers.waiting import wait_until
from tests.viewer.test_server import get
from tools.viewer_run import ROBOT_FILE

STATUS = {
    "ok": True, "state": "READY", "detail": "ready to be armed", "running": False, "estop": False, "fault": "NONE",
    "robot_state": "READY", "task": {"asked": {"radius_m": 0.75}, "limits": {"radius_m": [0.1, 50.0]},
                                   "labels": {"radius_m": "Radius (m)"}, "note": "Radius 0.1 to 50 m."},
    "recorder": {"fault": ""},
}  # fmt: skip


class Daemon(ControlDaemon):
    """Accepts everything but `arm`."""

    def __init__(self, directory):
        self.status = STATUS
        super().__init__(directory / "control.sock", self._reply_to)

    def _reply_to(self, message):
        if message.action == "status":
            return self.status
        if message.action == "drive":
            return {"ok": True, "stamp": str(1_000 + len(self.received))}
        return {"ok": message.action != "arm", "text": "done it", "error": "not now"}


@pytest.fixture
def daemon(tmp_path):
    made = Daemon(tmp_path / "run")
    yield made
    made.close()


COOKIES = {}


@contextmanager
def desk_of(socket, robot=ROBOT_FILE):
    """A served desk, and its port."""
    desk = Desk(socket, robot)
    with serving("test", port=0, desk=desk) as page:
        address = urlsplit(page.url)
        COOKIES[address.port] = f"disco-hw-token-{address.port}={address.query.removeprefix('token=')}"
        yield desk, address.port
    desk.close()


@contextmanager
def line_to(port, origin=None):
    address, cookie = f"http://127.0.0.1:{port}", {"Cookie": COOKIES[port]}
    with connect(
        f"ws://127.0.0.1:{port}/desk", origin=origin or address, additional_headers=cookie, open_timeout=60
    ) as line:
        yield line


@pytest.fixture
def port(daemon):
    """The port of a desk beside the daemon."""
    with desk_of(daemon.server.path) as (_, port):
        yield port


@pytest.fixture
def line(port):
    with line_to(port) as line:
        yield line


def next_message(line, kind, timeout_s=60.0):
    """The next message of that kind."""
    deadline = time.monotonic() + timeout_s
    while True:
        message = json.loads(line.recv(timeout=max(deadline - time.monotonic(), 0.01)))
        if message["kind"] == kind:
            return message


def hung_up(line):
    """Whether the other end closes the line before it replies."""
    try:
        return next_message(line, "reply") is None
    except ConnectionClosed:
        return True


def request_reply(line, **request):
    line.send(json.dumps({"stamp": time.monotonic(), **request}))
    return next_message(line, "drive" if request["do"] == "drive" else "reply")


def test_every_button_asks_the_daemon_and_tells_its_answer(daemon, line):
    for action in desk_module.REQUESTS:
        reply = request_reply(line, do=action)
        assert reply["do"] == action
        assert reply["ok"] is (action != "arm")
        assert "not now" in reply["error"]
    assert daemon.actions("status", "drive") == list(desk_module.REQUESTS)
    request_reply(line, do="task", radius_m=0.5, speed_m_s=0.1)
    assert ("task", {"radius_m": 0.5, "speed_m_s": 0.1}) in daemon.received


def test_what_may_move_the_robot_is_refused_once_it_is_late_and_a_stop_never_is(daemon, line):
    for stamp in (time.monotonic() - 2.0, time.monotonic() + 100.0, 10**400, None, "0"):
        replies = {action: request_reply(line, do=action, stamp=stamp) for action in desk_module.REQUESTS}
        assert {action for action, reply in replies.items() if reply["ok"]} == {"stop", "disarm"}
        for action in ("arm", "start", "reset", "task"):
            assert "over 1.5 s old" in replies[action]["error"]
            assert replies[action]["do"] == action
    assert set(daemon.actions("status")) == {"stop", "disarm"}


def test_the_stamp_of_a_status_makes_a_request_a_prompt_one(line):
    wait_until(lambda: request_reply(line, do="start", stamp=next_message(line, "status")["stamp"])["ok"], 30.0)


def test_what_is_no_request_of_the_page_does_not_reach_the_daemon(daemon, port, line):
    assert "no such request" in request_reply(line, do="quit")["error"]
    for garbage in ("", "[1]", '{"do": 1}', "{" * 100_000, b"\xff"):
        with line_to(port) as another:
            another.send(garbage)
            assert hung_up(another)
    assert daemon.actions("status", "drive") == []


def test_the_estop_asks_the_daemon_first(daemon, tmp_path):
    with desk_of(daemon.server.path, tmp_path / "none.toml") as (_, port), line_to(port) as line:
        assert request_reply(line, do="estop")["text"] == "done it"
    assert daemon.actions("status", "drive") == ["estop"]


def robot_elsewhere(directory):
    """A robot.toml whose link and daemon are nowhere."""
    robot = directory / "robot.toml"
    text = ROBOT_FILE.read_text().replace("/tmp/disco-hw-wombot.can", str(directory / "no-bus"))
    robot.write_text(text + f'\n[daemon]\ncontrol_socket = "{directory / "none.sock"}"\n')
    return robot


def test_without_a_daemon_the_estop_takes_the_link_and_says_if_that_failed(tmp_path):
    with desk_of(tmp_path / "none.sock", robot_elsewhere(tmp_path)) as (_, port), line_to(port) as line:
        reply = request_reply(line, do="estop")
        assert not reply["ok"]
        assert "NOT SENT: use the robot's own e-stop button" in reply["error"]
        assert "disco-hw run" in request_reply(line, do="arm")["error"]
    with desk_of(tmp_path / "none.sock", tmp_path / "none.toml") as (_, port), line_to(port) as line:
        assert "NOT SENT" in request_reply(line, do="estop")["error"]


def test_an_estop_goes_to_the_link_at_once_where_the_daemon_has_just_failed(tmp_path, monkeypatch):
    given, outcome = [], EstopOutcome("link", None, None, True)
    monkeypatch.setattr(desk_module, "stop_robot", lambda *_, **options: given.append(options) or outcome)
    with closing(Desk(tmp_path / "none.sock", ROBOT_FILE)) as desk:
        assert desk.estop()["ok"]
    assert given == [{"daemon_failed": True}]


def test_the_estop_takes_the_link_that_the_daemon_was_given(tmp_path):
    master, slave = pty.openpty()
    robot = robot_elsewhere(tmp_path)
    robot.write_text(robot.read_text().replace("/tmp/disco-hw-wombot.tty", os.ttyname(slave)))
    with closing(Desk(tmp_path / "none.sock", robot, "serial")) as desk:
        reply = desk.estop()
        assert not reply["ok"], "nobody answers on this line, so nothing confirms that the robot stopped"
        assert "sent, but the robot has not confirmed" in reply["error"]
    frame = encode_frame(*Codec().encode("ESTOP", reason=1))
    assert frame in os.read(master, 4096)
    os.close(master)
    os.close(slave)


def test_the_estop_is_not_behind_requests_that_hang(line, monkeypatch):
    """All threads for other requests wait for a daemon that hangs; the stop does not wait for them."""
    stopped, released = threading.Event(), threading.Event()
    monkeypatch.setattr(Desk, "request", lambda self, request: {"ok": released.wait(120.0)})
    monkeypatch.setattr(Desk, "estop", lambda self: stopped.set() or {"do": "estop", "ok": True, "text": "stopped"})
    for _ in range(20):
        line.send(json.dumps({"do": "start", "stamp": time.monotonic()}))
    line.send(json.dumps({"do": "estop"}))
    try:
        assert stopped.wait(60.0)
    finally:
        released.set()


def test_the_pad_has_a_line_of_its_own_and_is_opened_when_the_page_goes(daemon, port):
    hold = {"do": "drive", "forward": 0.5, "left": 0.0, "held": True}
    with line_to(port) as line:
        first = request_reply(line, stamp="0", **hold)
        assert request_reply(line, stamp=first["stamp"], **hold)["ok"]
    wait_until(lambda: [of.get("held") for what, of in daemon.received if what == "drive"][-1:] == [False], 30.0)
    drives = [arguments for action, arguments in daemon.received if action == "drive"]
    assert [drive["held"] for drive in drives] == [True, True, False]
    assert drives[1]["stamp"] == first["stamp"]


def test_a_pad_without_a_daemon_is_told_so_and_tries_again(tmp_path):
    with desk_of(tmp_path / "run" / "control.sock") as (_, port), line_to(port) as line:
        request = {"do": "drive", "forward": 0, "left": 0, "held": False, "stamp": "0"}
        assert "no daemon" in request_reply(line, **request)["error"]
        made = Daemon(tmp_path / "run")
        assert request_reply(line, **request)["ok"]
        made.close()


def test_two_pages_see_the_same_robot(daemon):
    with desk_of(daemon.server.path) as (desk, port), line_to(port) as one, line_to(port) as other:
        for line in (one, other):
            deadline = time.monotonic() + 30.0
            while (status := next_message(line, "status"))["state"] != "READY":
                assert time.monotonic() < deadline
        assert status["next"] == "arm"
        assert status["task"]["limits"]["radius_m"] == [0.1, 50.0]
        assert desk.status["state"] == "READY"


@pytest.mark.parametrize(("typed", "drawn"), [("7.5", 7.5), ("1e6", 50.0), (f"1{400 * '0'}", 50.0), ("-3", 0.1)])
def test_what_is_typed_into_the_form_is_drawn_within_the_limits_of_the_daemon(line, typed, drawn):
    """A figure of a thousand kilometres would take the memory of the process that sends the e-stop, too."""
    while next_message(line, "status")["state"] != "READY":
        # The desk knows no limits before the daemon has replied.
        pass
    line.send(f'{{"do": "draft", "values": {{"radius_m": {typed}, "speed_m_s": 9, "center_x_m": 1e6}}}}')
    # The desk takes one message after the other.
    assert request_reply(line, do="stop")["ok"]
    assert next_message(line, "status")["draft"] == {"radius_m": drawn}


def test_without_limits_no_draft_is_drawn(tmp_path):
    with desk_of(tmp_path / "none.sock") as (desk, port), line_to(port) as line:
        line.send(json.dumps({"do": "draft", "values": {"radius_m": 7.5}}))
        assert not request_reply(line, do="arm")["ok"]
        assert desk.draft is None


def test_nobody_there_asks_nothing_of_the_daemon(daemon, port):
    with line_to(port) as line:
        next_message(line, "status")

    def is_quiet():
        count = len(daemon.received)
        time.sleep(0.6)
        return len(daemon.received) == count

    # The page may take its time to notice that its browser has gone.
    wait_until(is_quiet, 30.0)


@pytest.mark.parametrize("origin", ["http://evil.example", "null"])
def test_a_foreign_page_gets_no_line(daemon, port, origin):
    with pytest.raises(InvalidStatus), line_to(port, origin):
        pass
    assert daemon.received == []


def test_with_another_address_there_is_no_control_without_its_token(daemon):
    with (
        closing(Desk(daemon.server.path, ROBOT_FILE)) as desk,
        serving("test", host="0.0.0.0", port=0, desk=desk) as page,
    ):
        address = urlsplit(page.url)
        page_origin, token = f"http://127.0.0.1:{address.port}", address.query.removeprefix("token=")
        for cookie in ({}, {"Cookie": f"disco-hw-token-{address.port}=wrong"}):
            with pytest.raises(InvalidStatus) as refused:
                connect(f"ws://127.0.0.1:{address.port}/desk", origin=page_origin, additional_headers=cookie)
            assert refused.value.response.status_code == 403
        assert daemon.received == []
        welcome, _ = get(address.port, f"/?token={token}")
        cookie = {"Cookie": welcome.getheader("Set-Cookie").split(";")[0]}
        with connect(f"ws://127.0.0.1:{address.port}/desk", origin=page_origin, additional_headers=cookie) as line:
            assert request_reply(line, do="stop")["ok"]


def test_the_desk_is_what_opens_and_nobody_else_may_frame_it(port):
    cookie = {"Cookie": COOKIES[port]}
    response, body = get(port, **cookie)
    assert b"E-STOP" in body
    assert b"@@" not in body
    assert response.getheader("Content-Security-Policy") == "frame-ancestors 'none'"
    response, scene = get(port, "/index.html", **cookie)
    assert b"E-STOP" not in scene
    assert f"http://127.0.0.1:{port}" in response.getheader("Content-Security-Policy")
    local, instance = get(port, "/instance", Origin=f"http://localhost:{port}")
    assert instance.strip() in body
    assert local.getheader("Access-Control-Allow-Origin") == f"http://localhost:{port}"
    foreign, _ = get(port, "/instance", Origin="http://evil.example")
    assert foreign.getheader("Access-Control-Allow-Origin") is None


@pytest.mark.parametrize(
    ("status", "error", "expected"),
    [(None, "no daemon listens", "no daemon listens"), ({"ok": False, "error": "not started"}, "", "not started"),
     ({"ok": False}, "", "its loop does not run yet")],
)  # fmt: skip
def test_without_a_status_it_says_why(status, error, expected):
    display = shown(status, error)
    assert not display["ok"]
    assert expected in display["detail"]


def test_a_daemon_that_has_gone_since_is_shown_and_no_older_status(daemon, line):
    wait_until(lambda: next_message(line, "status")["ok"], 60.0)
    daemon.close()
    wait_until(lambda: next_message(line, "status")["state"] == "NO DAEMON", 60.0)


def test_what_is_not_recorded_is_shown_whatever_the_state():
    display = shown({**STATUS, "recorder": {"fault": "nothing is being recorded: no room"}}, "")
    assert display["advice"][-1] == "RECORDING: nothing is being recorded: no room."
    assert not any("RECORDING" in sentence for sentence in shown(STATUS, "")["advice"])


def test_a_latched_stop_and_a_drive_by_page_are_shown():
    display = shown({**STATUS, "robot_state": "ESTOP", "drive": {"by_page": True, "driving": False, "words": "w"}}, "")
    assert display["estop"]
    assert "latched" in display["advice"][0]
    assert display["drive"] == {"by_page": True, "driving": False}


def test_a_request_still_unanswered_when_the_browser_goes_goes_on_and_leaves_no_task(port, monkeypatch):
    tasks, forward, requested, answered = [], Desk._forward_request, threading.Event(), threading.Event()

    async def watched(self, *arguments):
        tasks.append(asyncio.current_task())
        await forward(self, *arguments)

    def unanswered(_, request):
        requested.set()
        return {"ok": answered.wait(60.0)}

    monkeypatch.setattr(Desk, "_forward_request", watched)
    monkeypatch.setattr(Desk, "request", unanswered)
    with line_to(port) as line:
        line.send(json.dumps({"do": "disarm"}))
        assert requested.wait(60.0)
    wait_until(tasks[0].done, 30.0)
    answered.set()


def test_an_estop_that_is_the_last_word_of_a_browser_is_made(port, monkeypatch):
    stops = []
    monkeypatch.setattr(Desk, "estop", lambda _: stops.append(True) or {"ok": True})
    for count in range(1, 11):
        with line_to(port) as line:
            line.send(json.dumps({"do": "estop"}))
        wait_until(lambda count=count: len(stops) == count, 30.0)
