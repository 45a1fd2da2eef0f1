from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.transmit_queue import TransmitQueue
from drivers.types import Frame, OutgoingFrame


def frame(can_id, number=0, deadline_ns=100):
    return OutgoingFrame(Frame(can_id, bytes((number,))), deadline_ns)


def drain(queue):
    sent = []
    while (outgoing := queue.pop()) is not None:
        sent.append(outgoing)
    return sent


@given(st.lists(st.integers(0, 0x7FF), max_size=40))
def test_lowest_identifier_first_and_equal_ones_as_they_came(can_ids):
    queue = TransmitQueue(64)
    for number, can_id in enumerate(can_ids):
        assert queue.push(frame(can_id, number)) is None
    sent = [(outgoing.frame.can_id, outgoing.frame.data[0]) for outgoing in drain(queue)]
    assert sent == sorted((can_id, number) for number, can_id in enumerate(can_ids))


def test_a_frame_never_outlives_its_deadline():
    queue = TransmitQueue(4)
    queue.push(frame(1, deadline_ns=10))
    queue.push(frame(2, deadline_ns=20))
    assert queue.expire(10) == 0
    assert queue.expire(11) == 1
    assert queue.pop().frame.can_id == 2


@given(st.lists(st.tuples(st.integers(0, 20), st.booleans()), max_size=40))
def test_what_has_not_expired_keeps_its_order(frames):
    queue = TransmitQueue(64)
    for number, (can_id, late) in enumerate(frames):
        queue.push(frame(can_id, number, deadline_ns=10 if late else 100))
    assert queue.expire(50) == sum(late for _, late in frames)
    sent = [(outgoing.frame.can_id, outgoing.frame.data[0]) for outgoing in drain(queue)]
    assert sent == sorted((can_id, number) for number, (can_id, late) in enumerate(frames) if not late)


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
    queue.put_back(first)
    assert drain(queue) == [urgent, first, second]
    queue.push(first)
    queue.push(second)
    taken = [queue.pop(), queue.pop()]
    for outgoing in reversed(taken):
        queue.put_back(outgoing)
    assert drain(queue) == [first, second]
    queue.push(first)
    assert queue.clear() == 1
    assert len(queue) == 0
