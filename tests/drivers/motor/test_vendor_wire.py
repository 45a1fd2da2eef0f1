"""Tests that each vendor's driver sends the same frames in a scripted day: every frame, its time, life and rank.

Whoever means to change it looks at the frames of the phase that is named, and then writes the new sums here.
"""

import functools
import hashlib

import pytest

from drivers.types import DriverState, Request
from sim.can_protocol import CanFrame
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.vendors import BY_LABEL, VENDORS

COASTING_S = 1.0
SUMS = {
    "odrive-0.6": "73f18e 13b82a e58728 60e036 e0b0ee 0fbfb3 1a72f2 ed1764 9c195a 6324af",
    "odrive-0.5": "f8fb0e 7a818c 4742e8 86d68f 14437b 808aa8 8e5c8c 8afb1f 6edc79 00101a",
    "odrive-four-axes": "622062 8dc6fb 0b1527 02619d 87eaac 702f0f 1ca3bb 6c4842 fbd769 2888d5",
    "vesc": "33fa55 1784b8 a84447 f6adb1 2f2111 89c776 144b0f a7c6d0 0e9a7b eec893",
    "vesc-four-braking": "abb1d5 22f891 0d471e 557862 5c4d8f 91bd08 ca59f9 aad34b 9972fe 13e3a5",
    "vesc-uart": "5ccdae 20cbc8 ee78c3 73172c 060d59 9abb33 628638 8b6f63 f5e4b9 07af09",
    "agilex": "e3b0c4 2d8bed 25fe17 bf6f49 350532 9a3dd8 c7c7a0 6a8174 53ecac e3b0c4",
    "roboclaw": "e5b47b 7161c0 2a3576 22bd85 2c8122 cc06d6 98dc6b 6b454a c5f6d1 278519",
    "roboclaw-a-board-a-side": "9a3d01 c2a2dc f76b7e 6f994d 760e80 45cd67 e4557a c21981 de63e2 4d85fd",
    "ros2-base": "e3b0c4 1450c4 22d636 e0adb8 255f60 81ad5e e3b0c4 186d20 3f0143 272f2d",
}
"""SHA-256 of the frames of each phase of `scripted_day`, in its order: the first six digits."""


class Recorded:
    """A bench whose driver's frames are kept by phase, whichever way they are asked for."""

    def __init__(self, vendor):
        self.phases = {}
        self.bench = vendor.bench(coasting_s=0.2)
        driver = self.bench.driver
        transmit, estop = driver.transmit, driver.estop
        driver.transmit = lambda now_ns, command: self.keep(now_ns, transmit(now_ns, command))
        driver.estop = lambda now_ns: self.keep(now_ns, estop(now_ns))

    def begin(self, phase):
        self.lines = self.phases[phase] = []

    def keep(self, now_ns, sent):
        for each in sent:
            frame = each.frame
            at_us, life_us = now_ns // 1000, (each.deadline_ns - now_ns) // 1000
            kind = "x" if frame.extended else "s"
            self.lines.append(f"{at_us} {life_us} {each.rank} {frame.can_id:x}{kind} {frame.data.hex()}")
        return sent


# Of the boards with one driver and one kind of line `make test` tries the first.
FURTHER = ("odrive-0.5", "odrive-four-axes", "vesc-four-braking", "roboclaw-a-board-a-side")
MARKED_VENDORS = [pytest.param(one, marks=pytest.mark.thorough) if str(one) in FURTHER else one for one in VENDORS]


@functools.cache
def scripted_day(vendor):
    """The frames of each phase, as lines."""
    recorded = Recorded(vendor)
    bench, begin = recorded.bench, recorded.begin
    begin("start")
    bench.run_until(*IDLE_STATES)
    bench.run(0.5)
    begin("arm")
    bench.arm()
    begin("run")
    bench.run(1.0, FORWARD)
    bench.run(0.5, (-1.0, 2.5))
    begin("stop")
    bench.request(Request.STANDBY).run_until(*IDLE_STATES)
    bench.run(COASTING_S)
    begin("again")
    bench.drive(0.5, FORWARD)
    begin("fault")
    vendor.lose_left(bench.robot)
    bench.run_until(DriverState.FAULT, timeout_s=0.5)
    bench.run(COASTING_S)
    begin("reset")
    vendor.mend(bench.robot)
    bench.request(Request.RESET).run_until(*IDLE_STATES)
    bench.run(COASTING_S)
    begin("reconnect")
    bench.drive(0.5, FORWARD)
    bench.host_end.plug(False)
    bench.run(COASTING_S)
    bench.host_end.plug(True)
    bench.run(COASTING_S)
    begin("estop")
    bench.drive(0.5, FORWARD)
    bench.send_estop()
    bench.run(COASTING_S)
    begin("after")
    bench.request(Request.RESET).run_until(*IDLE_STATES)
    bench.run(0.5)
    return recorded.phases


UNUSED_COMMANDS = (20, 22, 28, 29, 61, 62, 94, 98, 148, 201)
"""Of a RoboClaw: to count anew, other PIDs, the non-volatile memory, modes of its pins and of its e-stop."""


def as_frame(frame):
    return CanFrame(int(frame[3][:-1], 16), bytes.fromhex(frame[4] if len(frame) > 4 else ""), frame[3][-1] == "x")


@pytest.mark.parametrize("vendor", MARKED_VENDORS, ids=str)
def test_no_frame_of_a_scripted_day_moves_by_itself_calibrates_or_writes_what_stays(vendor):
    sent = [as_frame(line.split(" ")) for lines in scripted_day(vendor).values() for line in lines]
    assert len(sent) > 100
    assert not [frame for frame in sent if vendor.is_forbidden(frame)]


@pytest.mark.parametrize(
    ("label", "frames"),
    [
        # Calibrate, search, home; position, torque, limits, gains, renaming, restarting, counting anew, parameters.
        ("odrive-0.6", ["67 0300000000000000", "67 0400000000000000", "67 0b00000000000000", "6c 00000000", "6e 0000",
                        "6f 00", "7a 00", "66 00", "76 00", "79 00", "64 01dc000001000000", "6b 0300000001000000"]),
        # Duty, current, position, shutdown, bit rate, a packet that sets, a speed cut short.
        ("vesc", ["17 00000000x", "117 00000001x", "417 00000000x", "1f17 x", "3f17 00x", "817 fe000dx", "317 0bb8x"]),
        # The serial mode, lights, brakes, a mode of 1 byte.
        ("agilex", ["421 0200000000000000", "121 0000000000000000", "131 00", "421 01"]),
        ("roboclaw", [f"{0x8000 | command:x} 0000000000000000" for command in UNUSED_COMMANDS]
         + ["8022 8022000100010000"]),
    ],
)  # fmt: skip
def test_what_no_driver_may_send_would_be_noticed(label, frames):
    for text in frames:
        can_id, data = text.rstrip("x").split(" ")
        frame = CanFrame(int(can_id, 16), bytes.fromhex(data), text.endswith("x"))
        assert BY_LABEL[label].is_forbidden(frame), text


@pytest.mark.parametrize("vendor", MARKED_VENDORS, ids=str)
def test_every_frame_of_a_scripted_day_is_the_one_that_was_recorded(vendor):
    phases = scripted_day(vendor)
    sums = {name: hashlib.sha256("\n".join(lines).encode()).hexdigest()[:6] for name, lines in phases.items()}
    assert sums == dict(zip(phases, SUMS[str(vendor)].split(), strict=True))
