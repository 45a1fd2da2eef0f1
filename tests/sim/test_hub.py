"""Real sockets, time given by the test."""

import select
import signal
import socket
import subprocess
import sys

import pytest

from sim.bus import FrameFate
from sim.bus_node import ErrorState
from sim.can_bits import frame_bits
from sim.can_frame import ECHO_OWN_FRAMES, FRAME_BYTES, CanFrame, pack_frame, unpack_frame
from sim.hub import READER_QUEUE, READER_STALL_NS, Hub
from sim.unix_listener import SocketPathError

T0 = 10**12
LONG_NS = 10**10
FRAME = CanFrame(0x110, bytes(range(8)))
LENGTH_NS = (frame_bits(FRAME) - 3) * 2000


class Client:
    def __init__(self, hub, now_ns=T0, echo=False):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.connect(str(hub.path))
        self.socket.setblocking(False)
        if echo:
            self.socket.send(ECHO_OWN_FRAMES)
        hub.pump(now_ns)

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
def make_hub(tmp_path):
    hubs = []

    def make(**options):
        hub = Hub(tmp_path / f"hub{len(hubs)}", T0, **options)
        hubs.append(hub)
        return hub

    yield make
    for hub in hubs:
        hub.close()


@pytest.fixture
def hub(make_hub):
    return make_hub()


def test_a_frame_reaches_the_others_when_it_has_been_on_the_wire(hub):
    a, b, c = Client(hub), Client(hub), Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    assert hub.next_event_ns() == T0 + LENGTH_NS
    hub.pump(T0 + LENGTH_NS - 1)
    assert (b.received(), c.received()) == ([], [])
    hub.pump(T0 + LENGTH_NS)
    assert (a.received(), b.received(), c.received()) == ([], [FRAME], [FRAME])
    assert hub.next_event_ns() is None


def test_without_pacing_it_reaches_them_at_once(make_hub):
    hub = make_hub(pacing=False)
    a, b = Client(hub), Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    assert b.received() == [FRAME]


def test_own_frames_come_back_to_who_asked(hub):
    a, _ = Client(hub, echo=True), Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    hub.pump(T0 + LONG_NS)
    assert a.received() == [FRAME]


def test_the_lowest_identifier_of_different_clients_wins(hub):
    a, b, c = Client(hub), Client(hub), Client(hub)
    a.send(CanFrame(0x300), CanFrame(0x001))
    b.send(CanFrame(0x200))
    hub.pump(T0)
    hub.pump(T0 + LONG_NS)
    assert [frame.can_id for frame in c.received()] == [0x200, 0x300, 0x001]


def test_a_node_of_the_owner_takes_part(hub):
    robot = hub.bus.attach("robot")
    a = Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    hub.bus.send(robot, CanFrame(0x200))
    deliveries = hub.pump(T0 + LONG_NS)
    assert [d.frame for d in deliveries if robot in d.receivers] == [FRAME]
    assert a.received() == [CanFrame(0x200)]


def test_a_lone_node_is_acknowledged(hub):
    robot = hub.bus.attach("robot")
    hub.bus.send(robot, FRAME)
    hub.pump(T0 + LONG_NS)
    assert (robot.pending, robot.tec) == (0, 0)


def test_faults_and_log_reach_the_bus(make_hub):
    class LoseAll:
        def fate(self, now_ns, sender, frame):
            return FrameFate(lost=True)

    lines = []
    hub = make_hub(fault=LoseAll(), log=lines.append)
    a, b = Client(hub), Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    hub.pump(T0 + LONG_NS)
    assert b.received() == []
    assert [line.split()[-1] for line in lines] == ["110#0001020304050607"]


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
        hub.pump(now_ns)
        got += b.received()
    assert [int.from_bytes(frame.data) for frame in got] == list(range(1000))
    assert hub.stats.reader_overflow == 0
    assert now_ns - T0 > 1000 * 60 * 2000


