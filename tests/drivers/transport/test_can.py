"""The CAN transport on real buses: python-can's virtual one, our hub between processes, slcan on a pseudo-terminal."""

import contextlib
import errno
import itertools
import os
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import can
import can.interfaces.virtual as virtual_bus
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport import can as can_transport
from drivers.transport.can import (
    ECHO_NS,
    GARBAGE_LIMIT,
    WRITE_TIMEOUT_S,
    CanConnection,
    CanMedium,
    SentFrames,
    error_counts,
    is_busy,
    monotonic_stamp_ns,
    require_working_interface,
)
from drivers.transport.reconnecting import LinkLostError, TransmitBusyError, TransportCounters
from drivers.types import Frame, LinkState, OutgoingFrame
from tests.drivers.transport.links import opened, up
from tests.drivers.waiting import collect, free_port, median_send_s, outgoing, send, wait_until
from tests.sim.hub_process import HUB_PROCESS
from tests.tables import examples


@pytest.mark.parametrize(
    ("error_class", "data", "expected"),
    [
        # No acknowledgement, a protocol violation, receive errors at warning level and at passive level, a timeout.
        (0x0A8, "0000001900000000", "bus_errors"),
        (0x08C, "0002090800000000", "bus_errors"),
        (0x204, "0004000000006064", "bus_errors"),
        (0x204, "0010000000008087", "bus_errors"),
        (0x001, "", "bus_errors"),
        (0x040, "0000000000000000", "bus_off"),
        # Restarted, active again, and counters alone.
        (0x100, "0000000000000000", None),
        (0x204, "0040000000000000", None),
        (0x200, "0000000000006064", None),
    ],
)
def test_frames_as_the_kernel_makes_them(error_class, data, expected):
    counts = error_counts(error_class, bytes.fromhex(data))
    assert [name for name, count in counts.items() if count] == ([] if expected is None else [expected])


def test_overflow_in_the_controller_means_lost_frames():
    assert error_counts(0x04, b"\x00\x01") == {"bus_off": 0, "bus_errors": 1, "receive_overflow": 1}
    assert error_counts(0x04, b"\x00\x02")["receive_overflow"] == 0


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=64))
def test_any_error_frame_is_counted_somehow(error_class, data):
    assert set(error_counts(error_class, data).values()) <= {0, 1}


A, B, C = Frame(0x100, b"\1"), Frame(0x100, b"\2"), Frame(0x101, b"\1")


@pytest.fixture
def sent_frames():
    return SentFrames()


def test_an_excuse_ends_after_a_second(sent_frames):
    sent_frames.sent(0, A)
    sent_frames.sent(ECHO_NS, B)
    assert not sent_frames.is_echo(ECHO_NS + 1, A)
    assert sent_frames.is_echo(2 * ECHO_NS, B)


def test_a_frame_that_was_not_sent_excuses_nothing(sent_frames):
    for frame in (A, B, A):
        sent_frames.sent(0, frame)
    sent_frames.not_sent(A)
    assert [sent_frames.is_echo(1, frame) for frame in (A, A, B)] == [True, False, True]
    sent_frames.not_sent(B)


@examples(quick=40, every=100, events=st.lists(st.tuples(st.sampled_from([A, B, C]), st.booleans()), max_size=40))
def test_whoever_else_sends_is_heard_as_often_as_he_sends(events):
    """Echoes and another host's frames of the same contents, in any order: what is not excused is as many as his."""
    sent_frames = SentFrames()
    for frame, is_ours in events:
        if is_ours:
            sent_frames.sent(0, frame)
    not_echoes = Counter(frame for frame, _ in events if not sent_frames.is_echo(1, frame))
    assert not_echoes == Counter(frame for frame, is_ours in events if not is_ours)


CHANNELS = (f"can-test-{number}" for number in itertools.count())


def opened_bus(interface, channel, bitrate=500_000, **options):
    return opened(CanMedium(interface, channel, bitrate, options), carries_extended=True)


def other_node(interface, channel, **options):
    return can.Bus(interface=interface, channel=channel, ignore_config=True, **options)


@pytest.fixture
def virtual():
    channel = next(CHANNELS)
    with other_node("virtual", channel) as other, opened_bus("virtual", channel) as transport:
        up(transport)
        yield transport, other


def message(can_id=0x110, data=b"\x01\x02", **options):
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=options.pop("is_extended_id", False), **options)


