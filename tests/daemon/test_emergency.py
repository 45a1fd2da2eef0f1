"""The e-stop with a daemon and robot.toml in trouble: each way is tried, and what is said of it is so."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import threading
import time
import tty

import can
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon import emergency
from disco_hw.daemon.emergency import stop_and_report, stop_robot
from disco_hw.errors import InputError
from drivers.motor import find_driver
from drivers.types import Frame, LinkState, ReceivedFrame
from firmware_protocol.codec import Codec
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.daemon.control_daemon import ControlDaemon

SHIPPED = SHIPPED_ROBOT.read_text(encoding="utf-8")

UART_NODE = 51
_ESTOP_ID, _ESTOP_DATA = Codec().encode("ESTOP", reason=1)
ESTOP_LINE = f"t{_ESTOP_ID:03X}{len(_ESTOP_DATA)}{_ESTOP_DATA.hex().upper()}".encode()
STATE = {
    "state": "ESTOP", "fault": "NONE", "session": 0, "estop_source": "FRAME", "last_command_counter": 0,
    "rejected_count": 0, "reject_reason": "NONE", "stop_cause": "NONE",
}  # fmt: skip


class Bus:
    """A link that is up, takes every frame and holds these."""

    state, last_error = LinkState.UP, None

    def __init__(self, frames):
        self.frames = frames

    def send(self, outgoing, now_ns):
        return True

    def receive(self):
        frames, self.frames = self.frames, []
        return frames

    def close(self):
        pass


def robot_file(directory, socket, link='interface = "virtual"', **others):
    text = SHIPPED.replace('interface = "unixcan"', link) + f'[daemon]\ncontrol_socket = "{socket}"\n'
    for old, new in others.items():
        assert old in text
        text = text.replace(old, new)
    path = directory / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def daemon(tmp_path):
    """A daemon that takes an e-stop and whose status is an attribute."""

    def reply(message):
        return made.status if message.action == "status" else {"ok": True}

    made = ControlDaemon(tmp_path / "run" / "control.sock", reply)
    made.status = {"ok": True, "robot_state": "READY", "link": "up"}
    yield made
    made.close()


@pytest.fixture
def line():
    """A serial line: the robot's end and the host's, as open files."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        os.close(end)


def test_a_socket_that_cannot_be_looked_at_does_not_hide_what_became_of_the_link(tmp_path):
    # As where a daemon runs as another user, in a directory that only that one may enter.
    outcome = stop_robot(robot_file(tmp_path, tmp_path / ("x" * 300)))
    assert outcome.link_error is None
    assert "too long" in outcome.daemon_error


def test_a_link_section_that_says_nothing_leaves_the_daemon(tmp_path, daemon):
    daemon.status = {**daemon.status, "robot_state": "ESTOP", "robot_state_ns": time.monotonic_ns() + 10**10}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link="interface = 7"))
    assert daemon.actions()[0] == "estop"
    assert outcome.sent
    assert outcome.confirmed
    assert "interface" in outcome.link_error


def test_a_link_section_that_says_nothing_without_a_daemon_is_one_line(tmp_path):
    with pytest.raises(InputError, match="own e-stop button, now"):
        stop_robot(robot_file(tmp_path, tmp_path / "none", link="interface = 7"))


def test_a_misspelt_field_of_the_link_does_not_keep_the_stop_from_it(tmp_path):
    outcome = stop_robot(robot_file(tmp_path, tmp_path / "none", link='interface = "virtual"\nbitrat = 7'))
    assert outcome.link_error is None


def test_a_daemon_that_holds_the_stop_until_its_link_is_up_has_not_sent_it(tmp_path, daemon):
    daemon.status = {**daemon.status, "link": "connecting", "robot_state": "UNKNOWN"}
    without_bus = {"/tmp/disco-hw-wombot.can": "/nowhere/bus"}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link='interface = "unixcan"', **without_bus))
    assert not outcome.sent
    assert "NOT SENT" in outcome.as_text()
    assert "connecting" in outcome.as_text()


def test_a_robot_state_from_before_the_request_confirms_nothing(tmp_path, daemon):
    daemon.status = {**daemon.status, "robot_state": "ESTOP", "robot_state_ns": time.monotonic_ns()}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link="interface = 7"))
    assert outcome.sent
    assert not outcome.confirmed
    assert "the robot has not confirmed" in outcome.as_text()


def test_a_state_on_the_bus_from_before_the_request_confirms_nothing(tmp_path, monkeypatch):
    # The robot said ESTOP before and is silent since: the frame lies in the socket when the request goes out.
    frame_id, data = Codec().encode("SYSTEM_STATE", **STATE)
    before, after = [ReceivedFrame(1, Frame(frame_id, data))], [ReceivedFrame(1 << 62, Frame(frame_id, data))]
    for bus, confirmed in ((Bus(before), False), (Bus(after), True)):
        monkeypatch.setattr(emergency, "open_transport", lambda bus=bus, **_: bus)
        assert stop_robot(robot_file(tmp_path, tmp_path / "none")).confirmed is confirmed


