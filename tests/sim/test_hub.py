"""Real sockets, time given by the test."""

import select
import socket

import can
import pytest

from drivers.private_files import SocketPathError
from drivers.types import Frame
from sim import RESTART_DELAY_NS, LinkFaultError
from sim.bus import FrameOutcome
from sim.can_protocol import ECHO_OWN_FRAMES, FRAME_BYTES, CanFrame, ErrorState, frame_bits, pack_frame, unpack_frame
from sim.hub import READER_QUEUE, Hub
from sim.unixcan import UnixCanBus

T0 = 10**12
LONG_NS = 10**10
FRAME = CanFrame(0x110, bytes(range(8)))
LENGTH_NS = (frame_bits(FRAME) - 3) * 2000


def pump(hub, *times_ns):
    """Let the hub do what is due at these times; return what the robot has received."""
    received = []
    for now_ns in times_ns:
        hub.collect(now_ns)
        received += hub.advance(now_ns)
    return received


class Client:
    def __init__(self, hub, now_ns=T0, echo=False):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.connect(str(hub.path))
        self.socket.setblocking(False)
        if echo:
            self.socket.send(ECHO_OWN_FRAMES)
        pump(hub, now_ns)

    def send(self, *frames):
        for frame in frames:
            self.socket.send(pack_frame(frame))

    def received(self):
        frames = []
        while True:
            try:
                packet = self.socket.recv(FRAME_BYTES)
            except BlockingIOError:
                return frames
            if not packet:
                return [*frames, "closed"]
            frames.append(unpack_frame(packet))


@pytest.fixture
def hub(tmp_path):
    hub = Hub(tmp_path / "hub", T0)
    yield hub
    hub.close()


def test_a_frame_reaches_the_others_when_it_has_been_on_the_wire(hub):
    a, b, c = Client(hub), Client(hub), Client(hub)
    a.send(FRAME)
    pump(hub, T0)
    assert hub.next_event_ns() == T0 + LENGTH_NS
    pump(hub, T0 + LENGTH_NS - 1)
    assert (b.received(), c.received()) == ([], [])
    pump(hub, T0 + LENGTH_NS)
    assert (a.received(), b.received(), c.received()) == ([], [FRAME], [FRAME])
    assert hub.next_event_ns() is None


def test_own_frames_come_back_to_who_asked(hub):
    a, _ = Client(hub, echo=True), Client(hub)
    a.send(FRAME)
    pump(hub, T0, T0 + LONG_NS)
    assert a.received() == [FRAME]


def test_the_lowest_identifier_of_different_clients_wins(hub):
    a, b, c = Client(hub), Client(hub), Client(hub)
    a.send(CanFrame(0x300), CanFrame(0x001))
    b.send(CanFrame(0x200))
    pump(hub, T0, T0 + LONG_NS)
    assert [frame.can_id for frame in c.received()] == [0x200, 0x300, 0x001]


def test_a_lone_node_is_acknowledged(hub):
    robot = hub.robot.node
    hub.bus.send(robot, FRAME)
    pump(hub, T0 + LONG_NS)
    assert (robot.pending, robot.tec) == (0, 0)


def test_faults_and_log_reach_the_bus(tmp_path):
    class LoseAll:
        def outcome(self, now_ns, sender, frame):
            return FrameOutcome(lost=True)

    lines = []
    hub = Hub(tmp_path / "hub", T0, log=lines.append)
    hub.bus.fault = LoseAll()
    a, b = Client(hub), Client(hub)
    a.send(FRAME)
    pump(hub, T0, T0 + LONG_NS)
    assert b.received() == []
    assert [line.split()[-1] for line in lines] == ["110#0001020304050607"]
    hub.close()


def test_a_full_bus_slows_its_sender_down_and_loses_nothing(hub):
    a, b = Client(hub), Client(hub)
    sent, got, now_ns = 0, [], T0
    while sent < 1000 or len(got) < 1000:
        if sent < 1000:
            try:
                a.send(CanFrame(0x100, sent.to_bytes(2)))
                sent += 1
                continue
            except BlockingIOError:
                pass
        now_ns += 1_000_000
        pump(hub, now_ns)
        got += b.received()
    assert [int.from_bytes(frame.data) for frame in got] == list(range(1000))
    assert hub.stats.reader_overflow == 0
    assert now_ns - T0 > 1000 * 60 * 2000


