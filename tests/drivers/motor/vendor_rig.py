"""A vendor's simulated controllers with wheels that follow at once, or coast where they are released."""

import math

from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame

TICKS_PER_REV = 4096
TICKS_PER_RAD = TICKS_PER_REV / (2.0 * math.pi)
START_NS = 50_000 * 1_000_000


class VendorRig:
    """What `bench.Bench` steps; `controller` of `sim.devices`. `stuck`: sides that roll whatever is asked.

    `exchange`: of a driver on a half-duplex line, where each request gets the reply that belongs to it. `coasting_s`:
    in what time a released wheel loses all but 1/e of its speed.
    """

    def __init__(self, controller, exchange=None, coasting_s=0.5):
        self.controller = controller
        self.exchange = exchange
        self.speed = [0.0, 0.0]
        self.angle = [0.0, 0.0]
        self.pressed = False
        self.received = []
        self._outgoing = []
        self._kept = math.exp(-1e-3 / coasting_s)
        self.stuck = set()

    @property
    def speed_rad_s(self):
        left, right = self.speed
        return max(abs(left), abs(right))

    def receive(self, now_ns, frame):
        self.received.append(frame)
        if self.exchange is None:
            sent = CanFrame(frame.can_id, frame.data, frame.extended)
            self._outgoing += self.controller.receive(self._us(now_ns), sent)
            return
        output = self.controller.receive(self._us(now_ns), CanFrame(0, self.exchange.request(frame)))
        reply = self.exchange.reply(frame, b"".join(each.data for each in output))
        self._outgoing += [] if reply is None else [reply]

    def step(self, now_ns):
        for side, target_rad_s in enumerate(self.controller.wheels_rad_s):
            if target_rad_s is not None and side not in self.stuck:
                self.speed[side] = target_rad_s
            else:
                self.speed[side] *= self._kept
            self.angle[side] += 1e-3 * self.speed[side]
        inputs = FirmwareInputs(
            left_ticks=round(self.angle[0] * TICKS_PER_RAD),
            right_ticks=round(self.angle[1] * TICKS_PER_RAD),
            left_speed_rad_s=self.speed[0],
            right_speed_rad_s=self.speed[1],
            estop_button=self.pressed,
        )
        self._outgoing += self.controller.step(self._us(now_ns), inputs)

    def drain(self):
        frames, self._outgoing = self._outgoing, []
        return frames

    def press_estop(self, pressed):
        self.pressed = pressed

    @staticmethod
    def _us(now_ns):
        return (now_ns - START_NS) // 1000
