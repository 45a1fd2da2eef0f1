import pytest

from sim.can_protocol import BusNode, CanFrame, ErrorState, TransmitOrder


@pytest.fixture
def node():
    return BusNode("a", capacity=4, order=TransmitOrder.PRIORITY, echo=False)


def fail_transmission(node, times, acknowledged=True):
    reports = []
    for _ in range(times):
        if node.queue:
            node.start()
        reports.append(node.count_transmit_error(acknowledged))
    return [report for report in reports if report is not None]


def sent(node):
    """Send all frames that are queued; return them."""
    frames = []
    while node.queue:
        frames.append(node.start())
        node.count_sent()
    return frames


@pytest.mark.parametrize(("order", "places"), [(TransmitOrder.PRIORITY, (1, 3, 0, 2)), (TransmitOrder.FIFO, range(4))])
def test_priority_sends_the_lowest_identifier_first_and_equals_in_order_and_fifo_all_in_order(order, places):
    node = BusNode("a", capacity=4, order=order, echo=False)
    frames = [CanFrame(0x200, b"1"), CanFrame(0x100, b"2"), CanFrame(0x300, b"3"), CanFrame(0x100, b"4")]
    for sequence, frame in enumerate(frames):
        assert node.push(sequence, frame)
    assert sent(node) == [frames[place] for place in places]


def test_a_full_queue_refuses_and_counts_including_the_frame_on_the_wire(node):
    for sequence in range(4):
        assert node.push(sequence, CanFrame(1))
    assert not node.push(9, CanFrame(1))
    node.start()
    assert node.pending == 4
    assert not node.push(10, CanFrame(1))
    assert node.refused_full == 2
    node.count_sent()
    assert node.push(11, CanFrame(1))


def test_a_destroyed_frame_keeps_its_place(node):
    node.push(1, CanFrame(5, b"first"))
    node.push(2, CanFrame(5, b"later"))
    node.start()
    node.count_transmit_error(acknowledged=True)
    assert node.start().data == b"first"


def test_transmit_errors_lead_over_warning_and_passive_to_bus_off_and_each_change_is_an_error_frame_of_socketcan(node):
    node.push(1, CanFrame(5))
    states, reports = [], []
    for _ in range(32):
        reports += fail_transmission(node, 1)
        states.append(node.state)
    assert states.index(ErrorState.WARNING) == 96 // 8 - 1
    assert states.index(ErrorState.PASSIVE) == 128 // 8 - 1
    assert states.index(ErrorState.BUS_OFF) == 256 // 8 - 1
    assert (node.bus_off_count, node.pending, node.lost_by_bus_off) == (1, 0, 1)
    assert [(report.can_id, report.data[1], report.data[6]) for report in reports] == [
        (0x204, 0x08, 96),
        (0x204, 0x20, 128),
        (0x040, 0, 0),
    ]


def test_bus_off_refuses_frames_and_counts_them(node):
    node.force_bus_off()
    assert not node.push(1, CanFrame(1))
    assert (node.refused_bus_off, node.refused_full, node.pending) == (1, 0, 0)


def test_bus_off_during_a_frame_stays_bus_off_whatever_becomes_of_the_frame(node):
    for outcome in (node.count_sent, lambda: node.count_transmit_error(True)):
        node.push(1, CanFrame(1))
        node.start()
        node.force_bus_off()
        outcome()
        assert node.state is ErrorState.BUS_OFF
        assert node.pending == 0
        node.recover()


def test_recovery_clears_the_counters(node):
    node.rec = 40
    node.force_bus_off()
    assert node.recover().can_id == 0x100
    assert (node.tec, node.rec, node.state) == (0, 0, ErrorState.ACTIVE)


def test_success_wins_back_one_error_in_eight(node):
    node.push(1, CanFrame(5))
    fail_transmission(node, 16)
    assert (node.tec, node.state) == (128, ErrorState.PASSIVE)
    node.start()
    report = node.count_sent()
    assert (node.tec, node.state) == (127, ErrorState.WARNING)
    assert report.data[1] == 0x08
    for sequence in range(32):
        node.push(sequence, CanFrame(5))
        node.start()
        report = node.count_sent()
    assert (node.tec, node.state) == (95, ErrorState.ACTIVE)
    assert report.data[1] == 0x40


def test_a_missing_acknowledgement_never_leads_to_bus_off(node):
    node.push(1, CanFrame(5))
    fail_transmission(node, 100, acknowledged=False)
    assert (node.tec, node.state) == (128, ErrorState.PASSIVE)


def test_receive_errors_lead_to_passive_only(node):
    reports = [node.count_receive_error() for _ in range(400)]
    assert [(report.data[1], report.data[7]) for report in reports if report] == [(0x04, 96), (0x10, 128)]
    assert (node.rec, node.state) == (255, ErrorState.PASSIVE)
    node.count_received()
    assert node.rec == 120
    for _ in range(130):
        node.count_received()
    assert (node.rec, node.state) == (0, ErrorState.ACTIVE)


def test_success_without_errors_reports_nothing(node):
    node.push(1, CanFrame(5))
    node.start()
    assert node.count_sent() is None
    assert node.count_received() is None
    assert (node.tec, node.rec, node.sent) == (0, 0, 1)