def test_a_reader_that_never_reads_is_bounded_counted_and_reported(hub):
    robot = hub.robot.node
    sleeper, reader = Client(hub), Client(hub)
    got, now_ns = 0, T0
    for number in range(2 * READER_QUEUE):
        hub.bus.send(robot, CanFrame(0x100, number.to_bytes(2)))
        now_ns += 1_000_000
        pump(hub, now_ns)
        got += len(reader.received())
    assert got == 2 * READER_QUEUE
    dropped = hub.stats.reader_overflow
    assert 0 < dropped < READER_QUEUE
    frames = []
    for _ in range(100):
        frames += sleeper.received()
        pump(hub, now_ns)
    assert [int.from_bytes(frame.data) for frame in frames] == list(range(2 * READER_QUEUE - dropped))
    hub.bus.send(robot, FRAME)
    pump(hub, now_ns + LONG_NS)
    assert sleeper.received() == [CanFrame(0x004, b"\x00\x01\x00\x00\x00\x00\x00\x00", error=True), FRAME]


def test_rubbish_is_counted_and_ignored(hub):
    a, b = Client(hub), Client(hub)
    for packet in (b"\x02", b"x" * 15, b"x" * 17, bytes((0, 0, 0, 0, 9)) + bytes(11)):
        a.socket.send(packet)
    a.send(FRAME)
    pump(hub, T0, T0 + LONG_NS)
    assert b.received() == [FRAME]
    assert hub.stats.malformed == 4


def test_an_error_frame_of_a_client_goes_to_the_other_clients_at_once(hub):
    a, b = Client(hub), Client(hub)
    error = CanFrame(0x008, bytes(8), error=True)
    a.send(error)
    assert pump(hub, T0) == []
    assert (a.received(), b.received()) == ([], [error])


def test_what_a_client_wrote_before_it_closed_is_still_sent(hub):
    a, b = Client(hub), Client(hub)
    frames = [CanFrame(0x100, bytes([number])) for number in range(100)]
    a.send(*frames)
    a.socket.close()
    got, now_ns = [], T0
    for _ in range(100):
        now_ns += 1_000_000
        pump(hub, now_ns)
        got += b.received()
    assert got == frames
    assert len(hub.bus.nodes) == 4  # monitor, robot, babbler and b


def test_bus_off_of_the_clients(hub):
    a, b = Client(hub), Client(hub)
    hub.force_bus_off("host")
    pump(hub, T0)
    assert [frame.can_id for frame in a.received()] == [0x040]
    a.send(FRAME)
    hub.send([Frame(0x200, b"")])
    assert pump(hub, T0 + LONG_NS) == []
    assert b.received() == [CanFrame(0x040, bytes(8), error=True)]
    again = Client(hub, T0 + LONG_NS)
    again.send(FRAME)
    received = pump(hub, T0 + LONG_NS, T0 + 2 * LONG_NS)
    assert [one.frame for one in received] == [Frame(FRAME.can_id, FRAME.data)]
    assert a.received() == []


def test_unplugged_clients_are_cut_off_and_refused_for_a_while(hub):
    a = Client(hub)
    a.send(FRAME)
    pump(hub, T0)
    hub.unplug(T0 + 500)
    assert a.received() == ["closed"]
    with pytest.raises(FileNotFoundError):
        Client(hub)
    assert len(hub.bus.nodes) == 3  # monitor, robot and babbler
    assert hub.next_event_ns() <= T0 + 500
    pump(hub, T0 + LONG_NS)
    b, c = Client(hub, T0 + LONG_NS), Client(hub, T0 + LONG_NS)
    b.send(CanFrame(1))
    pump(hub, T0 + LONG_NS, T0 + 2 * LONG_NS)
    assert c.received() == [CanFrame(1)]


def test_unplugging_loses_what_was_not_yet_on_the_bus(hub):
    a = Client(hub)
    a.send(FRAME)
    assert hub.collect(T0) == 1
    hub.unplug(T0 + 500)
    assert pump(hub, T0 + LONG_NS) == []


def test_when_the_bus_has_room_again_waiting_senders_wake_the_owner(hub):
    a, b = Client(hub), Client(hub)
    a.send(*[FRAME] * 40)
    pump(hub, T0)
    assert select.select(hub.filenos(), [], [], 0)[0] == []
    hub.advance(T0 + LONG_NS)
    assert select.select(hub.filenos(), [], [], 0)[0] == hub.filenos()
    pump(hub, T0 + LONG_NS)
    assert select.select(hub.filenos(), [], [], 0)[0] == []
    pump(hub, T0 + 2 * LONG_NS)
    assert len(b.received()) == 40


