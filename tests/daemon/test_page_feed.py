"""Feed and subscriber over real sockets, the subscriber in a process of its own where it is to be broken."""

import os
import signal
import stat
import subprocess
import sys
import time
from contextlib import closing

import pytest

from disco_hw.daemon.page_feed import FeedSubscriber, ViewerFeed, WatchedRecorder, feed_path
from disco_hw.errors import InputError
from disco_hw.log import records
from disco_hw.log.recorder import MemoryRecorder
from drivers.types import WheelSample
from tests.drivers.waiting import wait_until
from tools.viewer_run import PERIOD_NS, tick_records

_WATCH = """
import sys
from pathlib import Path
from disco_hw.daemon.page_feed import FeedSubscriber
subscriber = FeedSubscriber(Path(sys.argv[1]))
got = 0
print("ready", flush=True)
while True:
    batch = subscriber.receive(0.1)
    got += len(batch)
    print(got, subscriber.missed, flush=True)
"""


@pytest.fixture
def path(tmp_path):
    return feed_path(tmp_path / "control.sock")


@pytest.fixture
def feed(path):
    with closing(ViewerFeed(path)) as made:
        yield made


@pytest.fixture
def subscriber(feed, path):
    with closing(FeedSubscriber(path)) as made:
        yield made


def put_ticks(feed, first, count):
    """Feed the records of so many ticks; returns the next tick's number."""
    for tick in range(first, first + count):
        feed.put(*tick_records(tick))
    return first + count


def connected(feed, *subscribers):
    """Tick until every subscriber has got something; returns the next tick's number."""
    tick, waiting = 0, set(subscribers)

    def everybody_got_something():
        nonlocal tick, waiting
        tick = put_ticks(feed, tick, 1)
        waiting -= {subscriber for subscriber in waiting if subscriber.receive(0.01)}
        return not waiting

    wait_until(everybody_got_something, 60.0)
    return tick


def test_a_loop_whose_ticks_are_late_now_and_then_is_shown_25_times_a_second(feed, subscriber):
    first = connected(feed, subscriber)
    sent = feed.sent
    for tick in range(first, first + 500):
        now_ns, got = tick_records(tick)
        feed.put(now_ns + tick % 7 * 50_000, got)
    assert feed.sent - sent == pytest.approx(250, abs=2)


@pytest.mark.parametrize("ticks_before", range(5))
def test_records_arrive_whole_and_without_frames(feed, subscriber, ticks_before):
    tick = put_ticks(feed, connected(feed, subscriber), ticks_before)
    first_ns = tick_records(tick)[0]
    sent = []
    for number in range(tick, tick + 30):
        now_ns, got = tick_records(number)
        sent += [record for record in got if not isinstance(record, records.FrameIn | records.Plan)]
        feed.put(now_ns, got)
    last_ns = tick_records(tick + 60)[0]
    sent.append(records.Event(last_ns, "info", "daemon", "the last one"))
    feed.put(last_ns, sent[-1:])
    received = []
    wait_until(lambda: received.extend(subscriber.receive(0.1)) or (received and received[-1][0] >= last_ns), 60.0)
    # What the ticks before left behind, to be published or on its way, depends on when the connection came about.
    got_records = [record for _, record in received if record.t_ns >= first_ns]
    assert [record for record in got_records if not isinstance(record, records.Plan)] == sent
    plans = [record for record in got_records if isinstance(record, records.Plan)]
    assert 8 <= len(plans) <= 16, "one a batch"
    assert (subscriber.missed, subscriber.malformed, feed.refused) == (0, 0, 0)
    times = [now_ns for now_ns, _ in received]
    assert times == sorted(times)


def test_nobody_looking_costs_nothing_and_keeps_nothing(feed):
    put_ticks(feed, 0, 500)
    assert feed.sent == 0
    assert feed._pending == []


def test_the_feed_notices_that_everybody_left(feed, subscriber):
    tick = connected(feed, subscriber)
    subscriber.close()

    def publishes_no_more():
        nonlocal tick
        before, tick = feed.sent, put_ticks(feed, tick, 10)
        return feed.sent == before

    wait_until(publishes_no_more, 60.0)


