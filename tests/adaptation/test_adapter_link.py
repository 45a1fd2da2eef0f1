"""The daemon's end against a peer that the test plays, without the adapter's process."""

import socket
import sys

import msgspec
import pytest

from disco_hw.adaptation import adapter_link as link_module
from disco_hw.adaptation.adapter_link import ProcessLink, Report, Samples


@pytest.fixture
def pair(monkeypatch):
    """A link and its peer's socket; the process behind it sleeps."""
    peers = []
    make = socket.socketpair

    def socketpair(*arguments):
        ours, theirs = make(*arguments)
        peers.append(theirs.dup())
        return ours, theirs

    spawn = link_module.spawn_at_normal_priority
    sleeper = [sys.executable, "-c", "import time; time.sleep(60)"]
    monkeypatch.setattr(link_module.socket, "socketpair", socketpair)
    monkeypatch.setattr(link_module, "spawn_at_normal_priority", lambda _command, pass_fds: spawn(sleeper, ()))
    link = ProcessLink()
    yield link, peers[0]
    link.close()
    peers[0].close()


def test_messages_and_reports_cross(pair):
    link, peer = pair
    link.send(Samples(7))
    assert msgspec.msgpack.decode(peer.recv(65536))["now_ns"] == 7
    peer.send(msgspec.msgpack.encode(Report(8, "well")))
    assert link.receive() == (Report(8, "well"),)
    assert (link.stats.sent, link.stats.reports) == (1, 1)


def test_a_peer_that_does_not_read_costs_counted_packets_and_no_time(pair):
    link, _ = pair
    for _ in range(20_000):
        link.send(Samples(1))
        if link.stats.dropped > 5:
            break
    assert link.stats.dropped > 5
    assert link.stats.alive


def test_garbage_is_counted(pair):
    link, peer = pair
    peer.send(b"\xc1 nothing of ours")
    assert link.receive() == ()
    assert link.stats.garbled == 1
    assert link.stats.alive


def test_a_flood_of_reports_is_taken_in_pieces(pair):
    link, peer = pair
    for k in range(10):
        peer.send(msgspec.msgpack.encode(Report(k, "again")))
    assert len(link.receive()) == 4


def test_a_peer_that_hangs_up_is_a_death_and_can_be_replaced(pair):
    link, peer = pair
    peer.shutdown(socket.SHUT_RDWR)
    link.receive()
    assert not link.stats.alive
    assert link.stats.deaths == 1
    link.send(Samples(1))
    assert link.stats.dropped == 1
    assert link.restart()
    assert link.stats.alive
