import pytest

from drivers.transport.inprocess import QUEUE_CAPACITY, connect_pair
from drivers.types import Frame, LinkState, OutgoingFrame, ReceivedFrame

FRAME = Frame(0x123, b"\x01\x02")


@pytest.fixture
def pair():
    host, robot = connect_pair()
    host.open()
    robot.open()
    return host, robot


def test_what_one_end_sends_the_other_receives_with_its_time_unless_it_is_late(pair):
    host, robot = pair
    assert (host.name, robot.name) == ("host", "robot")
    assert host.send(OutgoingFrame(FRAME, 2_000), 1_000)
    assert robot.receive() == (ReceivedFrame(1_000, FRAME),)
    assert robot.receive() == ()
    assert host.receive() == ()
    assert not host.send(OutgoingFrame(FRAME, 999), 1_000)
    assert robot.receive() == ()
    assert host.stats.frames_sent == robot.stats.frames_received == host.stats.expired == 1


def test_up_only_while_both_ends_are_open():
    host, robot = connect_pair()
    assert host.state is LinkState.CLOSED
    host.open()
    assert host.state is LinkState.CONNECTING
    assert not host.send(OutgoingFrame(FRAME, 2), 1)
    robot.open()
    assert host.state is robot.state is LinkState.UP
    robot.close()
    assert host.state is LinkState.CONNECTING
    assert robot.state is LinkState.CLOSED


def test_a_pulled_cable_loses_what_was_under_way_and_counts_as_a_new_link(pair):
    host, robot = pair
    host.send(OutgoingFrame(FRAME, 2), 1)
    host.plug(False)
    assert robot.receive() == ()
    assert not host.send(OutgoingFrame(FRAME, 2), 1)
    assert "unplugged" in host.last_error
    host.plug(True)
    assert host.generation == robot.generation == 2
    assert host.stats.reconnects == 1
    assert host.last_error is None


def test_a_reader_that_falls_behind_gets_the_newest_and_the_loss_is_counted(pair):
    host, robot = pair
    for number in range(QUEUE_CAPACITY + 3):
        host.send(OutgoingFrame(Frame(1, number.to_bytes(4, "little")), 9), 1)
    received = robot.receive()
    assert len(received) == QUEUE_CAPACITY
    assert received[-1].frame.data == (QUEUE_CAPACITY + 2).to_bytes(4, "little")
    assert robot.stats.receive_overflow == 3
