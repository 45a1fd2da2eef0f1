"""The two threads, against a medium that fails where and when a test says; it stands for hardware."""

import queue
import threading
import time
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport import reconnecting
from drivers.transport.reconnecting import (
    BackoffPolicy,
    LinkLostError,
    ReconnectingTransport,
    TransmitBusyError,
    TransmitQueue,
    TransportCounters,
    next_delay_s,
)
from drivers.types import Frame, LinkState, OutgoingFrame, ReceivedFrame
from tests.drivers.transport.links import opened
from tests.drivers.waiting import collect, outgoing, send, wait_until

POLICY = BackoffPolicy(first_s=0.1, longest_s=1.0, steady_s=5.0)


def test_delays_double_up_to_the_longest():
    delays = [None]
    for _ in range(6):
        delays.append(next_delay_s(POLICY, delays[-1], up_for_s=0.0))
    assert delays[1:] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_steady_link_starts_afresh_and_a_flapping_one_does_not():
    assert next_delay_s(POLICY, 0.8, up_for_s=5.0) == 0.1
    assert next_delay_s(POLICY, 0.4, up_for_s=4.9) == 0.8


def test_nothing_is_lost_between_threads():
    counters = TransportCounters()

    def count():
        for _ in range(2000):
            counters.add(frames_sent=1, malformed=2)

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counters.snapshot().frames_sent == 8000
    assert counters.snapshot().malformed == 16000


def test_a_counter_that_does_not_exist_is_a_programming_error():
    with pytest.raises(KeyError):
        TransportCounters().add(frames_lost=1)


def frame(can_id, number=0, deadline_ns=100):
    return OutgoingFrame(Frame(can_id, bytes((number,))), deadline_ns)


def drain(queue):
    return list(iter(queue.pop, None))


def pairs(frames):
    """Identifier and number of each frame."""
    return [(outgoing.frame.can_id, outgoing.frame.data[0]) for outgoing in frames]


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.booleans()), max_size=40))
def test_what_has_not_expired_is_sent_lowest_identifier_first_and_equal_ones_as_they_came(frames):
    queue = TransmitQueue(64)
    for number, (can_id, is_expired) in enumerate(frames):
        assert queue.push(frame(can_id, number, deadline_ns=10 if is_expired else 100)) is None
    assert queue.expire(50) == sum(is_expired for _, is_expired in frames)
    kept = [(can_id, number) for number, (can_id, is_expired) in enumerate(frames) if not is_expired]
    assert pairs(drain(queue)) == sorted(kept)


def test_frames_of_one_rank_keep_their_order_and_a_lower_rank_goes_first():
    queue = TransmitQueue(8)
    for can_id in (0x078, 0x06B, 0x06D, 0x067):
        queue.push(OutgoingFrame(Frame(can_id, b""), 100, rank=0x7F))
    queue.push(OutgoingFrame(Frame(0x7E2, b""), 100, rank=0))
    assert [outgoing.frame.can_id for outgoing in drain(queue)] == [0x7E2, 0x078, 0x06B, 0x06D, 0x067]


def test_a_frame_never_outlives_its_deadline():
    queue = TransmitQueue(4)
    queue.push(frame(1, deadline_ns=10))
    queue.push(frame(2, deadline_ns=20))
    assert queue.expire(10) == 0
    assert queue.expire(11) == 1
    assert queue.pop().frame.can_id == 2


def test_full_queue_refuses_the_least_urgent_frame():
    queue = TransmitQueue(2)
    queue.push(frame(0x100, 0))
    queue.push(frame(0x200, 1))
    refused = frame(0x300)
    assert queue.push(refused) is refused
    same = frame(0x200, 2)
    assert queue.push(same) is same, "of equal ones the newest gives way, order is kept"
    estop = frame(0x080)
    assert queue.push(estop).frame == Frame(0x200, b"\x01")
    assert [outgoing.frame.can_id for outgoing in drain(queue)] == [0x080, 0x100]


