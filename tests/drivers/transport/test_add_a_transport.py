"""The medium that docs/add-a-transport.md explains carries frames, over real sockets, and is found by its kind."""

import errno
import socket
import time
from contextlib import closing
from pathlib import Path
from typing import Literal

import pytest

import drivers.transport
from disco_hw import load_robot
from disco_hw.config import robot_file
from disco_hw.config.robot import Link, RobotConfig
from disco_hw.errors import InputError
from drivers.motor import motor_drivers
from drivers.transport import TransportSettingsError, create_transport, media
from drivers.types import Frame, LinkState
from tests.drivers.motor.test_motor_drivers import EXAMPLES, robot_toml
from tests.drivers.transport.links import up
from tests.drivers.waiting import collect, outgoing, send, wait_until

EXAMPLE = Path(__file__).parents[3] / "docs/examples/udp.py"
CODE = EXAMPLE.read_text(encoding="utf-8")


@pytest.fixture
def _in_the_folder(tmp_path, monkeypatch):
    """The example as if it lay in drivers/transport."""
    (tmp_path / "udp.py").write_text(CODE, encoding="utf-8")
    monkeypatch.setattr(drivers.transport, "__path__", [*drivers.transport.__path__, str(tmp_path)])
    media.cache_clear()
    yield
    media.cache_clear()


class UdpLink(Link, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`Link` with the kind that the page adds to it."""

    kind: Literal["can", "serial", "udp"] = "can"


class UdpRobotConfig(RobotConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`RobotConfig` with that link."""

    link: UdpLink = UdpLink()


@pytest.fixture
def _in_robot_toml(monkeypatch):
    """The kind of link as if it stood in disco_hw/config/robot.py."""
    monkeypatch.setattr(robot_file, "RobotConfig", UdpRobotConfig)


@pytest.fixture
def controller():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(10.0)
        yield opened


@pytest.fixture
def transport(tmp_path, _in_the_folder, _in_robot_toml, controller):
    channel = f"127.0.0.1:{controller.getsockname()[1]}"
    link = load_robot(robot_toml(tmp_path, f'kind = "udp"\nchannel = "{channel}"')).link
    with closing(create_transport(**link.medium_fields())) as transport:
        transport.open()
        up(transport)
        yield transport


def test_frames_go_both_ways_and_what_is_none_is_counted(transport, controller):
    send(transport, outgoing(0x123, b"abc"))
    datagram, host = controller.recvfrom(100)
    assert datagram == b"\x23\x01abc"
    for hostile in (b"", b"x", bytes(11), b"\xff\xffx"):
        controller.sendto(hostile, host)
    controller.sendto(b"\x01\x02" + bytes(range(8)), host)
    (received,) = collect(transport, 1)
    assert received.frame == Frame(0x201, bytes(range(8)))
    assert transport.stats.malformed == 4
    assert transport.stats.frames_received == 1


def test_a_controller_that_goes_and_comes_back_is_a_new_link(transport, controller):
    address = controller.getsockname()
    controller.close()
    # The link comes up again at once, as datagrams know no connection: each frame sent loses it anew.
    error = wait_until(lambda: (transport.send(outgoing(), time.monotonic_ns()) and False) or transport.last_error)
    assert f"udp 127.0.0.1:{address[1]}: [Errno {errno.ECONNREFUSED}]" in error
    assert "is the controller switched on" in error
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(address)
        again.settimeout(10.0)
        wait_until(lambda: transport.state is LinkState.UP and transport.generation > 1)
        wait_until(lambda: transport.send(outgoing(0x7), time.monotonic_ns()))
        while again.recv(100)[:2] != b"\x07\x00":
            pass


@pytest.mark.usefixtures("_in_robot_toml")
def test_every_driver_that_speaks_over_can_speaks_over_the_medium_and_no_other_does(tmp_path):
    for name, driver in motor_drivers().items():
        file = robot_toml(tmp_path, f'driver = "{name}"\nkind = "udp"\n{EXAMPLES[name]}')
        if "can" in driver.kinds:
            assert load_robot(file).link.kind == "udp"
        else:
            with pytest.raises(InputError, match=f'{name} does not speak over "udp"; write "serial"$'):
                load_robot(file)


@pytest.mark.usefixtures("_in_the_folder")
def test_an_address_that_is_none_is_refused_in_one_line():
    with pytest.raises(TransportSettingsError, match=r'^link\.channel: "can0" is no address; write host:port$'):
        create_transport("udp", channel="can0")


def test_without_the_file_there_is_no_such_kind():
    with pytest.raises(TransportSettingsError, match='"udp" is not a kind of link; write "can" or "serial"'):
        create_transport("udp", channel="127.0.0.1:1")
