from hypothesis import given
from hypothesis import strategies as st

from disco_hw.log.records import DaemonState, Task
from disco_hw.log.writer_link import Delivery

STEP = st.sampled_from(["put", "send", "new file", "deleted"]) | st.tuples(st.just("acknowledge"), st.integers(0, 60))


@given(st.lists(STEP, max_size=120))
def test_every_tick_is_in_exactly_one_place(steps):
    """Against a writer that keeps what it was sent in a list."""
    delivery, given_ticks, file = Delivery(5), 0, []
    for step in steps:
        match step:
            case "put":
                given_ticks += 1
                delivery.put(given_ticks, 2, b"%d" % given_ticks)
            case "send":
                sent = delivery.next_frame()
                if sent is not None:
                    delivery.sent()
                    file.append(int(sent))
            case ("acknowledge", share):
                # A writer confirms no more than it got.
                reached = file[: share * len(file) // 60]
                if reached:
                    delivery.acknowledge(reached[-1])
            case "new file" | "deleted":
                if step == "deleted":
                    delivery.file_deleted()
                delivery.new_file()
                file = []
        assert delivery.ticks + delivery.dropped_ticks == given_ticks
        assert delivery.delivered_ticks + delivery.lost_ticks + delivery.waiting_ticks == delivery.ticks
        assert delivery.waiting_ticks <= 5
        assert delivery.records == 2 * delivery.ticks
        assert delivery.dropped_records == 2 * delivery.dropped_ticks


def delivery_of(count, sent):
    """A delivery of so many ticks, the first of which were sent."""
    delivery = Delivery(10)
    for k in range(1, count + 1):
        delivery.put(k, 1, b"%d" % k)
    for _ in range(sent):
        delivery.sent()
    return delivery


def test_a_new_writer_is_sent_what_the_former_did_not_confirm():
    delivery = delivery_of(6, sent=5)
    delivery.acknowledge(3)
    assert (delivery.delivered_ticks, delivery.waiting_ticks, delivery.last_delivered) == (3, 3, 3)
    assert delivery.next_frame() == b"6"
    delivery.new_file()
    assert delivery.next_frame() == b"4"


def test_only_what_was_in_the_deleted_file_is_lost():
    delivery = delivery_of(6, sent=6)
    delivery.acknowledge(2)
    delivery.new_file()
    for _ in range(4):
        delivery.sent()
    delivery.acknowledge(5)
    delivery.file_deleted()
    assert (delivery.delivered_ticks, delivery.lost_ticks, delivery.waiting_ticks) == (2, 3, 1)


def test_states_are_those_of_the_delivered_ticks():
    delivery = Delivery(10)
    for k, texts in enumerate(("one", "two"), start=1):
        delivery.put(k, 2, b"%d" % k, (DaemonState(k, texts, ""), Task(k, texts)))
    delivery.put(3, 1, b"3", (Task(3, "three"),))
    for _ in range(3):
        delivery.sent()
    delivery.acknowledge(2)
    delivery.new_file()
    assert {kind: state.t_ns for kind, state in delivery.states.items()} == {DaemonState: 2, Task: 2}
    assert (delivery.last_sent, delivery.is_confirmed) == (2, True)
    delivery.sent()
    assert (delivery.last_sent, delivery.is_confirmed) == (3, False)
    delivery.acknowledge(3)
    assert {kind: state.t_ns for kind, state in delivery.states.items()} == {DaemonState: 2, Task: 3}


def test_what_was_not_sent_is_not_confirmed():
    delivery = delivery_of(1, sent=0)
    delivery.acknowledge(9)
    assert delivery.waiting_ticks == 1
