from hypothesis import given
from hypothesis import strategies as st

from disco_hw.log.writer_link import Delivery

STEP = st.one_of(
    st.just("put"),
    st.just("send"),
    st.tuples(st.just("acknowledge"), st.integers(0, 60)),
    st.just("new file"),
    st.just("deleted"),
)


@given(st.lists(STEP, max_size=120))
def test_every_tick_is_in_exactly_one_place(steps):
    """Against a writer that keeps what it was sent in a list."""
    delivery, given_ticks, file = Delivery(5), 0, []
    files = []
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
                    files = [kept for kept in files if kept is not file] + [file]
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


def test_a_new_writer_is_sent_what_the_former_did_not_confirm():
    delivery = Delivery(10)
    for k in range(1, 7):
        delivery.put(k, 1, b"%d" % k)
    for _ in range(5):
        delivery.sent()
    delivery.acknowledge(3)
    assert (delivery.delivered_ticks, delivery.waiting_ticks, delivery.last_delivered) == (3, 3, 3)
    assert delivery.next_frame() == b"6"
    delivery.new_file()
    assert delivery.next_frame() == b"4"


def test_only_what_was_in_the_deleted_file_is_lost():
    delivery = Delivery(10)
    for k in range(1, 7):
        delivery.put(k, 1, b"")
        delivery.sent()
    delivery.acknowledge(2)
    delivery.new_file()
    for _ in range(4):
        delivery.sent()
    delivery.acknowledge(5)
    delivery.file_deleted()
    assert (delivery.delivered_ticks, delivery.lost_ticks, delivery.waiting_ticks) == (2, 3, 1)


def test_what_was_not_sent_is_not_confirmed():
    delivery = Delivery(10)
    delivery.put(1, 1, b"")
    delivery.acknowledge(9)
    assert delivery.waiting_ticks == 1
