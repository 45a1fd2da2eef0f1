"""What every controller that speaks this protocol must do, seen through its frames alone: inherit it, say who answers.

Tests marked `motion` turn the wheels, at 1.5 rad/s at most.
"""

import math
from itertools import pairwise

import pytest

from drivers.device_clock import MAX_SKEW
from firmware_protocol.codec import PROTOCOL
from firmware_protocol.protection import Prover
from tests.firmware_protocol.protocol_host import CODEC, ProtocolHost

NEVER_CYCLIC = {"HELLO", "BUILD", "LIMITS", "TIME_RESPONSE", "PARAM_RESPONSE", "POSE_POSITION", "POSE_HEADING"}
OPTIONAL = {"MOTOR": 2 | 4, "POWER": 8}
PERIODS_S = {
    message.name: message.period_s
    for message in PROTOCOL.messages
    if message.sender == "ROBOT" and message.period_s and message.name not in NEVER_CYCLIC
}
STANDSTILL_RAD_S = 0.05
CLOCK_S = 5.0
HELLO = CODEC.encode("HELLO_REQUEST", 0, protocol_major=1, protocol_minor=0, dbc_hash=1)


def damaged(data, place):
    """Turn a bit of the byte at a place."""
    return data[:place] + bytes((data[place] ^ 0x10,)) + data[place + 1 :]