def test_a_stopped_page_holds_up_neither_the_feed_nor_another_page(feed, subscriber, path):
    process = subprocess.Popen([sys.executable, "-c", _WATCH, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        tick = connected(feed, subscriber)
        while process.stdout.readline().startswith("0 "):
            tick = put_ticks(feed, tick, 1)
        os.kill(process.pid, signal.SIGSTOP)
        slow, seen = 0, 0
        for number in range(tick, tick + 12_000):
            now_ns, got = tick_records(number)
            begun = time.perf_counter()
            feed.put(now_ns, got)
            slow += time.perf_counter() - begun > 0.02
            if number % 20 == 0:
                seen += len(subscriber.receive(0.001))
        # Once nothing more fits into the stopped page's socket each one would wait; a host that pauses makes few wait.
        assert slow < 1000, "it waited"
        assert feed.refused == 0
        seen += len(subscriber.receive(2.0))
        assert seen > 10_000, "the other page starved"
        os.kill(process.pid, signal.SIGCONT)
        tick, deadline = tick + 12_000, time.monotonic() + 60.0
        missed = 0
        while missed == 0:
            assert time.monotonic() < deadline, "the stopped page does not know that it missed something"
            feed.put(*tick_records(tick))
            tick += 5
            missed = int(process.stdout.readline().split()[1])
    finally:
        process.kill()
        process.wait()


def test_what_cannot_be_encoded_is_counted(feed, subscriber):
    tick = connected(feed, subscriber)
    # What waits goes out with the next tick, so that the event is alone in its batch.
    feed.put(*tick_records(tick + 50))
    now_ns = tick_records(tick + 100)[0]
    feed.put(now_ns, [records.Event(now_ns, "info", "x", object())])
    assert feed.refused == 1


def test_a_page_survives_the_daemons_restart(path):
    with closing(FeedSubscriber(path)) as subscriber:
        for _ in range(2):
            with closing(ViewerFeed(path)) as feed:
                connected(feed, subscriber)
    assert not path.exists()


def test_a_socket_that_was_removed_is_made_again_for_its_owner_alone(feed, path):
    path.unlink()
    feed.restore()
    assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
    with closing(FeedSubscriber(path)) as late:
        connected(feed, late)
    feed.restore()
    path.unlink()
    path.parent.rename(path.parent.with_name("gone"))
    feed.restore()
    assert feed.refused == 1


def test_a_directory_that_somebody_else_has_put_in_its_place_ends_no_drive(feed, path, monkeypatch):
    def fail(*_, **__):
        raise PermissionError

    path.unlink()
    path.parent.rename(path.parent.with_name("gone"))
    with monkeypatch.context() as without:
        without.setattr(type(path), "stat", fail)
        feed.restore()
    assert feed.refused == 1


def test_the_socket_is_its_owners_alone(feed, path):
    assert path.is_socket()
    assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0


def test_a_path_that_cannot_be_used_is_reported_in_one_line(tmp_path):
    with pytest.raises(InputError, match=r"shorten daemon\.control_socket"):
        ViewerFeed(tmp_path / ("x" * 120))


def test_the_recorder_gets_everything_first(feed):
    memory = MemoryRecorder()
    both = WatchedRecorder(memory, feed, feed)
    now_ns, got = tick_records(0)
    both.put(now_ns, got)
    both.put(now_ns + PERIOD_NS, got)
    assert memory.ticks == [(now_ns, tuple(got)), (now_ns + PERIOD_NS, tuple(got))]
    assert both.poll().ticks == both.close().ticks == 2


def test_who_wants_each_tick_has_its_wheels_before_its_record(feed, tmp_path):
    path, memory = tmp_path / "control.sock.tick", MemoryRecorder()
    with closing(ViewerFeed(path, period_s=0.0)) as ticks, closing(FeedSubscriber(path)) as subscriber:

        def received():
            return wait_until(
                lambda: [record for tick_ns, record in subscriber.receive(0.1) if tick_ns == now_ns], 60.0
            )

        recorder = WatchedRecorder(memory, feed, ticks)
        now_ns, got = tick_records(connected(ticks, subscriber))
        wheels = [record for record in got if isinstance(record, WheelSample)]
        recorder.announce(now_ns, wheels)
        assert wheels
        assert received() == wheels
        assert memory.ticks == []
        recorder.put(now_ns, got)
        assert [record for record in received() if isinstance(record, WheelSample)] == wheels
        assert subscriber.missed == 0