@pytest.mark.parametrize("has_threads", [True, False])
def test_the_daemon_is_asked_while_the_link_takes_its_time(tmp_path, daemon, monkeypatch, has_threads):
    """As an adapter that only one process can open, which the daemon has: nothing comes of waiting for it."""

    class HeldBus(Bus):
        @property
        def state(self):
            return LinkState.UP if daemon.actions() else LinkState.CONNECTING

    def fail(self):
        raise RuntimeError("can't start new thread")

    if not has_threads:
        monkeypatch.setattr(threading.Thread, "start", fail)
    monkeypatch.setattr(emergency, "_CONFIRM_S", 0.05)
    monkeypatch.setattr(emergency, "open_transport", lambda **_: HeldBus([]))
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path))
    assert (outcome.link_error, outcome.daemon_error) == (None, None)
    assert daemon.actions()[0] == "estop"


def frames_on(line, settle_s=0.1):
    """Return what comes on a line until there are frames in it and nothing follows within that time."""
    decoder, frames = FrameDecoder(), []
    while not frames or select.select([line], [], [], settle_s)[0]:
        frames += decoder.feed(os.read(line, 4096))
    return frames


def test_a_state_on_the_serial_line_from_before_the_request_confirms_nothing(tmp_path, monkeypatch, line):
    robot_end, host_end = line
    tty.setraw(host_end)
    state = encode_frame(*Codec().encode("SYSTEM_STATE", **STATE))
    os.write(robot_end, state)
    robot = robot_file(tmp_path, tmp_path / "none", **{"/tmp/disco-hw-wombot.tty": os.ttyname(host_end)})
    assert not stop_robot(robot, "serial").confirmed
    frames_on(robot_end)
    monkeypatch.setattr(emergency, "_CONFIRM_S", 30.0)

    def reply():
        frames_on(robot_end, settle_s=0.0)
        os.write(robot_end, state)

    answering = threading.Thread(target=reply)
    answering.start()
    assert stop_robot(robot, "serial").confirmed
    answering.join()


def test_a_port_whose_other_end_takes_nothing_is_not_waited_for(tmp_path, daemon, monkeypatch):
    """As of a controller with a USB port of its own, whose firmware hangs: what was written stays in this computer."""
    written, drained = [], threading.Event()

    class StuckPort:
        in_waiting, write = 0, written.append

        def flush(self):
            raise AssertionError("waits without end")

        def close(self):
            drained.wait(60.0)

        def read(self, size):
            return b""

    monkeypatch.setattr(emergency, "_CONFIRM_S", 0.05)
    monkeypatch.setattr(emergency, "open_port", lambda *_, **__: StuckPort())
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path), "serial")
    assert (len(written), outcome.link_error, outcome.confirmed) == (1, None, False)
    assert daemon.actions()[0] == "estop"
    assert not drained.is_set()
    drained.set()


BROKEN = {
    "absent": None,
    "no TOML": "[link",
    "nested": "a = " + "[" * 5000,
    "a long number": "a = " + "1" * 5000,
    "a long key": ".".join("a" * 100_000) + " = 1",
    "a link that is none": "[link]\nbitrate = []\n",
}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN)
def test_without_a_file_that_can_be_read_the_option_says_where_the_link_is(tmp_path, text):
    path = tmp_path / "robot.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=r"can:INTERFACE:CHANNEL or --link serial:PORT, or use the robot's own"):
        stop_robot(path)
    other = can.Bus(interface="virtual", channel=str(tmp_path))
    try:
        outcome = stop_robot(path, f"can:virtual:{tmp_path}")
        received = other.recv(30.0)
    finally:
        other.shutdown()
    assert received is not None
    assert Codec().decode(received.arbitration_id, bytes(received.data)).name == "ESTOP"
    assert (outcome.link, outcome.link_error) == (f"virtual {tmp_path}", None)
    assert str(path) in outcome.file_error
    assert f"{path}: " in outcome.as_text()
    assert "only --link was used, and the reference controller's protocol, which no other" in outcome.as_text()
    assert outcome.as_dict()["file_error"] == outcome.file_error


def test_over_a_serial_port_that_the_option_names_the_stop_goes_out(tmp_path, line):
    robot_end, host_end = line
    outcome = stop_robot(tmp_path / "none.toml", f"serial:{os.ttyname(host_end)}")
    assert (outcome.link_error, outcome.sent, outcome.confirmed) == (None, True, False)
    assert {Codec().decode(can_id, data).name for can_id, data in frames_on(robot_end)} == {"ESTOP"}


@pytest.mark.parametrize("name", ["roboclaw", "vesc"])
def test_a_line_of_one_request_at_a_time_is_left_to_a_daemon_that_lives_and_taken_beside_a_dead_one(
    tmp_path, daemon, line, name
):
    """Two that speak on such a line at once spoil each other's packets."""
    robot_end, host_end = line
    tty.setraw(host_end)
    driver = find_driver(name)
    settings = driver.example + (f"uart_node = {UART_NODE}\n" if driver.serial_field else "")
    link = f'interface = "virtual"\ndriver = "{name}"\n{settings}'
    serial = {'kind = "can"': 'kind = "serial"', "/tmp/disco-hw-wombot.tty": os.ttyname(host_end)}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link=link, **serial))
    assert (daemon.actions()[0], outcome.sent) == ("estop", True)
    assert "left to the daemon" in outcome.link_error
    assert not select.select([robot_end], [], [], 0.0)[0], "nobody else speaks on the line"
    outcome = stop_robot(robot_file(tmp_path, tmp_path / "none", link=link, **serial))
    assert (outcome.link_error, outcome.sent) == (None, True)
    assert os.read(robot_end, 4096)