def test_frames_both_ways_with_monotonic_stamps_and_no_echo(virtual):
    transport, other = virtual
    before_ns = time.monotonic_ns()
    other.send(message(0x110, b"\x01\x02", is_rx=False))
    (received,) = collect(transport, 1)
    assert received.frame == Frame(0x110, b"\x01\x02")
    assert before_ns - 1_000_000 <= received.t_ns <= time.monotonic_ns()
    send(transport, outgoing(0x7FF, b""))
    echoed = other.recv(5.0)
    assert (echoed.arbitration_id, bytes(echoed.data), echoed.is_extended_id) == (0x7FF, b"", False)
    other.send(message(0x111))
    assert [frame.frame.can_id for frame in collect(transport, 1)] == [0x111], "our own frame does not come back"


def test_frames_with_long_identifiers_pass_both_ways(virtual):
    transport, other = virtual
    other.send(message(0x110, b"\x01", is_extended_id=True))
    (received,) = collect(transport, 1)
    assert received.frame == Frame(0x110, b"\x01", extended=True)
    for can_id in (0x317, 0x1FFFFFFF):
        send(transport, OutgoingFrame(Frame(can_id, b"\x02", extended=True), time.monotonic_ns() + 10**10))
        on_bus = other.recv(5.0)
        assert (on_bus.arbitration_id, on_bus.is_extended_id) == (can_id, True)


def test_what_is_no_classic_data_frame_is_counted_and_dropped(virtual):
    transport, other = virtual
    other.send(message(0x110, b"", is_remote_frame=True, dlc=2))
    other.send(message(0x110, bytes(16), is_fd=True, dlc=16))
    other.send(message(0x110, bytes(8), is_fd=True))
    other.send(message(0x7FF, bytes(8)))
    assert [received.frame for received in collect(transport, 1)] == [Frame(0x7FF, bytes(8))]
    assert transport.stats.malformed == 3
    assert transport.generation == 1


def test_error_frames_are_counted_and_bus_off_is_a_lost_link(virtual):
    transport, other = virtual
    for error_class, data in ((0xA8, "0000001900000000"), (0x204, "0001000000006064"), (0x100, "")):
        other.send(can.Message(arbitration_id=error_class, is_error_frame=True, data=bytes.fromhex(data)))
    other.send(message())
    collect(transport, 1)
    assert transport.stats.bus_errors == 2
    assert transport.stats.receive_overflow == 1
    other.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
    up(transport, generation=2)
    assert transport.stats.bus_off == 1
    assert transport.stats.reconnects == 1
    other.send(message(0x113))
    assert [received.frame.can_id for received in collect(transport, 1)] == [0x113]
    assert len(virtual_bus.channels[other.channel_id]) == 2, "the lost bus has been shut down"


