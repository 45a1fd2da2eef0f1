from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.bus import CanBus, DeliveredFrame, FrameOutcome
from sim.can_protocol import CanFrame, ErrorState, TransmitOrder, frame_bits, stuffed_bits

BIT_NS = 2000  # 500 kbit/s
LONG_NS = 10**10
FRAME = CanFrame(0x110, bytes.fromhex("8d306902b4fb2c01"))


class ScriptedOutcomes:
    """A fault that deals out one outcome after the other, then leaves frames alone."""

    def __init__(self, *outcomes):
        self.left = list(outcomes)
        self.calls = []

    def outcome(self, now_ns, sender, frame):
        self.calls.append((now_ns, sender, frame))
        return self.left.pop(0) if self.left else FrameOutcome()


@pytest.fixture
def bus():
    return CanBus()


def bus_with(names, *arguments, **options):
    """Return a bus and its nodes, each called by a letter."""
    bus = CanBus(*arguments, **options)
    return bus, *(bus.attach(name) for name in names)


def data_of(deliveries):
    return [d for d in deliveries if not d.frame.error]


def test_a_frame_arrives_at_its_end_at_all_others():
    bus, a, b, c = bus_with("abc")
    bus.advance(5_000)
    assert bus.send(a, FRAME)
    end_ns = 5_000 + (frame_bits(FRAME) - 3) * BIT_NS
    assert bus.advance(end_ns - 1) == []
    (delivery,) = bus.advance(end_ns)
    assert delivery == DeliveredFrame(end_ns, a, FRAME, (b, c))
    assert (a.sent, a.received, b.received, c.received) == (1, 0, 1, 1)


def test_frames_follow_after_the_intermission():
    bus, a, _ = bus_with("ab")
    for _ in range(3):
        bus.send(a, FRAME)
    times = [d.t_ns for d in bus.advance(LONG_NS)]
    length_ns = frame_bits(FRAME) * BIT_NS
    assert times == [length_ns * (i + 1) - 3 * BIT_NS for i in range(3)]


@pytest.mark.parametrize("bitrate", [125_000, 83_333, 1_000_000])
def test_bit_rate(bitrate):
    bus, a, _ = bus_with("ab", bitrate)
    bus.send(a, FRAME)
    (delivery,) = bus.advance(LONG_NS)
    assert delivery.t_ns == pytest.approx((frame_bits(FRAME) - 3) * 1e9 / bitrate, abs=1.0)


def test_the_lowest_identifier_wins_and_the_loser_follows():
    bus, a, b, _ = bus_with("abc")
    bus.send(a, CanFrame(0x200))
    bus.send(b, CanFrame(0x100))
    assert [(d.sender, d.frame.can_id) for d in bus.advance(LONG_NS)] == [(b, 0x100), (a, 0x200)]


def test_a_frame_on_the_wire_is_not_interrupted():
    bus, a, b = bus_with("ab")
    bus.send(a, CanFrame(0x700))
    bus.advance(10 * BIT_NS)
    bus.send(b, CanFrame(0x001))
    bus.send(a, CanFrame(0x002))
    assert [d.frame.can_id for d in bus.advance(LONG_NS)] == [0x700, 0x001, 0x002]