def test_a_reader_that_never_reads_is_bounded_counted_and_told(hub):
    robot = hub.bus.attach("robot", capacity=64)
    sleeper, reader = Client(hub), Client(hub)
    got, now_ns = 0, T0
    for number in range(2 * READER_QUEUE):
        hub.bus.send(robot, CanFrame(0x100, number.to_bytes(2)))
        now_ns += 1_000_000
        hub.pump(now_ns)
        got += len(reader.received())
    assert got == 2 * READER_QUEUE
    lost = hub.stats.reader_overflow
    assert 0 < lost < READER_QUEUE
    frames = []
    for _ in range(100):
        frames += sleeper.received()
        hub.pump(now_ns)
    numbers = [int.from_bytes(frame.data) for frame in frames]
    assert numbers == list(range(2 * READER_QUEUE - lost))
    hub.bus.send(robot, FRAME)
    hub.pump(now_ns + LONG_NS)
    assert sleeper.received() == [CanFrame(0x004, b"\x00\x01\x00\x00\x00\x00\x00\x00", error=True), FRAME]


def test_without_pacing_senders_wait_for_a_slow_reader_and_nothing_is_lost(make_hub):
    hub = make_hub(pacing=False)
    a, slow = Client(hub), Client(hub)
    sent, got, now_ns, waited = 0, [], T0, 0
    while len(got) < 3000:
        while sent < 3000:
            try:
                a.send(CanFrame(0x100, sent.to_bytes(2)))
                sent += 1
            except BlockingIOError:
                waited += 1
                break
        now_ns += 100_000
        hub.pump(now_ns)
        packet = None
        try:
            packet = slow.socket.recv(FRAME_BYTES)
        except BlockingIOError:
            continue
        got.append(int.from_bytes(unpack_frame(packet).data))
    assert got == list(range(3000))
    assert waited > 100
    assert hub.stats.reader_overflow == 0


def test_without_pacing_a_stalled_reader_holds_up_nobody(make_hub):
    hub = make_hub(pacing=False)
    a, _sleeper, reader = Client(hub), Client(hub), Client(hub)
    got, now_ns = [], T0
    for number in range(3000):
        frame = CanFrame(0x100, number.to_bytes(2))
        for _ in range(3):
            try:
                a.send(frame)
                break
            except BlockingIOError:
                now_ns += READER_STALL_NS
                hub.pump(now_ns)
        else:
            pytest.fail("the sender is held up for ever")
        hub.pump(now_ns)
        got += reader.received()
    hub.pump(now_ns)
    got += reader.received()
    assert len(got) == 3000
    assert hub.stats.reader_overflow > 0


def test_while_senders_wait_the_owner_can_sleep(make_hub):
    """The descriptor must not stay readable for what will not be read, and the end of the wait must be a due event."""
    hub = make_hub(pacing=False)
    a, _sleeper = Client(hub), Client(hub)

    def flood():
        for _ in range(10_000):
            a.send(FRAME)
            hub.pump(T0)

    with pytest.raises(BlockingIOError):
        flood()
    assert select.select([hub.fileno()], [], [], 0)[0] == []
    assert hub.next_event_ns() == T0 + READER_STALL_NS
    hub.pump(T0 + READER_STALL_NS)
    assert select.select([hub.fileno()], [], [], 0)[0] == [hub.fileno()]


def test_rubbish_is_counted_and_ignored(hub):
    a, b = Client(hub), Client(hub)
    for packet in (b"\x02", b"x" * 15, b"x" * 17, bytes((0, 0, 0, 0, 9)) + bytes(11)):
        a.socket.send(packet)
    a.send(FRAME)
    hub.pump(T0)
    hub.pump(T0 + LONG_NS)
    assert b.received() == [FRAME]
    assert hub.stats.malformed == 4


def test_an_error_frame_of_a_client_goes_to_the_other_clients_at_once(hub):
    robot = hub.bus.attach("robot")
    a, b = Client(hub), Client(hub)
    error = CanFrame(0x008, bytes(8), error=True)
    a.send(error)
    assert [d for d in hub.pump(T0) if robot in d.receivers] == []
    assert (a.received(), b.received()) == ([], [error])


def test_what_a_client_wrote_before_it_closed_is_still_sent(hub):
    a, b = Client(hub), Client(hub)
    frames = [CanFrame(0x100, bytes([number])) for number in range(100)]
    a.send(*frames)
    a.socket.close()
    got, now_ns = [], T0
    for _ in range(100):
        now_ns += 1_000_000
        hub.pump(now_ns)
        got += b.received()
    assert got == frames
    assert len(hub.bus.nodes) == 2  # the monitor and b