def test_a_file_in_the_users_home_changes_nothing(tmp_path, monkeypatch):
    """python-can reads settings from ~/.canrc, can.ini and its environment, unless it is set not to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(tmp_path / "can.ini")])
    (tmp_path / "can.ini").write_text("[default]\nreceive_own_messages = True\n")
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    channel = next(CHANNELS)
    with other_node("virtual", channel) as other, opened_bus("virtual", channel) as transport:
        up(transport)
        send(transport, outgoing(0x100, b"ours"))
        other.recv(5.0)
        other.send(message(0x111))
        assert [received.frame.can_id for received in collect(transport, 1)] == [0x111]


def test_the_bus_is_opened_as_asked_and_options_go_through_as_they_are(monkeypatch, tmp_path):
    requested, port = [], str(tmp_path / "x")
    Path(port).touch()

    def refuse(**settings):
        requested.append(settings)
        raise OSError("not here")

    monkeypatch.setattr(can, "Bus", refuse)
    for medium in (
        CanMedium("virtual", "one", 250_000, {"rx_queue_size": 7}),
        CanMedium("slcan", port, 125_000),
        CanMedium("slcan", port, 125_000, {"sleep_after_open": 2.0, "tty_baudrate": 9600}),
        CanMedium("gs_usb", "1", 125_000),
        CanMedium("gs_usb", "1", 125_000, {"bus": 1, "address": 2}),
    ):
        with pytest.raises(OSError, match="not here"):
            medium.connect(TransportCounters())
    plain = {"interface": "slcan", "channel": port, "ignore_config": True, "bitrate": 125_000, "timeout": 0.1}
    usb = {"interface": "gs_usb", "channel": "1", "ignore_config": True, "bitrate": 125_000}
    assert requested == [
        {"interface": "virtual", "channel": "one", "ignore_config": True, "bitrate": 250_000, "rx_queue_size": 7},
        {**plain, "sleep_after_open": 0.0},
        {**plain, "sleep_after_open": 2.0, "tty_baudrate": 9600},
        {**usb, "index": 1},
        {**usb, "bus": 1, "address": 2},
    ]


# Of interface-local scope: nothing of it leaves this machine.
MULTICAST_GROUP = "ff11::6469:7363"


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast", "gs_usb"])
def test_a_bus_that_hands_back_own_frames_brings_those_of_another_host_only(interface, monkeypatch):
    if interface == "virtual":
        channel, options, own = next(CHANNELS), {}, {"receive_own_messages": True}
    elif interface == "gs_usb":
        # In place of an adapter, whose firmware echoes each frame that the host sends.
        channel, options, own, open_bus = next(CHANNELS), {}, {}, can.Bus
        echoing = {"interface": "virtual", "receive_own_messages": True}
        monkeypatch.setattr(can, "Bus", lambda **settings: open_bus(**settings | echoing))
    else:
        # A free port, so that runs side by side do not hear each other.
        channel, options, own = MULTICAST_GROUP, {"port": free_port(socket.SOCK_DGRAM), "hop_limit": 0}, {}
    with (
        other_node(interface, channel, **options) as other,
        opened_bus(interface, channel, **options, **own) as transport,
    ):
        up(transport)
        for number in range(5):
            send(transport, outgoing(0x100, bytes((number,))))
            assert bytes(other.recv(5.0).data) == bytes((number,))
        other.send(message(0x100, b"\4"))
        other.send(message(0x111))
        got = [(received.frame.can_id, received.frame.data) for received in collect(transport, 2)]
        assert got == [(0x100, b"\4"), (0x111, b"\x01\x02")]


def test_datagrams_that_are_no_frames_are_counted_and_do_not_cost_the_session():
    port = free_port(socket.SOCK_DGRAM)
    with (
        opened_bus("udp_multicast", MULTICAST_GROUP, port=port, hop_limit=0) as transport,
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as stranger,
    ):
        up(transport)
        # In msgpack a number, more than one value, {"a": 1} and {"dlc": "a"}.
        for number, datagram in enumerate((b"\x01", b"hello", b"\x81\xa1a\x01", b"\x81\xa3dlc\xa1a"), 1):
            stranger.sendto(datagram, (MULTICAST_GROUP, port))
            wait_until(lambda: transport.stats.malformed == number, timeout_s=2.0)  # noqa: B023
        assert transport.generation == 1


def test_a_frame_that_found_no_room_excuses_no_other_hosts():
    class Full:
        def send(self, message, timeout):
            raise can.CanOperationError("Transmit buffer full")

        def recv(self, timeout):
            return message(0x100, b"\1")

    connection = CanConnection(Full(), TransportCounters(), SentFrames())
    with pytest.raises(TransmitBusyError):
        connection.write(Frame(0x100, b"\1"))
    assert [received.frame for received in connection.read()] == [Frame(0x100, b"\1")]


class SocketcandServer:
    """A server in the manner of socketcand, on a TCP port of its own: raw mode, one client at a time."""

    def __init__(self):
        self.frames, self.opened, self._client = [], [], None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with client:
                self._talk(client)

    def _talk(self, client):
        client.sendall(b"< hi >")
        text = ""
        while True:
            try:
                data = client.recv(4096)
            except OSError:
                return
            if not data:
                return
            *commands, text = (text + data.decode()).split(">")
            for command in commands:
                arguments = command.strip("< ").split()
                if arguments[0] == "send":
                    self.frames.append(
                        (int(arguments[1], 16), bytes.fromhex("".join(f"{byte:0>2}" for byte in arguments[3:])))
                    )
                else:
                    self.opened.append(arguments)
                    self._client = client
                    client.sendall(b"< ok >")

    def send(self, can_id, data):
        self._client.sendall(f"< frame {can_id:03X} 1.000000 {data.hex().upper()} >".encode())

    def stop(self):
        """End, with whoever is connected."""
        # A plain close does not wake the thread that waits in accept.
        for connected in (self._listener, self._client):
            if connected is not None:
                with contextlib.suppress(OSError):
                    connected.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()


def test_socketcand_by_host_and_port_from_the_options():
    server = SocketcandServer()
    with opened_bus("socketcand", "can7", host="127.0.0.1", port=server.port) as transport:
        up(transport)
        assert server.opened == [["open", "can7"], ["rawmode"]]
        server.send(0x110, b"\x11\x22")
        (received,) = collect(transport, 1)
        assert received.frame == Frame(0x110, b"\x11\x22")
        assert 0 <= time.monotonic_ns() - received.t_ns < 10**10
        send(transport, outgoing(0x100, b"\xab\x01"))
        wait_until(lambda: server.frames == [(0x100, b"\xab\x01")])
        server.stop()

        def is_connecting():
            transport.send(outgoing(), time.monotonic_ns())
            return transport.state is LinkState.CONNECTING

        wait_until(is_connecting)
        wait_until(lambda: "start the other end first" in (transport.last_error or ""))


def test_a_socketcand_server_that_says_nothing_is_named_and_tried_again(monkeypatch):
    monkeypatch.setattr(can_transport, "_PROBE_TIMEOUT_S", 0.05)
    # The system accepts for it.
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with opened_bus("socketcand", "can7", host="127.0.0.1", port=port) as transport:
            wait_until(lambda: transport.last_error, timeout_s=2.0)
            assert "sends no greeting; it may serve one client alone: end the other program" in transport.last_error


def test_a_bus_over_a_port_that_stays_mute_is_opened_again(terminal):
    with opened(CanMedium("slcan", str(terminal.path), 500_000), mute_after_s=0.2) as transport:
        up(transport, generation=2)
        assert "no frame received for 0.2 s" in transport.last_error


@contextlib.contextmanager
def hub_process(path):
    """A hub in a process of its own, which is killed at the end."""
    process = subprocess.Popen([sys.executable, HUB_PROCESS, path], stdout=subprocess.PIPE, text=True)
    try:
        assert "ready" in process.stdout.readline()
        yield
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_between_processes_through_the_hub_that_dies_and_comes_back(tmp_path):
    path = str(tmp_path / "bus")
    with opened_bus("unixcan", path) as transport:
        wait_until(lambda: transport.last_error)
        assert "start the other end first" in transport.last_error
        for generation in (1, 2):
            with hub_process(path), other_node("unixcan", path) as other:
                up(transport, generation)
                before_ns = time.monotonic_ns()
                other.send(message(0x110, b"\x05"))
                (received,) = collect(transport, 1)
                assert received.frame == Frame(0x110, b"\x05")
                assert before_ns - 1_000_000 <= received.t_ns <= time.monotonic_ns()
                send(transport, outgoing(0x100, b"\x06"))
                assert bytes(other.recv(5.0).data) == b"\x06"
            wait_until(lambda: transport.state is LinkState.CONNECTING)
            assert not transport.send(outgoing(), time.monotonic_ns())


@pytest.fixture
def slcan(terminal):
    """A bus by an slcan adapter: the far end of the pseudo-terminal takes commands and frames as lines."""
    with opened_bus("slcan", str(terminal.path), bitrate=250_000) as transport:
        wait_until(lambda: terminal.lines and terminal.lines[-1] == b"O")
        up(transport)
        yield transport


def test_slcan_sets_the_bit_rate_and_carries_frames(slcan, terminal):
    assert b"S5" in terminal.lines
    before_ns = time.monotonic_ns()
    terminal.write(b"t11021122\rt0800\r")
    assert [received.frame for received in collect(slcan, 2)] == [Frame(0x110, b"\x11\x22"), Frame(0x080, b"")]
    assert slcan.receive() == ()
    assert before_ns < time.monotonic_ns()
    send(slcan, outgoing(0x100, b"\xab\xcd"))
    wait_until(lambda: b"t1002ABCD" in terminal.lines)


@pytest.mark.parametrize(
    "garbage",
    [
        b"\xff\x80\r",
        b"t1\r",
        b"tzz\r",
        b"t1234aabb\r",
        b"t110900112233445566778\r",
        b"tFFF0\r",
        b"T2000011zz\r",
        b"\x07\r",
    ],
)
def test_slcan_survives_a_garbled_line(slcan, terminal, garbage):
    terminal.write(garbage)
    if garbage != b"\x07\r":
        wait_until(lambda: slcan.stats.malformed)
    terminal.write(b"t11015a\r")
    assert collect(slcan, 1)[-1].frame == Frame(0x110, b"\x5a")
    assert slcan.generation == 1, "a garbled line does not cost the session"


def test_slcan_that_sends_nothing_but_garbage_is_opened_again(slcan, terminal):
    for _ in range(20 * GARBAGE_LIMIT):
        terminal.write(b"t1\r")
        if slcan.generation > 1:
            break
        time.sleep(0.002)
    up(slcan, generation=2)
    assert slcan.stats.malformed >= GARBAGE_LIMIT


def test_slcan_with_good_frames_between_the_garbage_is_kept(slcan, terminal):
    for number in range(1, GARBAGE_LIMIT + 10):
        terminal.write(b"t1\r")
        wait_until(lambda: slcan.stats.malformed == number)  # noqa: B023
        if number % 10 == 0:
            terminal.write(b"t110101\r")
            collect(slcan, 1)
    assert slcan.generation == 1


def test_slcan_adapter_unplugged_and_plugged_in_again_leaks_nothing(slcan, terminal):
    descriptors = len(os.listdir("/proc/self/fd"))
    for generation in (2, 3, 4):
        terminal.unplug()
        wait_until(lambda: slcan.state is LinkState.CONNECTING and slcan.last_error)
        wait_until(lambda: "no such device" in slcan.last_error)
        terminal.plug()
        up(slcan, generation)
        terminal.write(b"t110101\r")
        assert collect(slcan, 1)[-1].frame == Frame(0x110, b"\x01")
    wait_until(lambda: len(os.listdir("/proc/self/fd")) <= descriptors)


def test_slcan_adapter_in_use_takes_no_second_link_which_writes_nothing_to_it(slcan, terminal):
    written = bytes(terminal.received)
    with opened_bus("slcan", f"{terminal.path}@9600") as second:
        wait_until(lambda: second.last_error)
        assert "in use by another program" in second.last_error
    assert terminal.received == written
    with opened(CanMedium("slcan", str(terminal.path), 500_000, exclusive=False)) as stop:
        up(stop)
    assert slcan.generation == 1


def test_slcan_adapter_that_reads_nothing_blocks_nobody_and_frames_expire(slcan, terminal):
    terminal.stop_reading()
    wait_until(lambda: median_send_s(slcan) and slcan.stats.expired and slcan.stats.transmit_queue_full)
    assert median_send_s(slcan) < WRITE_TIMEOUT_S / 2, "shorter by far than one write that waits for room"
    assert slcan.state is LinkState.UP


@given(age_ns=st.integers(0, 999_000_000), wall_ns=st.integers(1_500_000_000, 4_000_000_000).map(lambda s: s * 10**9))
def test_a_wall_clock_stamp_becomes_monotonic(age_ns, wall_ns):
    now_ns = 5_000_000_000
    t_ns = monotonic_stamp_ns((wall_ns - age_ns) * 1e-9, wall_ns, now_ns)
    assert abs(t_ns - (now_ns - age_ns)) < 1_000, "a double of the wall clock resolves a quarter of a microsecond"


@pytest.mark.parametrize("timestamp_s", [0.0, 123.4, 1.7e9 + 3600.0, 1.7e9 - 3600.0, 1.7e9 + 1e-3])
def test_a_stamp_of_another_clock_counts_as_the_reception(timestamp_s):
    assert monotonic_stamp_ns(timestamp_s, 1_700_000_000_000_000_000, 5_000) == 5_000


def test_want_of_room_is_distinguished_from_a_dead_line():
    assert is_busy(can.CanOperationError("no room", errno.ENOBUFS))
    assert is_busy(can.CanOperationError("Transmit buffer full"))
    assert is_busy(can.CanTimeoutError())
    assert not is_busy(can.CanOperationError("down", errno.ENETDOWN))
    assert not is_busy(BrokenPipeError(errno.EPIPE, "broken"))


@pytest.mark.parametrize(
    ("flags", "carrier", "error", "expected_error"),
    [
        ("0x80", "0", OSError, "interface is down"),
        ("0x81", "0", LinkLostError, "bus-off"),
        ("0x81", "1", None, ""),
        ("gibberish", "1", None, ""),
    ],
)
def test_an_interface_on_which_sending_would_be_swallowed_is_not_used(tmp_path, flags, carrier, error, expected_error):
    """What the kernel shows in sysfs; "lo" lends its name, since every machine has it."""
    (tmp_path / "lo").mkdir()
    (tmp_path / "lo" / "flags").write_text(flags + "\n")
    (tmp_path / "lo" / "carrier").write_text(carrier + "\n")
    if error is None:
        require_working_interface("lo", tmp_path)
        return
    with pytest.raises(error, match=expected_error):
        require_working_interface("lo", tmp_path)


def test_socketcan_says_what_is_missing():
    with opened_bus("socketcan", "can_absent") as transport:
        wait_until(lambda: transport.last_error)
        assert "sudo ip link set can_absent up type can bitrate 500000" in transport.last_error
