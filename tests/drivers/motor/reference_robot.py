"""The real C firmware core, with wheels that follow their setpoint at once in place of motors."""

import itertools
import math

from drivers.motor.reference import ReferenceDriver
from drivers.types import Frame
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareConfig, FirmwareCore, FirmwareInputs
from tests.drivers.motor.bench import Bench

CODEC = Codec()

CONFIG = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)


def create_driver(key=None):
    return ReferenceDriver(CODEC, itertools.count(41).__next__, key)


def create_bench(robot=None, **options):
    """Return a bench of the reference driver, with a robot of `CONFIG` unless it is given another."""
    return Bench(create_driver(), robot or ReferenceRobot(), **options)


class ReferenceRobot:
    """Robot for the bench and the conformance suite; wheels turn as the core's outputs say."""

    def __init__(self, config=CONFIG, *, boot_ns=0, skew=0.0, first_ticks=(0, 0), entropy=7):
        self.core = FirmwareCore(config, entropy)
        self.config = config
        self.boot_ns = boot_ns
        self.skew = skew
        self.angle = [0.0, 0.0]
        self.speed = [0.0, 0.0]
        self.first_ticks = first_ticks
        self.inputs = {}
        self.pushed = 0.0
        self.outputs = None
        self._last_ns = None

    @property
    def armed(self):
        return self.outputs.state == "ARMED"

    @property
    def speed_rad_s(self):
        """Speed of the faster wheel, rad/s."""
        return max(abs(speed) for speed in self.speed)

    @property
    def session(self):
        return self.outputs.session

    def us(self, now_ns):
        return int((now_ns - self.boot_ns) / 1000 / (1 + self.skew))

    def receive(self, now_ns, frame):
        self.core.receive(self.us(now_ns), frame.can_id, frame.data)

    def step(self, now_ns):
        elapsed_s = (now_ns - self._last_ns) * 1e-9 if self._last_ns is not None else 0.0
        self._last_ns = now_ns
        self.angle = [angle + speed * elapsed_s for angle, speed in zip(self.angle, self.speed, strict=True)]
        ticks = [
            math.floor(first + angle / (2 * math.pi) * self.config.ticks_per_rev)
            for first, angle in zip(self.first_ticks, self.angle, strict=True)
        ]
        self.outputs = self.core.step(
            self.us(now_ns),
            FirmwareInputs(
                left_ticks=ticks[0],
                right_ticks=ticks[1],
                left_speed_rad_s=self.speed[0],
                right_speed_rad_s=self.speed[1],
                **self.inputs,
            ),
        )
        self.speed = [
            self.outputs.left_setpoint_rad_s + self.pushed,
            self.outputs.right_setpoint_rad_s + self.pushed,
        ]

    def drain(self):
        return [Frame(can_id, data) for can_id, data in self.core.drain()]

    def press_estop(self, pressed):
        self.inputs["estop_button"] = pressed

    def break_down(self, broken):
        """Make a fault that latches, or take its cause away."""
        self.inputs["left_current_a"] = 100.0 if broken else 0.0