def test_bus_off_of_the_clients(hub):
    robot = hub.bus.attach("robot")
    a, b = Client(hub), Client(hub)
    hub.force_clients_bus_off()
    hub.pump(T0)
    assert [frame.can_id for frame in a.received()] == [0x040]
    a.send(FRAME)
    hub.bus.send(robot, CanFrame(0x200))
    assert [d for d in hub.pump(T0 + LONG_NS) if robot in d.receivers] == []
    assert b.received() == [CanFrame(0x040, bytes(8), error=True)]
    again = Client(hub, T0 + LONG_NS)
    again.send(FRAME)
    hub.pump(T0 + LONG_NS)
    deliveries = hub.pump(T0 + 2 * LONG_NS)
    assert [d.frame for d in deliveries if robot in d.receivers] == [FRAME]
    assert a.received() == []


def test_recovery_of_the_clients(hub):
    a, b = Client(hub), Client(hub)
    hub.force_clients_bus_off()
    hub.request_clients_recovery()
    hub.pump(T0 + LONG_NS)
    assert [frame.can_id for frame in a.received()] == [0x040, 0x100]
    a.send(FRAME)
    hub.pump(T0 + LONG_NS)
    hub.pump(T0 + 2 * LONG_NS)
    assert b.received()[-1] == FRAME
    assert {node.state for node in hub.bus.nodes} == {ErrorState.ACTIVE}


def test_unplugged_clients_are_cut_off_and_refused_for_a_while(hub):
    a = Client(hub)
    a.send(FRAME)
    hub.pump(T0)
    hub.unplug(T0 + 500)
    assert a.received() == ["closed"]
    with pytest.raises(FileNotFoundError):
        Client(hub)
    assert len(hub.bus.nodes) == 1
    assert hub.next_event_ns() <= T0 + 500
    hub.pump(T0 + LONG_NS)
    b, c = Client(hub, T0 + LONG_NS), Client(hub, T0 + LONG_NS)
    b.send(CanFrame(1))
    hub.pump(T0 + LONG_NS)
    hub.pump(T0 + 2 * LONG_NS)
    assert c.received() == [CanFrame(1)]


def test_unplugging_loses_what_was_not_yet_on_the_bus(hub):
    robot = hub.bus.attach("robot")
    a = Client(hub)
    a.send(FRAME)
    assert hub.collect(T0) == 1
    hub.unplug(T0 + 500)
    assert [d for d in hub.pump(T0 + LONG_NS) if robot in d.receivers] == []


def test_when_the_bus_has_room_again_waiting_senders_wake_the_owner(make_hub):
    hub = make_hub(pacing=False)
    a, b = Client(hub), Client(hub)
    a.send(*[FRAME] * 40)
    hub.pump(T0)
    assert select.select([hub.fileno()], [], [], 0)[0] == [hub.fileno()]
    hub.pump(T0)
    assert select.select([hub.fileno()], [], [], 0)[0] == []
    assert len(b.received()) == 40


def test_frames_that_waited_can_be_let_in_a_few_at_a_time(hub):
    """An owner that was held up lets a backlog in over the time it must catch up with."""
    robot = hub.bus.attach("robot")
    a = Client(hub)
    a.send(*(CanFrame(0x100, bytes([number])) for number in range(4)))
    assert hub.collect(T0 + LONG_NS) == 4
    times = []
    for step in range(1, 5):
        times += [d.t_ns for d in hub.advance(T0 + step * LONG_NS, admit=1) if robot in d.receivers]
    times += [d.t_ns for d in hub.advance(T0 + 5 * LONG_NS) if robot in d.receivers]
    assert [t_ns // LONG_NS - T0 // LONG_NS for t_ns in times] == [1, 2, 3, 4]


def test_a_hub_in_the_way_is_reported(hub):
    with pytest.raises(SocketPathError, match="another process listens"):
        Hub(hub.path, T0)


def test_close_removes_the_socket_and_may_be_repeated(hub):
    a = Client(hub)
    hub.close()
    hub.close()
    assert not hub.path.exists()
    assert a.received() == ["closed"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_process_ends_cleanly_on_a_signal(tmp_path, number):
    path = tmp_path / "hub"
    with subprocess.Popen(
        [sys.executable, "-m", "sim.hub", str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == f"ready {path}\n"
        process.send_signal(number)
        assert process.wait(10) == 0
        assert "Traceback" not in process.stderr.read()
    assert not path.exists()


def test_process_says_why_it_cannot_start(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "sim.hub", str(tmp_path)], capture_output=True, text=True, timeout=20, check=False
    )
    assert result.returncode == 2
    assert result.stderr == f"{tmp_path}: exists and is not a socket; remove it or choose another path\n"