def test_a_frame_put_back_stays_before_its_equals():
    queue = TransmitQueue(2)
    first, second, urgent = frame(2, 1), frame(2, 2), frame(1)
    queue.push(first)
    queue.push(second)
    assert queue.pop() is first
    queue.push(urgent)
    queue.requeue(first)
    assert drain(queue) == [urgent, first, second]
    queue.push(first)
    queue.push(second)
    popped = [queue.pop(), queue.pop()]
    for one in reversed(popped):
        queue.requeue(one)
    assert drain(queue) == [first, second]
    queue.push(first)
    assert queue.clear() == 1
    assert len(queue) == 0


FAST = BackoffPolicy(first_s=0.001, longest_s=0.01, steady_s=0.05)


class ScriptedMedium:
    """Connections that obey: put a frame to receive it, put an exception to lose the link.

    A write waits until `may_write` is set, for half a minute at most.
    """

    name = "scripted"

    def __init__(self):
        self.incoming = queue.Queue()
        self.refusals = []
        self.attempts = 0
        self.connections = []
        self.write_error = None
        self.may_write = threading.Event()
        self.may_write.set()

    def connect(self, counters):
        self.attempts += 1
        if self.refusals:
            raise self.refusals.pop(0)
        self.connections.append(ScriptedConnection(self))
        return self.connections[-1]

    def explain(self, error):
        return f"scripted: {error}"

    @property
    def sent(self):
        return [frame for connection in self.connections for frame in connection.sent]


class ScriptedConnection:
    def __init__(self, medium):
        self.medium = medium
        self.sent = []
        self.closed = False

    def read(self):
        try:
            item = self.medium.incoming.get(timeout=0.01)
        except queue.Empty:
            return ()
        if isinstance(item, BaseException):
            raise item
        return item

    def write(self, frame):
        assert not self.closed
        self.medium.may_write.wait(30.0)
        if self.medium.write_error is not None:
            raise self.medium.write_error
        self.sent.append(frame)

    def close(self):
        self.closed = True
        raise OSError("a device that is gone cannot be closed")


@pytest.fixture
def medium():
    return ScriptedMedium()


@pytest.fixture
def unopened(medium):
    transport = ReconnectingTransport(medium, backoff=FAST)
    yield transport
    medium.may_write.set()
    transport.close()


@pytest.fixture
def transport(unopened):
    up(unopened)
    return unopened


def up(transport, generation=1):
    transport.open()
    wait_until(lambda: transport.state is LinkState.UP and transport.generation == generation)


def test_carries_frames_both_ways_of_any_identifier_and_length(transport, medium):
    for frame in (Frame(0x101, b"\x07"), Frame(0, b""), Frame(0x7FF, bytes(8))):
        send(transport, outgoing(frame.can_id, frame.data))
        wait_until(lambda: medium.sent and medium.sent[-1] == frame)  # noqa: B023
    frame = ReceivedFrame(5, Frame(0x110, b"\x01\x02"))
    medium.incoming.put([frame, frame])
    assert collect(transport, 2) == [frame, frame]
    assert transport.receive() == ()
    wait_until(lambda: transport.stats.frames_sent == 3)
    assert transport.stats.frames_received == 2
    assert transport.stats.bytes_received == 4


def test_keeps_trying_until_the_device_is_there(unopened, medium):
    assert unopened.state is LinkState.CLOSED
    medium.refusals = [OSError("not there"), RuntimeError("odd"), KeyError("odder")]
    up(unopened)
    assert medium.attempts == 4
    assert unopened.last_error is None
    assert unopened.stats.reconnects == 0


@pytest.mark.parametrize("error", [OSError("unplugged"), IndexError("bug in a backend"), LinkLostError("bus-off")])
def test_any_error_while_receiving_is_counted_and_the_link_made_anew(transport, medium, error):
    medium.incoming.put(error)
    up(transport, generation=2)
    assert transport.stats.receive_errors == 1
    assert transport.stats.reconnects == 1
    assert medium.connections[0].closed
    medium.incoming.put([ReceivedFrame(1, Frame(1, b""))])
    assert len(collect(transport, 1)) == 1


