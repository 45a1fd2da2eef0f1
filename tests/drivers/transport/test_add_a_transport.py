"""The medium that docs/add-a-transport.md explains carries frames, over real sockets, and is found by its kind."""

import errno
import socket
import time
from contextlib import closing
from pathlib import Path

import pytest

import drivers.transport
from disco_hw.config.robot import Link
from drivers.transport import TransportSettingsError, create_transport, media
from drivers.types import Frame, LinkState
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


@pytest.fixture
def controller():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(10.0)
        yield opened


@pytest.fixture
def transport(_in_the_folder, controller):
    link = Link(kind="udp", channel=f"127.0.0.1:{controller.getsockname()[1]}")
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


@pytest.mark.usefixtures("_in_the_folder")
def test_an_address_that_is_none_is_refused_in_one_line():
    with pytest.raises(TransportSettingsError, match=r'^link\.channel: "can0" is no address; write host:port$'):
        create_transport("udp", channel="can0")


def test_without_the_file_there_is_no_such_kind():
    with pytest.raises(TransportSettingsError, match='"udp" is not a kind of link; write "can" or "serial"'):
        create_transport("udp", channel="127.0.0.1:1")