def test_frames_that_waited_can_be_let_in_a_few_at_a_time(hub):
    """An owner that was held up lets a backlog in over the time it must catch up with."""
    a = Client(hub)
    a.send(*(CanFrame(0x100, bytes([number])) for number in range(4)))
    assert hub.collect(T0 + LONG_NS) == 4
    received = [one for step in range(1, 5) for one in hub.advance(T0 + step * LONG_NS, admit=1)]
    received += hub.advance(T0 + 5 * LONG_NS)
    assert [one.t_ns // LONG_NS - T0 // LONG_NS for one in received] == [1, 2, 3, 4]


def test_a_hub_in_the_way_is_reported(hub):
    with pytest.raises(SocketPathError, match="another process listens"):
        Hub(hub.path, T0)


def test_close_removes_the_socket_and_may_be_repeated(hub):
    a = Client(hub)
    hub.close()
    hub.close()
    assert not hub.path.exists()
    assert a.received() == ["closed"]


MS = 1_000_000
ROBOT_FRAME = Frame(0x100, bytes(range(8)))


@pytest.fixture
def link(tmp_path):
    link = Hub(tmp_path / "hub", 0)
    yield link
    link.close()


@pytest.fixture
def bus(link):
    with UnixCanBus(str(link.path)) as bus:
        link.collect(0)
        yield bus


def run(link, from_ns, to_ns):
    return pump(link, *range(from_ns, to_ns, MS // 4))


def send(bus):
    bus.send(can.Message(arbitration_id=ROBOT_FRAME.can_id, data=ROBOT_FRAME.data, is_extended_id=False))


def test_the_robot_receives_with_the_time_of_the_frames_end(link, bus):
    send(bus)
    (received,) = run(link, 0, 2 * MS)
    assert received.frame == ROBOT_FRAME
    assert 111 * 2000 - 6000 <= received.t_ns <= 135 * 2000


def test_the_host_receives_what_the_robot_sends(link, bus):
    link.send([ROBOT_FRAME, Frame(0x080, b"\x01")])
    assert run(link, 0, 2 * MS) == []
    assert [bus.recv(30).arbitration_id for _ in range(2)] == [0x080, 0x100]


def test_the_robot_receives_data_frames_only_and_is_told_which_identifiers_are_long(link, bus):
    for kind in ({"is_extended_id": False, "is_remote_frame": True}, {"is_extended_id": True, "data": b"1"}):
        bus.send(can.Message(arbitration_id=0x100, **kind))
    send(bus)
    received = run(link, 0, 2 * MS)
    assert [one.frame for one in received] == [Frame(0x100, b"1", extended=True), ROBOT_FRAME]


def test_the_robot_comes_back_from_bus_off_by_itself(link, bus):
    link.send([ROBOT_FRAME])
    begin_ns = 0
    for _ in range(2):
        link.force_bus_off("robot")
        assert link.error_counters == (256, 0)
        send(bus)
        assert run(link, begin_ns, begin_ns + RESTART_DELAY_NS) == []
        assert link.error_counters == (256, 0)
        assert link.robot.node.state is ErrorState.BUS_OFF
        run(link, begin_ns + RESTART_DELAY_NS, begin_ns + RESTART_DELAY_NS + 10 * MS)
        assert link.robot.node.state is ErrorState.ACTIVE
        assert link.error_counters == (0, 0)
        send(bus)
        begin_ns += RESTART_DELAY_NS + 20 * MS
        assert len(run(link, begin_ns - 10 * MS, begin_ns)) == 1


def test_a_restart_is_a_due_event_and_nobody_but_robot_and_hosts_can_be_put_into_bus_off(link):
    link.force_bus_off("robot")
    link.advance(MS)
    link.advance(MS)
    assert link.next_event_ns() == MS + RESTART_DELAY_NS
    with pytest.raises(LinkFaultError, match="say host or robot"):
        link.force_bus_off("moon")


def test_a_babbling_node_is_heard_by_robot_and_hosts(link, bus):
    link.babble(ROBOT_FRAME)
    assert [received.frame for received in run(link, 0, MS)] == [ROBOT_FRAME]
    assert bus.recv(30).arbitration_id == 0x100


def test_summary_counts(link, bus):
    send(bus)
    link.send([Frame(0x110, b"")] * 100)
    run(link, 0, 50 * MS)
    assert "sent=64 received=1 full=36 bus_off=0" in link.summary()
    assert "frames_in=1" in link.summary()
