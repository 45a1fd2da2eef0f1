"""Cost of the wire on the host: a command made, a sample judged; what a proof adds, on the host and in the C core."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.motor.reference_frames import FrameTransmission
from firmware_protocol import _firmware
from firmware_protocol.codec import Codec
from firmware_protocol.protection import aes_cmac
from tools.bench.step_times import percentiles, times_ms

COMMAND = {"mode": "SPEED", "left_speed": 1.5, "right_speed": -0.75, "valid_for": 0.1, "session": 7}
SAMPLE = {"left_valid": 1, "right_valid": 1, "driver_enabled": 1, "limited": 0, "left_speed": 1.0, "right_speed": 2.0}
KEY = bytes(range(16))
MESSAGE = bytes(24)
LIFE_NS = 50_000_000


def run(count: int = 20_000) -> dict[str, float]:
    """Return the times of codec and authentication in microseconds.

    `wire.core_cmac_us` is C called from Python, `wire.cryptography_cmac_us` its peer.
    """
    codec = Codec()
    plain, proving = FrameTransmission(codec), FrameTransmission(codec, KEY)
    proving.challenge(0x123456789ABC)
    sample = codec.encode("WHEEL_SPEED", 3, sample_time=6000, **SAMPLE)
    lib: Any = _firmware.lib
    ffi: Any = _firmware.ffi
    key, tag = ffi.new("disco_cmac_key_t *"), ffi.new("uint8_t[16]")
    lib.disco_cmac_init(key, KEY)

    def send(transmission: FrameTransmission) -> Callable[[], object]:
        return lambda: transmission.proved([transmission.frame("WHEEL_COMMAND", 0, LIFE_NS, **COMMAND)])

    figures: dict[str, float] = {}
    work: dict[str, Callable[[], object]] = {
        "wire.command_us": send(plain),
        "wire.proved_command_us": send(proving),
        "wire.sample_decoded_us": lambda: codec.decode(*sample),
        "wire.core_cmac_us": lambda: lib.disco_cmac(key, MESSAGE, len(MESSAGE), tag),
        "wire.cryptography_cmac_us": lambda: aes_cmac(KEY, MESSAGE),
    }
    for name, what in work.items():
        figures |= percentiles(name, 1e3 * times_ms(lambda _, what=what: what(), count))
    figures["wire.core_cmac_over_cryptography"] = (
        figures["wire.core_cmac_us.p50"] / figures["wire.cryptography_cmac_us.p50"]
    )
    return figures
