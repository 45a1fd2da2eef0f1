"""The host that the conformance suite plays: by the book, or against it, as a test wants."""

import contextlib
import itertools

from firmware_protocol.codec import PROTOCOL_MAJOR, PROTOCOL_MINOR, Codec, Decoded
from firmware_protocol.protection import PROVED, Prover, challenge_answer

STATE_PERIOD_NS = 50_000_000
COMMAND_PERIOD_NS = 20_000_000
CODEC = Codec()
_BLOCKERS = CODEC.choices("SESSION_STATE", "blockers")


def _system_state(signal):
    """A property: the name of what the last SYSTEM_STATE has in a signal."""
    return property(lambda self: self._choice("SYSTEM_STATE", signal))


class ProtocolHost:
    """Sends `request` (a HOST_STATE's signals) every 50 ms and `command` (a WHEEL_COMMAND's) every 20 ms, if not None.

    `received` keeps what came since it was cleared last: (time in ns, decoded frame). `proves`: whether commands are
    proved where there is a key, and `valid_for_s` how long they hold unless a test says otherwise. `damaged` counts
    what came and could not be decoded.
    """

    def __init__(self, end, key=None, first_session=1, valid_for_s=0.1):
        self.end = end
        self.prover = Prover(key, CODEC) if key is not None else None
        self.proves = True
        self.valid_for_s = valid_for_s
        self.request = None
        self.command = None
        self.received = []
        self.damaged = 0
        self.latest = {}
        self.limits = {}
        self._sessions = itertools.cycle(range(1, 256))
        for _ in range(first_session):
            next(self._sessions)
        self._counters = {}
        self._due = {"request": 0, "command": 0}

    state = _system_state("state")
    fault = _system_state("fault")
    stop_cause = _system_state("stop_cause")
    reject_reason = _system_state("reject_reason")
    estop_source = _system_state("estop_source")

    @property
    def rejected(self):
        return int(self.latest["SYSTEM_STATE"]["rejected_count"])

    @property
    def session(self):
        return int(self.latest["SYSTEM_STATE"]["session"])

    @property
    def challenge(self):
        return int(self.latest["SESSION_STATE"]["challenge"])

    @property
    def accepted(self):
        return bool(self.latest["SESSION_STATE"]["host_accepted"])

    @property
    def blockers(self):
        bits = int(self.latest["SESSION_STATE"]["blockers"])
        return {name for bit, name in _BLOCKERS.items() if bits & bit}

    @property
    def speeds(self):
        speed = self.latest["WHEEL_SPEED"]
        return speed["left_speed"], speed["right_speed"]

    @property
    def fast(self):
        """Speed of the faster wheel where wheels turn, rad/s: 1.5, or as fast as the robot can."""
        return min(1.5, self.limits["max_wheel_speed"])

    @property
    def speed_up_s(self):
        return self.fast / self.limits["max_wheel_acceleration"]

    @property
    def fastest(self):
        return max(map(abs, self.speeds))

    def new_session(self):
        return next(self._sessions)

    def counter(self, name):
        """The counter of the next frame of this message, which is used up."""
        self._counters[name] = (self._counters.get(name, -1) + 1) % 16
        return self._counters[name]

    def last_counter(self, name):
        """The counter of the last frame of this message."""
        return self._counters[name]

    def send(self, name, **signals):
        """Send one frame as it should be."""
        frame = CODEC.encode(name, self.counter(name), **signals)
        if self.prover is not None and self.proves and name in PROVED:
            if not self.prover.ready:
                return
            self.end.send(*self.prover.prove(frame))
        self.end.send(*frame)

    def hello(self, **changes):
        ours = {"protocol_major": PROTOCOL_MAJOR, "protocol_minor": PROTOCOL_MINOR, "dbc_hash": CODEC.dbc_hash}
        self.send("HELLO_REQUEST", **ours | changes)

    def host_state(self, request, session=0, response=None, host_fault=0):
        if response is None:
            response = challenge_answer(self.challenge, session, CODEC.dbc_hash) if request == "ARM" else 0
        self.send("HOST_STATE", request=request, session=session, challenge_answer=response, host_fault=host_fault)

    def wheel_command(self, left=0.0, right=0.0, mode="SPEED", valid_for=None, session=None):
        valid_for = self.valid_for_s if valid_for is None else valid_for
        session = session if session is not None else (self.request or {}).get("session", 0)
        self.send("WHEEL_COMMAND", mode=mode, left_speed=left, right_speed=right, valid_for=valid_for, session=session)

    def set_request(self, request, session=0, **changes):
        """Go on sending this request, beginning now."""
        self.request = {"request": request, "session": session} | changes
        self._due["request"] = 0

    def step(self):
        """Send what is due, let a millisecond pass, and take in what came."""
        now_ns = self.end.now_ns
        if self.request is not None and now_ns >= self._due["request"]:
            self._due["request"] = now_ns + STATE_PERIOD_NS
            self.host_state(**self.request)
        if self.command is not None and now_ns >= self._due["command"]:
            self._due["command"] = now_ns + COMMAND_PERIOD_NS
            self.wheel_command(**self.command)
        for t_ns, can_id, data in self.end.step():
            decoded = CODEC.decode(can_id, data)
            if not isinstance(decoded, Decoded):
                self.damaged += 1
                continue
            self.received.append((t_ns, decoded))
            self.latest[decoded.name] = decoded.values
            if decoded.name == "LIMITS":
                self.limits.update(decoded.values)
            elif decoded.name == "MAC_CHALLENGE" and self.prover is not None:
                self.prover.challenge(int(decoded.values["nonce"]))

    def run(self, seconds):
        end_ns = self.end.now_ns + round(seconds * 1e9)
        while self.end.now_ns < end_ns:
            self.step()

    def wait_for(self, what, holds, within_s=3.0):
        """Run until something holds; return how long that took in seconds; fail the test if it takes too long."""
        start_ns = self.end.now_ns
        while not holds():
            passed_s = (self.end.now_ns - start_ns) * 1e-9
            last_states = {name: self.latest.get(name) for name in ("SYSTEM_STATE", "SESSION_STATE")}
            assert passed_s < within_s, f"no {what} within {within_s} s; the robot said {last_states}"
            self.step()
        return (self.end.now_ns - start_ns) * 1e-9

    def wait_for_state(self, *states, within_s=3.0):
        return self.wait_for(" or ".join(states), lambda: self.state in states, within_s)

    def messages(self, name):
        """Return what was received of one message since `received` was cleared: (time in ns, decoded)."""
        return [(t_ns, decoded) for t_ns, decoded in self.received if decoded.name == name]

    def restart(self):
        """Have the controller restarted; return the time (ns) at which it was seen to be there again."""
        self.request = self.command = None
        before_us = self._device_ahead_us()
        self.end.restart()
        self.end.wait_until_up()
        self.end.step()
        for kept in (self.latest, self.limits, self.received):
            kept.clear()
        expected = {"HELLO", "SYSTEM_STATE", "SESSION_STATE"} | (
            {"MAC_CHALLENGE"} if self.prover is not None else set()
        )
        self.wait_for("word from the restarted controller", lambda: expected <= self.latest.keys(), 10.0)
        apart_us = (self._device_ahead_us() - before_us + 2**39) % 2**40 - 2**39
        assert abs(apart_us) > 100_000, "its clock went on as if nothing had happened: was it restarted?"
        assert (self.accepted, self.session) == (False, 0), "it knows a host or a session before any has come"
        return self.end.now_ns

    def _device_ahead_us(self):
        """How far the robot's clock is ahead of this host's."""
        _, _, device_us = self.request_time(self.end.now_ns // 1_000_000 % 256)
        return device_us - self.end.now_ns // 1000

    def request_time(self, sequence):
        """Ask for the controller's time; return when that was sent and when it was answered (ns), and the time (us)."""
        self.latest.pop("TIME_RESPONSE", None)
        sent_ns = self.end.now_ns
        self.send("TIME_REQUEST", sequence=sequence)
        self.wait_for("TIME_RESPONSE", lambda: self.latest.get("TIME_RESPONSE", {}).get("sequence") == sequence)
        received_ns, response = self.messages("TIME_RESPONSE")[-1]
        return sent_ns, received_ns, int(response.values["receive_time"])

    def request_parameter(self, operation, key, value=0.0):
        """Read or write a parameter; return the status and the value of the answer."""
        self.latest.pop("PARAM_RESPONSE", None)
        self.send("PARAM_REQUEST", operation=operation, key=key, value=value)
        self.wait_for("PARAM_RESPONSE", lambda: "PARAM_RESPONSE" in self.latest)
        return self._choice("PARAM_RESPONSE", "status"), self.latest["PARAM_RESPONSE"]["value"]

    @contextlib.contextmanager
    def recorded(self):
        """Give a list to which what is sent within the block is added: (time in ns, CAN id, data)."""
        sent, send = [], self.end.send

        def record(can_id, data):
            sent.append((self.end.now_ns, can_id, data))
            send(can_id, data)

        self.end.send = record
        try:
            yield sent
        finally:
            self.end.send = send

    def settle(self):
        """Bring the robot to STANDBY, accepted, still, without fault or emergency stop, whatever was before."""
        self.proves, self.command = True, None
        self.set_request("STANDBY")
        self.wait_for("SYSTEM_STATE and SESSION_STATE", lambda: {"SYSTEM_STATE", "SESSION_STATE"} <= self.latest.keys())
        if not self.accepted or len(self.limits) < 6 or (self.prover is not None and not self.prover.ready):
            self.hello()
        for _ in range(4):
            if self.state in ("ESTOP", "FAULT"):
                self.run(0.6)
                self.set_request("RESET")
                self.run(0.4)
                self.set_request("STANDBY")
            self.run(0.1)
            if self.state == "STANDBY" and self.accepted and len(self.limits) >= 6:
                break
            self.run(0.4)
        assert self.state == "STANDBY", f"the robot stays in {self.state}: {self.fault}, {self.blockers}"
        assert self.accepted
        # SYSTEM_STATE comes at 10 Hz: let it tell of all that went before.
        self.run(0.12)
        self.received.clear()

    def to_ready(self):
        """Open a new session; return its number."""
        session = self.new_session()
        self.set_request("READY", session)
        self.wait_for_state("READY")
        return session

    def to_armed(self):
        session = self.to_ready()
        self.command = {}
        self.run(0.2)
        self.set_request("ARM", session)
        self.wait_for_state("ARMED")
        return session

    def to_driving(self):
        session = self.to_armed()
        left, right = self.fast, self.fast / 1.5
        self.command = {"left": left, "right": right}
        at_speed = lambda: self.speeds[0] > 0.8 * left and self.speeds[1] > 0.8 * right  # noqa: E731
        self.wait_for("wheels at speed", at_speed, 3.0 + self.speed_up_s)
        return session

    def _choice(self, message, signal):
        values = self.latest.get(message)
        return CODEC.choice_name(message, signal, values[signal]) if values is not None else None
