"""A controller on a bench: the real C core, ideal wheels, and a host that says what it is told to, at 1 kHz."""

import copy
import math
from functools import lru_cache

from firmware_protocol import _firmware
from firmware_protocol.codec import Codec, Decoded
from firmware_protocol.firmware_core import FirmwareConfig, FirmwareCore, FirmwareInputs
from firmware_protocol.protection import PROVED, Prover, challenge_answer, data_id

MS = 1000
CODEC = Codec()
CONFIG = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
STATIONARY = FirmwareInputs(left_ticks=0, right_ticks=0, left_speed_rad_s=0.0, right_speed_rad_s=0.0)
FAULTS = {name: value for value, name in CODEC.choices("SYSTEM_STATE", "fault").items()}
BLOCKERS = {name: value for value, name in CODEC.choices("SESSION_STATE", "blockers").items()}


def transitions() -> list[tuple[tuple[str, ...], str, str]]:
    """The rows of the table in C: the states that each leaves, the state that it leads to, the cause of the stop."""
    states, causes = (CODEC.choices("SYSTEM_STATE", signal) for signal in ("state", "stop_cause"))
    count = _firmware.ffi.new("size_t *")
    rows = _firmware.lib.disco_transitions(count)[0 : count[0]]
    leaves = [tuple(name for state, name in states.items() if getattr(row, "from") >> state & 1) for row in rows]
    return [(left, states[row.to], causes[row.stop_cause]) for left, row in zip(leaves, rows, strict=True)]


def sealed(can_id: int, body: bytes, major: int = 1) -> bytes:
    """Seven bytes with the CRC in front, made with the C core's function."""
    return bytes((_firmware.lib.disco_e2e_crc(b"\0" + body, data_id(can_id, major)),)) + body