@settings(max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=60),
    st.sampled_from(TransmitOrder),
    st.integers(20_000, 2_000_000),
)
def test_nothing_is_lost_or_reordered_and_the_wire_is_never_used_twice(sends, order, stride_ns):
    """FIFO keeps a sender's order, PRIORITY that of equal identifiers; ends are a frame apart, whatever the stride."""
    bus = CanBus()
    nodes = [bus.attach(str(i), order=order, capacity=100) for i in range(3)]
    expected = {0: [], 1: [], 2: []}
    for index, can_id, data in sends:
        # Distinct identifiers for each node, as the CAN specification asks.
        frame = CanFrame(can_id // 3 * 3 % 0x7FB + index, data)
        expected[index].append(frame)
        assert bus.send(nodes[index], frame)
    out, now_ns = [], 0
    while any(node.pending for node in nodes):
        now_ns += stride_ns
        out.extend(bus.advance(now_ns))
    for index, node in enumerate(nodes):
        got = [d.frame for d in out if d.sender is node]
        if order is TransmitOrder.FIFO:
            assert got == expected[index]
        else:
            assert got == sorted(expected[index], key=lambda frame: frame.can_id)
    for before, after in pairwise(out):
        assert after.t_ns - before.t_ns >= frame_bits(after.frame) * BIT_NS


def test_own_frames_come_back_only_if_asked(bus):
    a, b = bus.attach("a", echo=True), bus.attach("b")
    bus.send(a, FRAME)
    bus.send(b, CanFrame(0x700))
    assert [d.receivers for d in bus.advance(LONG_NS)] == [(b, a), (a,)]


def test_a_full_queue_refuses(bus):
    a, _ = bus.attach("a", capacity=2), bus.attach("b")
    assert [bus.send(a, FRAME) for _ in range(3)] == [True, True, False]
    assert a.refused_full == 1
    assert len(bus.advance(LONG_NS)) == 2
    assert bus.send(a, FRAME)


def test_a_destroyed_frame_is_sent_again_after_an_error_frame():
    bus, a, b = bus_with("ab", fault=ScriptedOutcomes(FrameOutcome(wire_error_bit=30)))
    bus.send(a, FRAME)
    (delivery,) = bus.advance(LONG_NS)
    error_ns = (30 + 1 + 6 + 6 + 8 + 3) * BIT_NS
    assert delivery.t_ns == error_ns + (frame_bits(FRAME) - 3) * BIT_NS
    assert (a.tec, b.rec, bus.error_frames) == (7, 0, 1)  # +8 then -1; +1 then -1


def test_a_frame_destroyed_for_ever_ends_in_bus_off_and_the_bus_is_free_again():
    bus, a, b = bus_with("ab", fault=ScriptedOutcomes(*[FrameOutcome(wire_error_bit=20)] * 32))
    bus.send(a, FRAME)
    bus.send(a, FRAME)
    out = bus.advance(LONG_NS)
    assert data_of(out) == []
    assert (a.state, a.bus_off_count, a.lost_by_bus_off, b.rec) == (ErrorState.BUS_OFF, 1, 2, 32)
    assert [d.frame.can_id for d in out if a in d.receivers] == [0x204, 0x204, 0x040]
    assert not bus.send(a, FRAME)
    c = bus.attach("c")
    bus.send(b, FRAME)
    (delivery,) = bus.advance(2 * LONG_NS)
    assert delivery.receivers == (c,)


def test_an_error_passive_sender_waits_eight_bits_before_it_sends_again():
    bus, a, b = bus_with("ab", fault=ScriptedOutcomes(*[FrameOutcome(wire_error_bit=20)] * 16))
    bus.send(a, CanFrame(0x100))
    bus.advance(16 * (20 + 1 + 6 + 6 + 8 + 3) * BIT_NS)
    assert a.state is ErrorState.PASSIVE
    bus.send(b, CanFrame(0x700))
    assert [d.frame.can_id for d in data_of(bus.advance(LONG_NS))] == [0x700, 0x100]


@pytest.mark.parametrize("others", ["", "b"], ids=["alone", "beside a node in bus-off"])
def test_a_node_that_nobody_acknowledges_repeats_for_ever_and_stays_error_passive(bus, others):
    a = bus.attach("a", capacity=3)
    for name in others:
        bus.force_bus_off(bus.attach(name))
    for _ in range(4):
        bus.send(a, FRAME)
    assert data_of(bus.advance(10**8)) == []
    assert (a.state, a.tec, a.pending, a.refused_full) == (ErrorState.PASSIVE, 128, 3, 1)
    bus.attach("c")
    assert len(data_of(bus.advance(2 * 10**8))) == 3


def test_a_missing_acknowledgement_takes_the_frame_up_to_its_slot_and_an_error_flag(bus):
    a = bus.attach("a")
    bus.send(a, FRAME)
    bus.advance(0)
    assert bus.next_event_ns() == (frame_bits(FRAME) - 3 - 9 + 1 + 6 + 8) * BIT_NS


def test_forced_bus_off_is_reported_at_once_and_recovery_takes_128_times_11_recessive_bits_after_the_request():
    bus, a, _ = bus_with("ab")
    bus.advance(9_000)
    bus.force_bus_off(a)
    assert bus.next_event_ns() == 9_000
    assert bus.advance(9_000) == [DeliveredFrame(9_000, a, CanFrame(0x040, bytes(8), error=True), (a,))]
    bus.advance(LONG_NS)
    assert a.state is ErrorState.BUS_OFF
    bus.request_recovery(a)
    due_ns = LONG_NS + 128 * 11 * BIT_NS
    assert bus.next_event_ns() == due_ns
    assert bus.advance(due_ns - 1) == []
    assert bus.advance(due_ns) == [DeliveredFrame(due_ns, a, CanFrame(0x100, bytes(8), error=True), (a,))]
    assert a.state is ErrorState.ACTIVE
    assert bus.send(a, FRAME)


def test_on_a_busy_bus_each_frame_counts_once_towards_recovery(bus):
    a, b, _ = (bus.attach(name, capacity=1000) for name in "abc")
    bus.force_bus_off(a)
    bus.request_recovery(a)
    for _ in range(200):
        bus.send(b, FRAME)
    deliveries = bus.advance(LONG_NS)
    restarted = next(d for d in deliveries if d.frame.error and d.frame.can_id == 0x100)
    assert len([d for d in deliveries if not d.frame.error and d.t_ns <= restarted.t_ns]) == 128


def test_idle_bits_before_a_frame_count_towards_recovery():
    bus, a, b, _ = bus_with("abc")
    bus.force_bus_off(a)
    bus.request_recovery(a)
    bus.advance(100 * 11 * BIT_NS)
    bus.send(b, FRAME)
    bus.advance(bus.now_ns + frame_bits(FRAME) * BIT_NS)
    assert bus.next_event_ns() == bus.now_ns + 27 * 11 * BIT_NS


@pytest.mark.parametrize("bitrate", [83_333, 125_000])
def test_recovery_completes_at_any_bit_rate(bitrate):
    bus, a, _ = bus_with("ab", bitrate)
    bus.advance(12_345)
    bus.force_bus_off(a)
    bus.request_recovery(a)
    bus.advance(LONG_NS)
    assert a.state is ErrorState.ACTIVE


def test_recovery_needs_bus_off(bus):
    bus.request_recovery(bus.attach("a"))
    assert bus.next_event_ns() is None


def test_a_node_detached_in_recovery_is_forgotten(bus):
    a = bus.attach("a")
    bus.force_bus_off(a)
    bus.request_recovery(a)
    bus.detach(a)
    bus.advance(1)
    assert bus.next_event_ns() is None


@pytest.mark.parametrize(
    ("outcome", "received"),
    [
        ({"lost": True}, []),
        ({"copies": 2}, [FRAME, FRAME]),
        *(({"data": data}, [CanFrame(0x110, data)]) for data in (b"", b"\x01", bytes(7), FRAME.data[:7] + b"\x02")),
    ],
    ids=["lost", "twice", "empty", "one byte", "seven bytes", "another last byte"],
)
def test_a_frame_that_a_fault_changes_behind_its_crc_is_acknowledged_all_the_same(outcome, received):
    bus, a, b = bus_with("ab", fault=ScriptedOutcomes(FrameOutcome(**outcome)))
    bus.send(a, FRAME)
    assert [d.frame for d in bus.advance(LONG_NS)] == received
    assert (a.sent, a.tec, b.received) == (1, 0, len(received))


def test_one_way_loss():
    bus, a, b, c = bus_with("abc", fault=ScriptedOutcomes(*[FrameOutcome(lost_at=("b",))] * 2))
    bus.send(a, FRAME)
    bus.send(b, CanFrame(0x700))
    assert [d.receivers for d in bus.advance(LONG_NS)] == [(c,), (a, c)]


def test_delay_reorders():
    bus = CanBus(fault=ScriptedOutcomes(FrameOutcome(delay_ns=1_000_000)))
    a, _ = bus.attach("a", order=TransmitOrder.FIFO), bus.attach("b")
    bus.send(a, CanFrame(1))
    bus.send(a, CanFrame(2))
    arrival_ns = (frame_bits(CanFrame(1)) - 3) * BIT_NS + 1_000_000
    assert [d.frame.can_id for d in bus.advance(arrival_ns - 1)] == [2]
    assert bus.next_event_ns() == arrival_ns
    assert [(d.t_ns, d.frame.can_id) for d in bus.advance(arrival_ns)] == [(arrival_ns, 1)]


def test_deliveries_are_in_order_of_time_even_over_a_long_stride():
    bus, a, _ = bus_with("ab", fault=ScriptedOutcomes(FrameOutcome(delay_ns=1_000_000)))
    bus.send(a, CanFrame(1))
    bus.advance(0)
    for can_id in range(2, 30):
        bus.send(a, CanFrame(can_id))
    times = [d.t_ns for d in bus.advance(LONG_NS)]
    assert len(times) == 29
    assert times == sorted(times)


def test_faults_are_asked_with_time_sender_and_frame():
    fault = ScriptedOutcomes()
    bus, a, _ = bus_with("ab", fault=fault)
    bus.advance(700)
    bus.send(a, FRAME)
    bus.advance(LONG_NS)
    assert fault.calls == [(700, "a", FRAME)]


def test_equal_frames_at_the_same_time_merge():
    bus, a, b, c = bus_with("abc")
    bus.send(a, FRAME)
    bus.send(b, FRAME)
    assert [d.receivers for d in bus.advance(LONG_NS)] == [(c,)]
    assert (a.sent, b.sent) == (1, 1)


def test_two_nodes_with_one_identifier_destroy_each_other():
    """The classic mistake: both win arbitration, differ in the data, and drive each other to bus-off."""
    bus, a, b, _ = bus_with("abc")
    one, other = CanFrame(0x100, b"\x00\xff"), CanFrame(0x100, b"\x00\xfe")
    bus.send(a, one)
    bus.send(b, other)
    bus.advance(0)
    differs = next(i for i, (x, y) in enumerate(zip(stuffed_bits(one), stuffed_bits(other), strict=False)) if x != y)
    assert bus.next_event_ns() == (differs + 1 + 6 + 6 + 8) * BIT_NS
    assert data_of(bus.advance(LONG_NS)) == []
    assert (a.state, b.state) == (ErrorState.BUS_OFF, ErrorState.BUS_OFF)


def test_a_babbling_node_starves_higher_identifiers_only(bus):
    babbler, low, high, _ = (bus.attach(name, capacity=4) for name in "abcd")
    received_ids = []
    bus.send(high, CanFrame(0x700))
    for step in range(100):
        while bus.send(babbler, CanFrame(0x100, bytes(8))):
            pass
        if step % 10 == 0:
            bus.send(low, CanFrame(0x080))
        received_ids += [d.frame.can_id for d in bus.advance(step * 500_000)]
    assert received_ids.count(0x080) >= 9
    assert 0x700 not in received_ids


def test_log_is_candump():
    lines = []
    bus, a, _ = bus_with("ab", fault=ScriptedOutcomes(FrameOutcome(wire_error_bit=0)), log=lines.append)
    bus.send(a, FRAME)
    bus.advance(LONG_NS)
    assert lines == [
        f"(0.{(1 + 6 + 6 + 8) * 2:06d}) can0 20000088#0000000000000000",
        f"(0.{(1 + 6 + 6 + 8 + frame_bits(FRAME)) * 2:06d}) can0 110#8D306902B4FB2C01",
    ]


def test_a_detached_node_is_gone():
    bus, a, b = bus_with("ab")
    bus.send(b, FRAME)
    bus.detach(b)
    assert bus.advance(LONG_NS) == []
    assert bus.nodes == (a,)


def test_time_that_goes_back_and_error_frames_to_send_are_refused(bus):
    bus.advance(10)
    with pytest.raises(ValueError, match="cannot go back"):
        bus.advance(9)
    with pytest.raises(ValueError, match="error frame"):
        bus.send(bus.attach("a"), CanFrame(0x40, bytes(8), error=True))
