"""The page's end of the feed: what it receives, what it counts as lost, and that nothing malformed gets through."""

import time

import msgspec
import pytest
import zmq

from disco_hw.daemon.page_feed import FeedSubscriber
from disco_hw.log import batch_encoder
from disco_hw.log.records import Estimate
from tools.viewer_run import tick_records


class Daemon:
    """A publisher that sends whatever the test wants."""

    def __init__(self, path):
        self.path, self._context = path, zmq.Context()
        self.open()

    def open(self):
        self.socket = self._context.socket(zmq.PUB)
        self.socket.bind(f"ipc://{self.path}")

    def send(self, sequence, tick=0):
        now_ns, got = tick_records(tick)
        self.socket.send(batch_encoder()(sequence, now_ns, got))
        return now_ns, got

    def close(self):
        self.socket.close(0)


@pytest.fixture
def ends(tmp_path):
    daemon, subscriber = Daemon(tmp_path / "feed"), FeedSubscriber(tmp_path / "feed")
    yield daemon, subscriber
    subscriber.close()
    daemon.close()


def connected(daemon, subscriber, sequence=1):
    """Send until something arrives; returns the number after the last one sent."""
    deadline = time.monotonic() + 60.0
    while not (received := subscriber.receive(0.02)):
        assert time.monotonic() < deadline, "nothing arrives"
        # Each of another time, so that the last one is known when it comes.
        last_ns, _ = daemon.send(sequence, tick=1000 + sequence)
        sequence += 1
    while last_ns not in {t_ns for t_ns, _ in received}:
        received = subscriber.receive(10.0)
        assert received, "what was sent after the first one to arrive does not"
    return sequence


def test_a_batch_arrives_whole_with_its_ticks_time(ends):
    daemon, subscriber = ends
    number = connected(daemon, subscriber)
    now_ns, got = daemon.send(number, tick=7)
    received = subscriber.receive(30.0)
    assert {t_ns for t_ns, _ in received} == {now_ns}
    assert len(received) == len(got)
    assert any(isinstance(record, Estimate) for _, record in received)
    assert subscriber.missed == subscriber.malformed == 0


def test_gaps_in_the_numbers_are_counted_and_a_new_daemon_is_none(ends):
    daemon, subscriber = ends
    number = connected(daemon, subscriber)
    daemon.send(number + 3)
    assert subscriber.receive(30.0)
    assert subscriber.missed == 3
    daemon.close()
    daemon.open()
    connected(daemon, subscriber)
    assert subscriber.missed == 3


UNKNOWN_RECORD = msgspec.msgpack.encode([1, 2, [[99, None]]])


@pytest.mark.parametrize(
    "garbage", [b"", b"\xc1", b"\xff" * 20, b"[1]", msgspec.msgpack.encode({"a": 1}), UNKNOWN_RECORD]
)
def test_what_is_none_of_the_daemons_is_counted_and_dropped(ends, garbage):
    daemon, subscriber = ends
    number = connected(daemon, subscriber)
    daemon.socket.send(garbage)
    assert subscriber.receive(30.0) == []
    assert subscriber.malformed == 1
    daemon.send(number)
    assert subscriber.receive(30.0)


def test_without_a_daemon_it_waits_no_longer_than_it_is_told(tmp_path):
    subscriber = FeedSubscriber(tmp_path / "none")
    assert subscriber.receive(0.01) == []
    subscriber.close()
    subscriber.close()


def test_it_does_not_listen_to_a_feed_that_a_stranger_could_have_put_there(ends, tmp_path):
    daemon, subscriber = ends
    tmp_path.chmod(0o777)
    for number in range(1, 20):
        daemon.send(number)
        assert subscriber.receive(0.02) == []
    tmp_path.chmod(0o700)
    connected(daemon, subscriber, 20)
