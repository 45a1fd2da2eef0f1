"""What comes from the bus: frames for others, damage, and hours of nonsense."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol.codec import PROTOCOL
from firmware_protocol.firmware_core import FirmwareCore
from tests.firmware_protocol.bench import CODEC, CONFIG, Bench, sealed
from tests.tables import thinned

HOST_IDS = [message.can_id for message in PROTOCOL.messages if message.sender == "HOST"]
SEALED_IDS = [message.can_id for message in PROTOCOL.messages if message.sender == "HOST" and message.data_id]
ROBOT_IDS = [message.can_id for message in PROTOCOL.messages if message.sender == "ROBOT"]


@pytest.mark.parametrize("can_id", [*ROBOT_IDS, 0, 0x7FF, 0x1FFFFFFF])
def test_frames_for_others_are_counted_and_otherwise_nothing(can_id, bench):
    bench.core.receive(bench.now_us, can_id, bytes(8))
    assert bench.core.unknown_frames == 1
    assert bench.step().rejected_frames == 0


@pytest.mark.parametrize("can_id", SEALED_IDS)
def test_every_wrong_length_and_every_damaged_byte_is_rejected(can_id, bench):
    good = sealed(can_id, bytes(7), major=0 if can_id == 0x102 else 1)
    for length in range(8):
        bench.core.receive(bench.now_us, can_id, good[:length])
    assert bench.core.rejections["LENGTH"] == 8
    for position in range(8):
        damaged = bytearray(good)
        damaged[position] ^= 0x55
        bench.core.receive(bench.now_us, can_id, bytes(damaged))
    assert bench.core.rejections["CRC"] == 8
    assert bench.step().state == "STANDBY"


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize("state", ["STANDBY", "READY", "ARMED"])
def test_estop_needs_no_proof(state, length):
    bench = Bench.in_state(state)
    bench.core.receive(bench.now_us, 0x080, b"\xa5" * length)
    bench.step()
    assert (bench.out.state, bench.out.estop_source) == ("ESTOP", "FRAME")


def test_estop_before_the_first_cycle_is_kept(bench):
    bench.core = FirmwareCore(CONFIG)
    bench.core.receive(0, 0x080, b"")
    assert bench.run(2).state == "ESTOP"


def test_nothing_is_accepted_before_the_wheels_are_known_to_stand(bench):
    """Frames may come before the first cycle; the measurements are not known yet."""
    bench.core = FirmwareCore(CONFIG)
    bench.now_us = 0
    bench.hello()
    for _ in range(5):
        bench.host_state(request="READY", session=3)
    assert bench.step().state == "STANDBY"
    bench.host_state(request="READY", session=3)
    assert bench.step().state == "READY"


frames = st.one_of(
    st.tuples(st.sampled_from(SEALED_IDS), st.binary(min_size=7, max_size=7).map(bytes), st.just("sealed")),
    st.tuples(st.integers(0x081, 0x7FF), st.binary(max_size=8), st.just("raw")),
)


@settings(max_examples=60)
@given(st.lists(st.tuples(frames, st.integers(1, 5)), max_size=80))
def test_random_frames_never_move_an_idle_robot(sequence):
    bench = Bench().hello()
    bench.set_request("READY")
    for (can_id, body, kind), milliseconds in sequence:
        data = sealed(can_id, body, major=0 if can_id == 0x102 else 1) if kind == "sealed" else body
        bench.core.receive(bench.now_us, can_id, data)
        bench.run(milliseconds)
        assert not bench.out.driver_enabled
        assert (bench.out.left_setpoint_rad_s, bench.out.right_setpoint_rad_s) == (0.0, 0.0)


class Host:
    """Means well: opens a session, arms, drives at random, resets after a stop, and begins again."""

    def __init__(self, bench, generator):
        self.bench, self.generator = bench, generator
        self.session = generator.randrange(1, 256)
        bench.hello()

    def act(self):
        bench, state = self.bench, self.bench.out.state
        if state in {"READY", "ARMED"} and bench.out.session == self.session:
            bench.set_request("ARM", self.session)
        elif state in {"ESTOP", "FAULT"}:
            # A reset counts from the moment it is first asked for, so it must be taken back to be asked for again.
            bench.set_request("RESET" if bench.now_us % 1_000_000 > 200_000 else "STANDBY", self.session)
        else:
            bench.set_request("READY", self.session)
            self.session = self.session % 255 + (bench.now_us % 300_000 == 0) or 1
        if state == "ARMED":
            bench.command = {"left": self.generator.uniform(-65, 65), "right": self.generator.uniform(-65, 65)}
        else:
            bench.command = {}
        if bench.now_us % 1_000_000 == 0:
            bench.hello()


class Intruder:
    """Sends damaged, well-sealed and replayed frames; now and then an emergency stop."""

    def __init__(self, bench, generator):
        self.bench, self.generator = bench, generator
        self.recorded = []

    def act(self):
        bench, generator = self.bench, self.generator
        receive, chance = bench.core.receive, generator.random
        if chance() < 0.01:
            receive(bench.now_us, generator.randrange(0x081, 0x800), generator.randbytes(generator.randrange(9)))
        if chance() < 0.004:
            can_id = generator.choice(SEALED_IDS)
            receive(bench.now_us, can_id, sealed(can_id, generator.randbytes(7), major=0 if can_id == 0x102 else 1))
        if bench.out.session and chance() < 0.004:
            receive(bench.now_us, *self.recorded_command(*generator.choice(self.recorded)))
        if chance() < 0.0005:
            receive(bench.now_us, 0x080, generator.randbytes(generator.randrange(9)))
        self.recorded.append((generator.randrange(16), bench.out.session))

    def recorded_command(self, counter, session):
        speeds = {"left_speed": 9.0, "right_speed": 9.0}
        return CODEC.encode("WHEEL_COMMAND", counter, mode="SPEED", valid_for=0.5, session=session, **speeds)


@thinned("seed", range(10), quick=2)
def test_motion_only_while_armed_or_stopping_and_within_limits_whatever_is_on_the_bus(seed):
    generator = random.Random(seed)
    bench = Bench()
    actors = Host(bench, generator), Intruder(bench, generator)
    previous, seen = bench.out, {"moved": 0}
    for _ in range(8000):
        for actor in actors:
            actor.act()
        out = bench.step()
        before = (previous.left_setpoint_rad_s, previous.right_setpoint_rad_s)
        now = (out.left_setpoint_rad_s, out.right_setpoint_rad_s)
        assert max(map(abs, now)) <= 8.0
        if out.driver_enabled:
            assert out.state in {"ARMED", "STOPPING", "ESTOP"}
            assert max(abs(a - b) for a, b in zip(now, before, strict=True)) <= 0.02 + 1e-5
        if out.state != "ARMED":
            assert max(map(abs, now)) < max(map(abs, before)) or now == (0.0, 0.0)
        seen["moved"] += now != (0.0, 0.0)
        seen[out.state] = seen.get(out.state, 0) + 1
        previous = out
    assert seen["moved"] > 500, seen
    assert {"STANDBY", "READY", "ARMED", "STOPPING"} <= set(seen)
