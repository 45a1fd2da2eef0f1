"""In processes of their own: signals are per process."""

import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.private_files import SocketPathError, bind_private
from sim.process import TextRecord
from tests.tables import thinned

SCRIPT = """
import select, sys
from sim.process import StopSignal
stop = StopSignal()
assert not stop.requested and not select.select([stop.fileno()], [], [], 0)[0]
print("ready", flush=True)
select.select([stop.fileno()], [], [], 60)
sys.exit(7 if stop.requested else 1)
"""


@thinned("number", [signal.SIGTERM, signal.SIGINT], quick=1)
def test_signal_wakes_and_is_remembered(number):
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(number)
        assert process.wait(60) == 7


def test_lines_are_there_after_flush_and_close(tmp_path):
    reported = []
    record = TextRecord(tmp_path / "record", reported.append)
    record.line("one")
    record.flush()
    assert (tmp_path / "record").read_text() == "one\n"
    record.line("two")
    record.close()
    record.close()
    assert (tmp_path / "record").read_text() == "one\ntwo\n"
    assert (reported, record.error) == ([], None)


@pytest.mark.parametrize("end", ["flush", "close"])
def test_a_full_disk_is_reported_once_and_nothing_raises(end):
    reported = []
    record = TextRecord(Path("/dev/full"), reported.append)
    record.line("one")
    getattr(record, end)()
    record.line("two" * 100_000)
    record.flush()
    record.close()
    assert reported == ["/dev/full: No space left on device; nothing more is recorded in it"]
    assert record.error == reported[0]


def test_an_impossible_path_raises(tmp_path):
    with pytest.raises(FileNotFoundError):
        TextRecord(tmp_path / "missing" / "record", print)


KINDS = [socket.SOCK_SEQPACKET, socket.SOCK_STREAM, socket.SOCK_DGRAM]


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_owner_may_open_a_live_socket_and_nobody_takes_its_place(tmp_path, kind):
    with bind_private(tmp_path / "s", kind):
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
        with socket.socket(socket.AF_UNIX, kind) as client:
            client.connect(str(tmp_path / "s"))
        with pytest.raises(SocketPathError, match="another process listens there"):
            bind_private(tmp_path / "s", kind)


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_dead_process_left_is_replaced(tmp_path, kind):
    bind_private(tmp_path / "s", kind).close()
    assert (tmp_path / "s").exists()
    bind_private(tmp_path / "s", kind).close()


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