def test_an_error_while_sending_makes_the_link_anew(transport, medium):
    """Some backends report a dead line only when sending; receiving would be silent for ever."""
    medium.write_error = BrokenPipeError("server gone")
    send(transport, outgoing())
    wait_until(lambda: transport.generation >= 2)
    assert transport.stats.send_errors >= 1
    medium.write_error = None
    wait_until(lambda: transport.state is LinkState.UP)
    send(transport, outgoing(data=b"again"))
    wait_until(lambda: Frame(0x100, b"again") in medium.sent)
    generation = transport.generation
    time.sleep(0.05)
    assert transport.generation == generation, "the new link is kept"


@pytest.mark.parametrize("way", ["read", "write"])
def test_the_loss_is_reported_in_the_mediums_words(medium, way):
    with opened(medium, BackoffPolicy(first_s=5.0)) as transport:
        up(transport)
        if way == "read":
            medium.incoming.put(OSError("unplugged"))
        else:
            medium.write_error = OSError("unplugged")
            send(transport, outgoing())
        wait_until(lambda: transport.state is LinkState.CONNECTING and medium.connections[0].closed)
        assert transport.last_error == "scripted: unplugged"


@pytest.mark.parametrize("flaps", [False, True])
def test_a_device_that_is_absent_or_flaps_is_tried_less_and_less_often(medium, flaps):
    if flaps:
        medium.write_error = OSError("always")
        for _ in range(10_000):
            medium.incoming.put(OSError("gone at once"))
    else:
        medium.refusals = [OSError("not there")] * 10_000
    started = time.monotonic()
    with opened(medium, BackoffPolicy(first_s=0.01, longest_s=10.0, steady_s=5.0)):
        wait_until(lambda: medium.attempts >= 5)
        assert time.monotonic() - started >= 0.01 + 0.02 + 0.04 + 0.08


def test_an_idle_link_costs_nothing(transport):
    before_s, cpu_before_s = time.monotonic(), time.process_time()
    time.sleep(0.3)
    assert time.process_time() - cpu_before_s < 0.5 * (time.monotonic() - before_s)


def test_nothing_old_is_sent_on_a_new_link(transport, medium):
    medium.may_write.clear()
    send(transport, outgoing(data=b"a"), outgoing(data=b"b"))
    wait_until(transport._writing.locked)
    medium.incoming.put(OSError("unplugged"))
    wait_until(lambda: transport.state is LinkState.CONNECTING)
    medium.may_write.set()
    wait_until(lambda: transport.generation == 2)
    assert transport.stats.send_errors == 1, "what was dropped is counted"
    send(transport, outgoing(data=b"new"))
    wait_until(lambda: medium.connections[1].sent)
    assert medium.connections[1].sent == [Frame(0x100, b"new")]


def test_frames_received_on_the_old_link_are_not_delivered_on_the_new(transport, medium):
    medium.incoming.put([ReceivedFrame(1, Frame(1, b"old"))])
    wait_until(lambda: transport.stats.frames_received == 1)
    medium.incoming.put(OSError("unplugged"))
    wait_until(lambda: transport.generation == 2)
    assert transport.receive() == ()


def test_no_sending_while_the_link_is_down(unopened, medium):
    medium.refusals = [OSError("not there")] * 100_000
    unopened.open()
    wait_until(lambda: unopened.last_error == "scripted: not there")
    assert not unopened.send(outgoing(), time.monotonic_ns())
    assert unopened.stats.send_errors == 1


def test_a_late_frame_is_never_sent(transport, medium):
    assert not transport.send(OutgoingFrame(Frame(1, b""), 999), 1_000)
    assert transport.stats.expired == 1
    medium.may_write.clear()
    send(transport, outgoing(0x200, b"first"))
    wait_until(transport._writing.locked)
    # In time when it is handed over, too late when its turn comes.
    assert transport.send(OutgoingFrame(Frame(0x100, b"late"), deadline_ns=1), now_ns=1)
    send(transport, outgoing(0x101, b"good"))
    medium.may_write.set()
    wait_until(lambda: len(medium.sent) == 2)
    assert [frame.data for frame in medium.sent] == [b"first", b"good"]
    assert transport.stats.expired == 2