@pytest.mark.parametrize("confirmed", [True, False])
def test_an_adapter_behind_a_tty_is_left_to_a_daemon_that_confirms_and_opened_beside_another(
    tmp_path, daemon, line, monkeypatch, confirmed
):
    """To close a second opening closes the adapter's channel under the daemon."""
    robot_end, host_end = line
    tty.setraw(host_end)
    # As the daemon's own link has it.
    fcntl.flock(host_end, fcntl.LOCK_EX)
    monkeypatch.setattr(emergency, "_CONFIRM_S", 0.05)
    if confirmed:
        daemon.status = {**daemon.status, "robot_state": "ESTOP", "robot_state_ns": time.monotonic_ns() + 10**10}
    channel = {"/tmp/disco-hw-wombot.can": os.ttyname(host_end)}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link='interface = "slcan"', **channel))
    assert (daemon.actions()[0], outcome.sent, outcome.confirmed) == ("estop", True, confirmed)
    if confirmed:
        assert "left to the daemon" in outcome.link_error
        assert set(os.read(robot_end, 4096).split(b"\r")) == {b"", ESTOP_LINE}, "nobody else opens the adapter"
    else:
        assert outcome.link_error is None
        assert {b"O", ESTOP_LINE, b"C"} <= set(os.read(robot_end, 4096).split(b"\r"))


def test_a_usb_adapter_is_left_to_a_daemon_that_confirms(tmp_path, daemon, monkeypatch):
    """To open a gs_usb adapter resets it, and to close it closes its channel, whoever else has it open."""
    opened = []
    monkeypatch.setattr(emergency, "open_transport", lambda **_: opened.append(1) or Bus([]))
    daemon.status = {**daemon.status, "robot_state": "ESTOP", "robot_state_ns": time.monotonic_ns() + 10**10}
    outcome = stop_robot(robot_file(tmp_path, daemon.server.path, link='interface = "gs_usb"'))
    assert (outcome.confirmed, opened) == (True, [])


@pytest.mark.parametrize(
    ("daemon_failed", "is_held", "goes_at_once"), [(True, False, True), (False, False, False), (False, True, True)]
)
def test_the_stop_over_an_adapter_does_not_wait_for_a_daemon_that_has_just_failed_or_holds_it(
    tmp_path, line, monkeypatch, daemon_failed, is_held, goes_at_once
):
    robot_end, host_end = line
    tty.setraw(host_end)
    if is_held:
        fcntl.flock(host_end, fcntl.LOCK_EX)
    is_out = []

    def request(_):
        is_out.append(bool(select.select([robot_end], [], [], 60.0 if goes_at_once else 0.0)[0]))
        return False, "no answer"

    monkeypatch.setattr(emergency, "_CONFIRM_S", 0.05)
    monkeypatch.setattr(emergency, "_request_stop", request)
    channel = {"/tmp/disco-hw-wombot.can": os.ttyname(host_end)}
    robot = robot_file(tmp_path, tmp_path / "none", link='interface = "slcan"', **channel)
    outcome = stop_robot(robot, daemon_failed=daemon_failed)
    assert (outcome.link_error, outcome.daemon_error, is_out) == (None, "no answer", [goes_at_once])


@pytest.mark.parametrize("option", ["radio", "can:", "can:socketcan", "can::can0", "can:socketcan:", "serial:"])
def test_a_link_option_that_says_nothing_is_refused_with_what_to_write(tmp_path, option):
    with pytest.raises(InputError, match=f"--link {option}: .*write can, serial, can:INTERFACE:CHANNEL or serial:PORT"):
        stop_robot(robot_file(tmp_path, tmp_path / "none"), option)


@pytest.mark.parametrize(("latches", "expected"), [(True, "stays latched"), (False, "does not latch the stop")])
def test_what_is_said_of_a_confirmed_stop_is_what_the_controller_does(latches, expected):
    outcome = emergency.EstopOutcome("can0", None, "not running", confirmed=True, latches=latches)
    assert expected in outcome.as_text()


@pytest.mark.parametrize("confirmed", [True, False])
def test_only_a_robot_that_confirms_ends_the_command_with_0(tmp_path, daemon, confirmed, capsys):
    after = time.monotonic_ns() + 10**10
    daemon.status = {**daemon.status, "robot_state": "ESTOP", "robot_state_ns": after if confirmed else 0}
    robot = robot_file(tmp_path, daemon.server.path, link="interface = 7")
    assert stop_and_report(robot, None, as_json=False) == (0 if confirmed else 1)
    assert ("has not confirmed" in capsys.readouterr().out) is not confirmed
