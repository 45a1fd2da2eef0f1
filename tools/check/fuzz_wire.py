"""A long campaign of hostile frames and bytes against what reads the wire; memory must not grow. Part of `make fuzz`.

Decoder, serial framing, the driver's receive path (with a key and without) and the C core get frames made from good
ones by flipping, cutting and repeating, and pure noise. None may raise, hang or keep what it was given.
"""

from __future__ import annotations

import argparse
import itertools
import random
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

from drivers.motor.reference import ReferenceDriver
from drivers.types import Frame, ReceivedFrame, WheelCommand
from firmware_protocol.codec import PROTOCOL, Codec
from firmware_protocol.firmware_core import FirmwareConfig, FirmwareCore, FirmwareInputs
from firmware_protocol.protection import crc8
from firmware_protocol.serial_framing import FrameDecoder, encode_frame

GROWTH_LIMIT_KB = 256.0
WARM_UP = 0.2
SLOWEST_S = 5.0
KEY = bytes(range(16))
CONFIG = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
STATIONARY = FirmwareInputs(left_ticks=0, right_ticks=0, left_speed_rad_s=0.0, right_speed_rad_s=0.0)
_LAYOUTS = {message.can_id: message for message in PROTOCOL.messages}
_IDS = tuple(_LAYOUTS)


def hostile_frame(generator: random.Random) -> tuple[int, bytes]:
    """Return a hostile frame: half of them with a CRC that holds, so that they get past the first door."""
    can_id = generator.choice(_IDS) if generator.random() < 0.9 else generator.randrange(0x20000000)
    data = generator.randbytes(generator.choice((8, 8, 8, 8, 8, 8, 0, 1, 7, 9, 64)))
    layout = _LAYOUTS.get(can_id)
    if layout is not None and layout.data_id is not None and len(data) == layout.length and generator.random() < 0.6:
        data = bytes((crc8(data[1:], layout.data_id),)) + data[1:]
    return can_id, data


def _decoder() -> Callable[[random.Random], None]:
    codec = Codec()
    return lambda generator: (codec.decode(*hostile_frame(generator)), None)[1]


def _framing() -> Callable[[random.Random], None]:
    decoder = FrameDecoder()

    def feed(generator: random.Random) -> None:
        can_id, data = hostile_frame(generator)
        line = bytearray(encode_frame(can_id & 0x7FF, data[:8]))
        for _ in range(generator.choice((0, 0, 1, 3))):
            line[generator.randrange(len(line))] = generator.randrange(256)
        noise = generator.randbytes(generator.choice((0, 0, 0, 5, 300)))
        decoder.feed(bytes(line[: generator.choice((len(line), len(line), 3))]) + noise)

    return feed


def _driver(key: bytes | None) -> Callable[[random.Random], None]:
    driver = ReferenceDriver(Codec(), itertools.count(1).__next__, key)
    times = itertools.count(1_000_000_000, 10_000_000)
    driver.link_up(next(times))

    def receive(generator: random.Random) -> None:
        now_ns = next(times)
        frames = [
            ReceivedFrame(now_ns - generator.randrange(10**9), Frame(can_id & 0x7FF, data[:8]))
            for can_id, data in (hostile_frame(generator) for _ in range(4))
        ]
        driver.receive(now_ns, frames)
        driver.transmit(now_ns, WheelCommand(1.0, 1.0, 0.1))
        assert driver.detail

    return receive


def _core(key: bytes) -> Callable[[random.Random], None]:
    core = FirmwareCore(replace(CONFIG, key=key), entropy=5)
    times = itertools.count(1000, 1000)

    def receive(generator: random.Random) -> None:
        now_us = next(times)
        core.receive(now_us, *hostile_frame(generator))
        outputs = core.step(now_us, STATIONARY)
        core.drain()
        assert not outputs.driver_enabled, "armed by noise"

    return receive


TARGETS: dict[str, Callable[[], Callable[[random.Random], None]]] = {
    "codec": _decoder,
    "serial framing": _framing,
    "driver": lambda: _driver(None),
    "driver with a key": lambda: _driver(KEY),
    "firmware core": lambda: _core(b""),
    "firmware core with a key": lambda: _core(KEY),
}


def campaign(name: str, count: int, seed: int) -> list[str]:
    """Feed hostile frames to one target; return what went wrong."""
    feed_one = TARGETS[name]()
    generator = random.Random(seed)
    settled, slowest_s = 0, 0.0
    tracemalloc.start()
    try:
        for number in range(count):
            started = time.monotonic()
            try:
                feed_one(generator)
            except Exception as error:
                return [f"{name}: frame {number} of seed {seed}: {type(error).__name__}: {error}"]
            slowest_s = max(slowest_s, time.monotonic() - started)
            if number == int(count * WARM_UP):
                settled = tracemalloc.get_traced_memory()[0]
        growth_kb = (tracemalloc.get_traced_memory()[0] - settled) / 1024.0
    finally:
        tracemalloc.stop()
    wrong = [f"{name}: memory grew by {growth_kb:.0f} kB"] if growth_kb > GROWTH_LIMIT_KB else []
    return wrong + ([f"{name}: one took {slowest_s:.1f} s"] if slowest_s > SLOWEST_S else [])


def main() -> int:
    """Run a campaign for every target; exit 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300_000, help="frames for each target")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    failed = False
    for name in TARGETS:
        wrong = campaign(name, given.count, given.seed)
        print(f"{name}: {given.count} times, {'; '.join(wrong) or 'sound'}", flush=True)
        failed |= bool(wrong)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