class FirmwareConformance:
    """The suite; `key` is that of authenticated mode. A class talks to one robot; tests marked `restart` restart it."""

    key: bytes | None = None

    @classmethod
    def create_end(cls, config):
        """Return who answers; `config` is pytest's."""
        raise AssertionError("say who answers")

    @pytest.fixture(scope="class")
    @classmethod
    def talk(cls, request):
        end = cls.create_end(request.config)
        yield ProtocolHost(end, cls.key, first_session=end.now_ns // 1000 % 255)
        end.close()

    @pytest.fixture
    def host(self, talk):
        talk.settle()
        return talk

    @pytest.fixture
    def locked(self, host):
        """Return the host of a robot in authenticated mode."""
        if self.key is None:
            pytest.skip("no key")
        return host

    @pytest.fixture
    def slack_s(self, talk):
        return talk.end.slack_s

    # What it says of itself.

    def test_introduces_itself_when_asked(self, host):
        host.hello()
        host.run(0.2)
        hello, build = host.messages("HELLO")[-1][1].values, host.messages("BUILD")[-1][1].values
        assert (hello["protocol_major"], build["dbc_hash"]) == (PROTOCOL.major, PROTOCOL.dbc_hash)
        assert {int(decoded.values["page"]) for _, decoded in host.messages("LIMITS")} == {0, 1}
        assert all(value > 0 for name, value in host.limits.items() if name != "page"), host.limits
        assert host.limits["drive_off_timeout"] >= host.limits["command_timeout"]
        assert bool(int(hello["capabilities"]) & 64) == (self.key is not None), "both ends have a key, or neither"

    def test_answers_a_flood_of_requests_at_most_every_20_ms(self, host):
        for _ in range(100):
            host.hello()
            host.step()
        host.run(0.1)
        assert 1 <= len(host.messages("HELLO")) <= (0.2 + 2 * host.end.slack_s) / 0.02 + 2

    def test_telemetry_comes_at_its_periods_with_counters_in_order(self, host):
        host.run(2.1)
        capabilities = int(host.latest["HELLO"]["capabilities"])
        for name, period_s in PERIODS_S.items():
            if not capabilities & OPTIONAL.get(name, 255) or (name == "MAC_CHALLENGE" and self.key is None):
                continue
            frames = host.messages(name)
            assert 0.8 * 2.1 / period_s - 1 <= len(frames) <= 1.25 * 2.1 / period_s + 2, name
            counters = [decoded.counter for _, decoded in frames]
            assert all((after - before) % 16 == 1 for before, after in pairwise(counters)), name
        assert host.damaged == 0

    def test_speed_and_ticks_of_one_sample_share_their_counter(self, host):
        host.run(0.5)
        speeds = [decoded.counter for _, decoded in host.messages("WHEEL_SPEED")]
        ticks = [decoded.counter for _, decoded in host.messages("WHEEL_TICKS")]
        assert speeds[: len(ticks)] == ticks[: len(speeds)] or speeds[1:][: len(ticks)] == ticks[: len(speeds) - 1]

    def test_the_clock_answers_and_keeps_time(self, host):
        def quickest(sequences):
            """Half the round trip (ns), middle (ns) and device time (us) of the best of some exchanges."""
            exchanges = []
            for sequence in sequences:
                sent_ns, received_ns, device_us = host.request_time(sequence)
                half_ns = (received_ns - sent_ns) / 2
                exchanges.append((half_ns, sent_ns + half_ns, device_us))
                host.run(0.02)
            return min(exchanges)

        first_half_ns, first_ns, first_us = quickest(range(5))
        host.run(CLOCK_S)
        second_half_ns, second_ns, second_us = quickest(range(200, 205))
        passed_us = (second_ns - first_ns) / 1000
        ahead_us = (second_us - first_us) % 2**40 - passed_us
        unsure_us = (first_half_ns + second_half_ns) / 1000 + 1
        assert abs(ahead_us) <= MAX_SKEW * passed_us + unsure_us, (
            f"the clock is {ahead_us / passed_us * 1e6:.0f} ppm off, {unsure_us / passed_us * 1e6:.0f} of them unsure; "
            f"{MAX_SKEW * 1e6:.0f} are allowed: it needs a crystal"
        )

    def test_samples_are_stamped_with_that_clock(self, host, slack_s):
        _, _, device_us = host.request_time(99)
        host.run(0.02 + slack_s)
        behind_us = (host.latest["WHEEL_SPEED"]["sample_time"] - device_us) % (65536 * 20)
        assert behind_us < (0.05 + 2 * slack_s) * 1e6

    # What it refuses.

    @pytest.mark.parametrize(
        ("frames", "reason"),
        [
            ([(HELLO.can_id, damaged(HELLO.data, place)) for place in range(1, 8)], "CRC"),
            ([(0x101, bytes(length)) for length in range(8)], "LENGTH"),
        ],
        ids=["damaged", "wrong length"],
    )
    def test_frames_that_are_not_sound_are_counted_and_change_nothing(self, host, frames, reason):
        before = host.rejected
        for frame in frames:
            host.end.send(*frame)
        host.run(0.25)
        assert ((host.rejected - before) % 256, host.reject_reason) == (len(frames), reason)
        assert (host.state, host.accepted, host.fault) == ("STANDBY", True, "NONE")

    def test_frames_that_are_not_for_it_are_not_its_business(self, host):
        before = host.rejected
        for can_id in (0x081, 0x0FF, 0x110, 0x130, 0x7FF):
            host.end.send(can_id, bytes(8))
        host.run(0.25)
        assert (host.rejected, host.state) == (before, "STANDBY")

    @pytest.mark.parametrize(
        ("changes", "fault"),
        [
            ({"dbc_hash": PROTOCOL.dbc_hash ^ 1}, "DBC_HASH_MISMATCH"),
            ({"protocol_major": 99}, "PROTOCOL_MAJOR_MISMATCH"),
        ],
    )
    def test_a_host_of_another_protocol_is_refused_until_one_of_its_own_comes(self, host, changes, fault):
        host.hello(**changes)
        host.wait_for(fault, lambda: host.fault == fault and not host.accepted)
        host.set_request("READY", host.new_session())
        host.run(0.5)
        assert host.state == "STANDBY"
        assert {"FAULT", "HANDSHAKE"} <= host.blockers
        host.hello()
        host.wait_for("READY with the right protocol", lambda: host.state == "READY" and host.fault == "NONE")

    def test_parameters_can_be_read_and_nonsense_is_refused(self, host):
        status, speed = host.request_parameter("READ", key=5)
        assert (status, speed) == ("OK", pytest.approx(host.limits["max_wheel_speed"], abs=0.002))
        assert host.request_parameter("READ", key=999)[0] == "UNKNOWN_KEY"
        assert host.request_parameter("WRITE", key=5, value=1e6)[0] == "READ_ONLY"
        assert host.request_parameter("WRITE", key=4, value=1e6)[0] == "OUT_OF_RANGE"
        assert host.request_parameter(7, key=5)[0] == "UNKNOWN_OPERATION"
        assert host.request_parameter("READ", key=5) == ("OK", speed)

    # Sessions.

    def test_ready_opens_a_session_with_a_new_challenge_and_standby_closes_it(self, host):
        before = host.challenge
        session = host.to_ready()
        host.wait_for("the session", lambda: host.session == session and host.challenge not in (0, before))
        host.set_request("STANDBY")
        host.wait_for("STANDBY", lambda: (host.state, host.session) == ("STANDBY", 0))

    @pytest.mark.parametrize("which", ["none", "the last one"])
    def test_a_session_needs_a_number_that_is_new(self, host, which):
        used = host.to_ready()
        host.set_request("STANDBY")
        host.wait_for_state("STANDBY")
        host.set_request("READY", 0 if which == "none" else used)
        host.run(0.5)
        assert host.state == "STANDBY"
        assert "SESSION" in host.blockers

    def test_ready_is_given_up_when_the_host_falls_silent(self, host, slack_s):
        host.to_ready()
        host.request = None
        assert host.wait_for_state("STANDBY", within_s=2.5) <= 2.0 + slack_s

    def test_commands_for_motion_are_refused_before_arming(self, host):
        session = host.to_ready()
        for _ in range(15):
            host.wheel_command(1.0, 1.0, session=session)
            host.run(0.02)
        host.run(0.15)
        assert host.reject_reason == "NONZERO_BEFORE_ARMED"
        assert host.state == "READY"
        assert host.fastest < STANDSTILL_RAD_S

    def test_it_tells_the_counter_of_the_last_command_that_it_took(self, host):
        """By which the host sees how late the robot is with them."""
        session = host.to_ready()
        for wheel_speed, is_accepted in ((0.0, True), (1.0, False)):
            for _ in range(10):
                host.wheel_command(wheel_speed, wheel_speed, session=session)
                host.run(0.02)
                if is_accepted:
                    last = host.last_counter("WHEEL_COMMAND")
            host.run(0.15)
            assert host.latest["SYSTEM_STATE"]["last_command_counter"] == last

    def test_no_arming_without_zero_commands(self, host):
        session = host.to_ready()
        host.set_request("ARM", session)
        host.run(1.0)
        assert host.state == "READY"
        assert "ZERO_COMMANDS" in host.blockers

    def test_no_arming_with_a_wrong_answer_to_the_challenge(self, host):
        session = host.to_ready()
        host.command = {}
        host.run(0.3)
        host.set_request("ARM", session, response=0)
        host.run(0.7)
        assert host.state == "READY"
        assert host.reject_reason == "CHALLENGE"
        assert "CHALLENGE" in host.blockers

    def test_repeated_and_jumping_counters_are_refused(self, host):
        host.run(0.3)
        state = {"request": "STANDBY", "session": 0, "challenge_answer": 0, "host_fault": 0}
        before = host.rejected
        host._counters["HOST_STATE"] -= 1
        host.send("HOST_STATE", **state)
        host.run(0.02)
        host.wait_for("REPEATED", lambda: host.reject_reason == "REPEATED", 0.5)
        host._counters["HOST_STATE"] += 6
        host.send("HOST_STATE", **state)
        host.wait_for("SEQUENCE", lambda: host.reject_reason == "SEQUENCE", 0.5)
        assert (host.rejected - before) % 256 >= 2

    # Stops.

    @pytest.mark.parametrize("length", [0, 1, 8])
    def test_the_emergency_stop_latches_whatever_its_length(self, host, slack_s, length):
        host.end.send(0x080, b"\xa5" * length)
        assert host.wait_for_state("ESTOP", within_s=1.0) <= 0.1 + slack_s
        assert host.estop_source == "FRAME"
        host.set_request("READY", host.new_session())
        host.run(0.3)
        assert host.state == "ESTOP"

    def test_a_reset_that_was_already_asked_for_undoes_no_later_stop(self, host):
        host.set_request("RESET")
        host.run(0.3)
        host.end.send(0x080, b"")
        host.run(1.2)
        assert host.state == "ESTOP"
        host.set_request("STANDBY")
        host.run(0.2)
        host.set_request("RESET")
        host.wait_for_state("STANDBY")

    # Restarts.

    def challenges_after_a_restart(self, host):
        """Return the challenges of the first three sessions, and the first nonce where there is a key."""
        host.restart()
        seen = [host.latest["MAC_CHALLENGE"]["nonce"]] if self.key is not None else []
        for _ in range(3):
            host.settle()
            host.to_ready()
            host.run(0.15)
            seen.append(host.challenge)
        return seen

    @pytest.mark.restart
    def test_a_restarted_controller_has_no_session_and_other_challenges(self, host):
        first, second = self.challenges_after_a_restart(host), self.challenges_after_a_restart(host)
        assert first != second, f"after two starts it asked for the same, {first}: its entropy repeats"

    @pytest.mark.restart
    @pytest.mark.motion
    def test_a_session_recorded_after_one_restart_does_not_arm_after_the_next(self, host):
        """With a key or without: the recording answers a challenge that is not asked again."""
        first_ns = host.restart()
        with host.recorded() as sent:
            host.hello()
            host.run(0.2)
            host.to_armed()
            host.run(0.3)
        later_ns = host.restart() - first_ns
        for t_ns, can_id, data in [*sent, (sent[-1][0] + 300_000_000, None, None)]:
            while host.end.now_ns < t_ns + later_ns:
                host.step()
                assert host.state not in ("ARMED", "STOPPING"), "what was recorded has armed it: its entropy repeats"
            if can_id is not None:
                host.end.send(can_id, data)

    # With a key.

    def test_nothing_is_heard_without_proof(self, locked):
        before = locked.rejected
        locked.proves = False
        locked.set_request("READY", locked.new_session())
        locked.run(0.8)
        assert (locked.state, locked.reject_reason) == ("STANDBY", "AUTHENTICATION")
        assert locked.rejected != before

    def test_the_proof_of_another_key_is_none(self, locked):
        right = locked.prover
        locked.prover = Prover(bytes(byte ^ 1 for byte in self.key), CODEC)
        locked.prover.challenge(int(locked.latest["MAC_CHALLENGE"]["nonce"]))
        locked.set_request("READY", locked.new_session())
        locked.run(0.8)
        locked.prover = right
        assert (locked.state, locked.reject_reason) == ("STANDBY", "AUTHENTICATION")

    def test_a_proved_frame_is_heard_once(self, locked):
        locked.request = None
        standby = {"request": "STANDBY", "session": 0, "challenge_answer": 0, "host_fault": 0}
        frame = CODEC.encode("HOST_STATE", locked.counter("HOST_STATE"), **standby)
        proof = locked.prover.prove(frame)
        before = locked.rejected
        for _ in range(3):
            locked.end.send(*proof)
            locked.end.send(*frame)
            locked.run(0.01)
        locked.run(0.15)
        assert ((locked.rejected - before) % 256, locked.reject_reason) == (2, "AUTHENTICATION")

    # Motion.

    @pytest.mark.motion
    def test_armed_it_stands_until_told_and_then_follows(self, host):
        host.to_armed()
        host.run(0.5)
        assert host.fastest < STANDSTILL_RAD_S
        ticks = dict(host.latest["WHEEL_TICKS"])
        host.received.clear()
        host.command = {"left": host.fast, "right": -host.fast / 1.5}
        host.run(1.5 + host.speed_up_s)
        assert host.speeds == pytest.approx((host.fast, -host.fast / 1.5), rel=0.1, abs=0.05)
        turn = 2 * math.pi / host.limits["ticks_per_rev"]
        for side, sign in (("left", 1), ("right", -1)):
            moved = (host.latest["WHEEL_TICKS"][f"{side}_ticks"] - ticks[f"{side}_ticks"] + 2**23) % 2**24 - 2**23
            times = [t_ns for t_ns, _ in host.messages("WHEEL_SPEED")]
            speeds = [decoded.values[f"{side}_speed"] for _, decoded in host.messages("WHEEL_SPEED")]
            driven = sum(speeds) / len(speeds) * (times[-1] - times[0]) * 1e-9
            assert moved * turn == pytest.approx(driven, rel=0.1, abs=0.1)
            assert moved * sign > 0
        assert host.latest["WHEEL_SPEED"]["driver_enabled"] == 1

    def stops(self, host, cause, within_s):
        took_s = host.wait_for("stop", lambda: host.state not in ("ARMED", "READY"), within_s)
        assert host.stop_cause == cause
        host.wait_for("standing wheels", lambda: host.fastest < STANDSTILL_RAD_S, 2.0)
        host.wait_for_state("STANDBY", "ESTOP", "FAULT")
        host.run(0.5)
        assert host.fastest < STANDSTILL_RAD_S
        assert host.state != "ARMED", "nothing arms again by itself"
        return took_s

    @pytest.mark.motion
    @pytest.mark.parametrize("is_silent", [True, False], ids=["silence", "house-keeping alone"])
    def test_without_commands_it_stops_in_time(self, host, slack_s, is_silent):
        host.to_driving()
        host.command = None
        if is_silent:
            host.request = None
        assert self.stops(host, "COMMAND_TIMEOUT", 1.0) <= host.limits["command_timeout"] + slack_s
        host.run(host.limits["drive_off_timeout"])
        assert host.latest["WHEEL_SPEED"]["driver_enabled"] == 0

    @pytest.mark.motion
    def test_a_command_holds_no_longer_than_it_says(self, host, slack_s):
        host.to_driving()
        host.command = None
        host.wheel_command(host.fast, host.fast / 1.5, valid_for=0.04)
        assert self.stops(host, "COMMAND_EXPIRED", 1.0) <= 0.04 + slack_s

    @pytest.mark.motion
    def test_commands_of_another_session_are_not_obeyed(self, host):
        session = host.to_driving()
        host.command = {"left": -1.5, "right": -1.0, "session": session % 255 + 1}
        self.stops(host, "COMMAND_TIMEOUT", 1.0)

    @pytest.mark.motion
    @pytest.mark.parametrize(
        ("changes", "cause"),
        [({"request": "STANDBY"}, "REQUESTED"), ({"host_fault": 5}, "HOST_FAULT"), ({"session": 0}, "SESSION_CHANGED")],
    )
    def test_the_host_can_end_it(self, host, slack_s, changes, cause):
        session = host.to_driving()
        host.set_request(**{"request": "ARM", "session": session} | changes)
        assert self.stops(host, cause, 1.0) <= 0.05 + slack_s

    @pytest.mark.motion
    def test_a_host_that_commands_but_says_nothing_else_is_stopped(self, host):
        host.to_driving()
        host.request = None
        host.command["session"] = host.session
        self.stops(host, "HOST_SILENT", 2.5)

    @pytest.mark.motion
    def test_damaged_commands_stop_it(self, host):
        session = host.to_driving()
        signals = {"mode": "SPEED", "left_speed": 1.5, "right_speed": 1.0, "valid_for": 0.1, "session": session}
        can_id, data = CODEC.encode("WHEEL_COMMAND", 0, **signals)
        for _ in range(12):
            host.end.send(can_id, damaged(data, 0))
        self.stops(host, "E2E_DISQUALIFIED", 0.5)

    @pytest.mark.motion
    def test_the_emergency_stop_ends_motion(self, host, slack_s):
        host.to_driving()
        host.end.send(0x080, b"")
        assert self.stops(host, "ESTOP", 0.5) <= 0.02 + slack_s

    @pytest.mark.motion
    def test_what_was_sent_once_moves_nothing_when_sent_again(self, host):
        with host.recorded() as sent:
            host.to_driving()
        host.set_request("STANDBY")
        host.command = None
        host.wait_for_state("STANDBY")
        host.request = None
        host.run(0.7)
        fastest = 0.0
        for _, can_id, data in sent:
            host.end.send(can_id, data)
            host.run(0.01)
            fastest = max(fastest, host.fastest)
            assert host.state in ("STANDBY", "READY")
        assert fastest < STANDSTILL_RAD_S
