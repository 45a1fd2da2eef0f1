import socket
import stat

import pytest

from sim.unix_listener import SocketPathError, bind_private

KINDS = [socket.SOCK_SEQPACKET, socket.SOCK_STREAM, socket.SOCK_DGRAM]


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_owner_may_open_it(tmp_path, kind):
    with bind_private(tmp_path / "s", kind):
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
        with socket.socket(socket.AF_UNIX, kind) as client:
            client.connect(str(tmp_path / "s"))


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_dead_process_left_is_replaced(tmp_path, kind):
    bind_private(tmp_path / "s", kind).close()
    assert (tmp_path / "s").exists()
    bind_private(tmp_path / "s", kind).close()


@pytest.mark.parametrize("kind", KINDS)
def test_a_live_socket_is_left_alone(tmp_path, kind):
    with bind_private(tmp_path / "s", kind), pytest.raises(SocketPathError, match="another process listens here"):
        bind_private(tmp_path / "s", kind)


def test_a_socket_of_another_kind_is_left_alone(tmp_path):
    with (
        bind_private(tmp_path / "s", socket.SOCK_DGRAM),
        pytest.raises(SocketPathError, match=r"s: in use .* choose another path"),
    ):
        bind_private(tmp_path / "s", socket.SOCK_SEQPACKET)


def test_a_file_is_left_alone(tmp_path):
    (tmp_path / "s").write_text("precious")
    with pytest.raises(SocketPathError, match="not a socket"):
        bind_private(tmp_path / "s", socket.SOCK_SEQPACKET)
    assert (tmp_path / "s").read_text() == "precious"


@pytest.mark.parametrize("path", ["missing/s", "x" * 120])
def test_an_impossible_path_is_one_clear_line(tmp_path, path):
    with pytest.raises(SocketPathError, match="cannot listen here") as error:
        bind_private(tmp_path / path, socket.SOCK_SEQPACKET)
    assert "\n" not in str(error.value)