class Bench:
    """`start_us`: what the clock shows before the first cycle, as after so long a run without events."""

    def __init__(
        self, config: FirmwareConfig = CONFIG, entropy: int = 1, last_entropy: int = 0, start_us: int = 0
    ) -> None:
        self.config = config
        self.cycle_us = round(config.cycle_s * 1e6)
        self.ticks_per_rad = config.ticks_per_rev / (2.0 * math.pi)
        self.core = FirmwareCore(config, entropy, last_entropy)
        self.now_us = start_us
        self.counters: dict[str, int] = {}
        self.inputs: dict[str, object] = {}
        self.wheels_follow = True
        self.speeds = [0.0, 0.0]
        self.ticks = [0.0, 0.0]
        self.sent: list[tuple[int, Decoded]] = []
        self.request: dict[str, object] | None = None
        self.command: dict[str, object] | None = None
        self.answers = True
        self.prover = Prover(config.key, CODEC) if config.key else None
        self.out = None
        self.step()

    def copy(self) -> "Bench":
        """Return a bench in the same state, its core included, that goes its own way from here."""
        twin = copy.copy(self)
        twin.core = FirmwareCore(self.config, entropy=1)
        _firmware.ffi.memmove(twin.core._core, self.core._core, _firmware.ffi.sizeof("disco_firmware_t"))
        for name in ("counters", "inputs", "speeds", "ticks", "sent", "request", "command", "prover"):
            setattr(
                twin, name, copy.deepcopy(getattr(self, name)) if name == "prover" else copy.copy(getattr(self, name))
            )
        return twin

    @classmethod
    def ready(cls, session: int = 7, config: FirmwareConfig = CONFIG) -> "Bench":
        """Return a new bench that `to_ready` has brought to READY."""
        return _brought_there("to_ready", config, session).copy()

    @classmethod
    def armed(cls, session: int = 7, config: FirmwareConfig = CONFIG) -> "Bench":
        """Return a new bench that `to_armed` has armed."""
        return _brought_there("to_armed", config, session).copy()

    @classmethod
    def driving(
        cls, left: float = 4.0, right: float = 2.0, config: FirmwareConfig = CONFIG, start_us: int = 0
    ) -> "Bench":
        """Return a new bench that `to_driving` has brought to these wheel speeds (rad/s)."""
        return _brought_there("to_driving", config, left, right, start_us=start_us).copy()

    @classmethod
    def in_state(cls, state: str) -> "Bench":
        """Return a new bench in this state: ARMED it drives, in FAULT and ESTOP it has never driven."""
        bench = cls.ready() if state == "READY" else cls.driving() if state in ("ARMED", "STOPPING") else cls()
        if state == "STOPPING":
            bench.set_request("STANDBY").run_until("STOPPING")
        elif state == "FAULT":
            bench.inputs["left_current_a"] = 100.0
            bench.run_until("FAULT")
        elif state == "ESTOP":
            bench.estop()
        assert bench.out.state == state
        return bench

    def next_counter(self, name: str) -> int:
        self.counters[name] = (self.counters.get(name, -1) + 1) % 16
        return self.counters[name]

    def send(self, name: str, **signals: object) -> None:
        frame = CODEC.encode(name, self.next_counter(name), **signals)
        if self.prover is not None and self.prover.ready and name in PROVED:
            self.core.receive(self.now_us, *self.prover.prove(frame))
        self.core.receive(self.now_us, *frame)

    def hello(self, **changes: object) -> "Bench":
        self.send("HELLO_REQUEST", **{"protocol_major": 1, "protocol_minor": 0, "dbc_hash": CODEC.dbc_hash} | changes)
        return self

    def host_state(self, **changes: object) -> None:
        signals = {"request": "STANDBY", "session": 0, "challenge_answer": 0, "host_fault": 0} | changes
        self.send("HOST_STATE", **signals)

    def wheel_command(self, left: float = 0.0, right: float = 0.0, **changes: object) -> None:
        session = self.request["session"] if self.request else 0
        signals = {"mode": "SPEED", "left_speed": left, "right_speed": right, "valid_for": 0.1, "session": session}
        self.send("WHEEL_COMMAND", **signals | changes)

    def estop(self):
        """Send the emergency stop; return what the next cycle makes of it."""
        self.core.receive(self.now_us, 0x080, b"")
        return self.step()

    def step(self, elapsed_us: int | None = None):
        """Run one cycle after sending what the host has due: its state every 50 ms, its command every 20 ms."""
        if elapsed_us is None:
            elapsed_us = self.cycle_us
        self.now_us += elapsed_us
        if self.request is not None and self.now_us % (50 * MS) == 0:
            request = dict(self.request)
            if request["request"] == "ARM" and self.answers:
                request["challenge_answer"] = challenge_answer(self.core.challenge, request["session"], CODEC.dbc_hash)
            self.host_state(**request)
        if self.command is not None and self.now_us % (20 * MS) == 0:
            self.wheel_command(**self.command)
        if self.wheels_follow and self.out is not None:
            self.speeds = [self.out.left_setpoint_rad_s, self.out.right_setpoint_rad_s]
        ticks_per_speed = self.ticks_per_rad * elapsed_us * 1e-6
        for side, speed in enumerate(self.speeds):
            if math.isfinite(speed):
                self.ticks[side] += speed * ticks_per_speed
        measured = {
            "left_ticks": int(self.ticks[0]),
            "right_ticks": int(self.ticks[1]),
            "left_speed_rad_s": self.speeds[0],
            "right_speed_rad_s": self.speeds[1],
        }
        if self.inputs:
            measured |= self.inputs
        self.out = self.core.step(self.now_us, FirmwareInputs(**measured))
        for can_id, data in self.core.drain():
            decoded = CODEC.decode(can_id, data)
            assert isinstance(decoded, Decoded), decoded
            self.sent.append((self.now_us, decoded))
            if self.prover is not None and decoded.name == "MAC_CHALLENGE":
                self.prover.challenge(int(decoded.values["nonce"]))
        return self.out

    def run(self, cycles: int):
        for _ in range(cycles):
            self.step()
        return self.out

    def run_until(self, *states: str, within_ms: int = 3000):
        for _ in range(within_ms):
            if self.step().state in states:
                return self.out
        raise AssertionError(f"still {self.out.state}, not {states}; rejections {self.core.rejections}")

    def set_request(self, request: str, session: int = 7, **changes: object) -> "Bench":
        self.request = {"request": request, "session": session} | changes
        return self

    def to_standby(self) -> "Bench":
        """Disarm, with no more commands."""
        self.command = None
        self.set_request("STANDBY").run_until("STANDBY")
        return self

    def to_ready(self, session: int = 7) -> "Bench":
        self.hello()
        self.set_request("READY", session)
        self.run_until("READY")
        return self

    def to_armed(self, session: int = 7) -> "Bench":
        self.to_ready(session)
        self.set_request("ARM", session)
        self.command = {}
        self.run_until("ARMED")
        return self

    def to_driving(self, left: float = 4.0, right: float = 2.0) -> "Bench":
        self.to_armed()
        self.command = {"left": left, "right": right}
        self.run(400)
        assert abs(self.out.left_setpoint_rad_s - left) + abs(self.out.right_setpoint_rad_s - right) < 1e-6
        return self

    def messages(self, name: str, since_us: int = 0) -> list[Decoded]:
        return [decoded for t_us, decoded in self.sent if decoded.name == name and t_us >= since_us]

    def fault(self) -> str:
        return CODEC.choice_name("SYSTEM_STATE", "fault", self.out.fault)

    def blockers(self) -> set[str]:
        return {name for name, bit in BLOCKERS.items() if self.out.blockers & bit}


@lru_cache(maxsize=16)
def _brought_there(how: str, config: FirmwareConfig, *arguments: float, start_us: int = 0) -> Bench:
    """Return the one bench of a way there, which costs hundreds of cycles; each test goes on with a copy of it."""
    bench: Bench = getattr(Bench(config, start_us=start_us), how)(*arguments)
    return bench
