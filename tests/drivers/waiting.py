"""Waiting for other threads and processes in tests."""

import random
import socket
import statistics
import time

from drivers.types import Frame, OutgoingFrame


def wait_until(condition, timeout_s=10.0):
    """Wait for a condition; fails the test if it does not come true."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"waited {timeout_s} s in vain"
        time.sleep(0.002)
    return value


def free_port(kind=socket.SOCK_STREAM):
    """A port that nobody has, below those that the kernel hands to whoever asks for any: it stays free until used."""
    while True:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with socket.socket(socket.AF_INET6, kind) as probe:
            try:
                # Of both families at once.
                probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
                probe.bind(("::", port))
            except OSError:
                continue
            return port


def outgoing(can_id=0x100, data=b"\x01", valid_for_s=5.0):
    """A frame that is valid for some time from now."""
    return OutgoingFrame(Frame(can_id, data), time.monotonic_ns() + int(valid_for_s * 1e9))


def send(transport, *frames):
    """Send frames now; each must be taken."""
    for frame in frames:
        assert transport.send(frame, time.monotonic_ns())


def collect(transport, count, timeout_s=10.0):
    """Receive at least `count` frames."""
    received = []
    wait_until(lambda: received.extend(transport.receive()) or len(received) >= count, timeout_s)
    return received


def receive_until(source, enough):
    """Poses and messages of a pose source until `enough(poses, messages)`, within a generous time."""
    found, messages = [], []
    end_s = time.monotonic() + 60.0
    while not enough(found, messages):
        assert time.monotonic() < end_s, (found, messages)
        found += source.receive(time.monotonic_ns(), ())
        messages += source.new_messages()
        time.sleep(0.01)
    return found, messages


def median_send_s(transport):
    """Return how long `send` keeps its caller, over fifty frames that are soon too old to be sent."""
    durations = []
    for _ in range(50):
        started = time.monotonic()
        transport.send(outgoing(0x100, bytes(8), valid_for_s=0.02), time.monotonic_ns())
        durations.append(time.monotonic() - started)
    return statistics.median(durations)