def test_a_stalled_medium_never_blocks_the_caller_and_an_emergency_stop_still_fits(transport, medium):
    medium.may_write.clear()
    send(transport, outgoing(0x300))
    wait_until(transport._writing.locked)
    accepted = sum(transport.send(outgoing(0x200), time.monotonic_ns()) for _ in range(200))
    assert not medium.sent, "the caller waited for the medium"
    assert accepted == reconnecting.TRANSMIT_CAPACITY
    assert transport.stats.transmit_queue_full == 200 - accepted
    send(transport, outgoing(0x080))
    medium.may_write.set()
    wait_until(lambda: len(medium.sent) >= 2)
    assert medium.sent[1].can_id == 0x080


def test_no_room_on_the_medium_is_counted_once_a_frame_and_tried_again(transport, medium):
    medium.write_error = TransmitBusyError("ENOBUFS")
    send(transport, outgoing(0x100, b"kept"))
    wait_until(lambda: transport.stats.transmit_queue_full)
    assert transport.last_error == "scripted: ENOBUFS"
    time.sleep(0.02)
    medium.write_error = None
    wait_until(lambda: medium.sent == [Frame(0x100, b"kept")])
    assert transport.stats.transmit_queue_full == 1
    assert transport.generation == 1


def test_a_reader_that_falls_behind_gets_the_newest_and_the_loss_is_counted(transport, medium):
    total = reconnecting.RECEIVE_CAPACITY + 10
    medium.incoming.put([ReceivedFrame(number, Frame(1, b"")) for number in range(total)])
    wait_until(lambda: transport.stats.receive_overflow == 10)
    received = transport.receive()
    assert (received[0].t_ns, received[-1].t_ns) == (10, total - 1)


def test_closing_sends_what_is_queued_and_ends_the_threads(transport, medium, monkeypatch):
    monkeypatch.setattr(reconnecting, "_DRAIN_S", 10.0)
    frames = [outgoing(0x080, bytes((number,))) for number in range(20)]
    send(transport, *frames)
    transport.close()
    assert medium.sent == [frame.frame for frame in frames]
    assert transport.state is LinkState.CLOSED
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("scripted")]
    transport.close()
    transport.open()
    assert transport.state is LinkState.CLOSED, "a closed transport stays closed"


def test_opening_twice_starts_one_pair_of_threads(transport, medium):
    transport.open()
    assert len([thread for thread in threading.enumerate() if thread.name.startswith("scripted")]) == 2


@pytest.mark.parametrize("frame", [Frame(0x800, b""), Frame(-1, b""), Frame(1, bytes(9)), Frame(1, b"", extended=True)])
def test_what_is_no_can_frame_is_the_callers_error(transport, frame):
    with pytest.raises(ValueError, match="not a classic CAN frame"):
        transport.send(OutgoingFrame(frame, 10), 1)


def test_a_link_is_left_open_while_frames_come_and_connected_again_when_none_does(monkeypatch):
    """Each read lasts 0.1 s by the link's clock; every fourth brings a frame, and after forty none does."""
    now_ns, reads, second = [0], [0], threading.Event()
    monkeypatch.setattr(reconnecting, "time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))

    class Answering(ScriptedConnection):
        def read(self):
            now_ns[0] += 100_000_000
            reads[0] += 1
            return [ReceivedFrame(now_ns[0], Frame(1, b""))] if reads[0] % 4 == 0 and reads[0] <= 40 else ()

    class Silent(ScriptedConnection):
        def read(self):
            second.set()
            time.sleep(0.01)
            return ()

    medium = ScriptedMedium()
    connections = iter((Answering(medium), Silent(medium)))
    medium.connect = lambda _counters: next(connections)
    with opened(medium, FAST, mute_after_s=0.5) as transport:
        assert second.wait(10.0)
        assert (reads[0], transport.generation) == (46, 2)
        assert "no frame received for 0.5 s" in transport.last_error
