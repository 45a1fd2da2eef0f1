"""The core in authenticated mode: who has not the key stops the robot and does nothing else."""

import struct
from dataclasses import replace

import pytest
from cryptography.hazmat.primitives.ciphers import algorithms
from cryptography.hazmat.primitives.cmac import CMAC

from firmware_protocol import _firmware
from firmware_protocol.firmware_core import FirmwareCore
from firmware_protocol.protection import Prover
from tests.firmware_protocol.bench import CODEC, CONFIG, Bench

lib, ffi = _firmware.lib, _firmware.ffi
KEY = bytes(range(16))
LOCKED = replace(CONFIG, key=KEY)
AUTHENTICATION = 64


def refused(bench):
    return bench.core.rejections["AUTHENTICATION"]


def driving():
    bench = Bench.driving(config=LOCKED)
    assert refused(bench) == 0
    return bench


def test_it_says_that_it_wants_proof_and_gives_a_nonce():
    bench = Bench(LOCKED)
    bench.run(250)
    assert int(bench.messages("HELLO")[0].values["capabilities"]) == CONFIG.capabilities | AUTHENTICATION
    nonces = bench.messages("MAC_CHALLENGE")
    assert len({decoded.values["nonce"] for decoded in nonces}) == 1
    assert len(nonces) == 4, "when it is drawn, and at 10 Hz"


def test_without_a_key_nothing_of_it_is_seen_and_no_nonce_is_drawn():
    bench = Bench.driving()
    assert int(bench.messages("HELLO")[0].values["capabilities"]) == CONFIG.capabilities
    assert not bench.messages("MAC_CHALLENGE")
    assert bench.core._core.authentication.draws == 0
    for can_id in (0x0F0, 0x0F1, 0x0F2):
        bench.core.receive(bench.now_us, can_id, bytes(8))
    assert bench.run(50).state == "ARMED"
    assert (refused(bench), bench.core.unknown_frames) == (0, 0)


@pytest.mark.parametrize("key", [None, bytes(16)], ids=["no key", "another key"])
def test_without_the_key_not_even_ready(key):
    bench = Bench(LOCKED)
    bench.prover = Prover(key, CODEC) if key else None
    bench.hello()
    bench.set_request("READY")
    bench.command = {}
    assert bench.run(2000).state == "STANDBY"
    assert refused(bench) > 100
    assert bench.messages("SYSTEM_STATE")[-1].values["reject_reason"] == 13
    assert {"HOST_STATE", "ZERO_COMMANDS"} <= bench.blockers()


def test_the_emergency_stop_needs_no_key_and_to_leave_it_takes_the_key():
    bench = driving()
    assert bench.estop().state == "ESTOP"
    bench.command = None
    bench.set_request("STANDBY").run(1500)
    proves, bench.prover = bench.prover, None
    assert bench.set_request("RESET").run(500).state == "ESTOP"
    bench.prover = proves
    bench.run_until("STANDBY")


def test_an_unproved_standby_neither_stops_nor_takes_a_request_back():
    """Were it heard, a reset that is being held would count as asked for anew after a later emergency stop."""
    bench = driving()
    bench.core.receive(bench.now_us, 0x080, b"")
    bench.command = None
    assert bench.set_request("RESET").run(1500).state == "STANDBY"
    bench.estop()
    counter = bench.next_counter("HOST_STATE")
    standby = {"request": "STANDBY", "session": 0, "challenge_answer": 0, "host_fault": 0}
    bench.core.receive(bench.now_us, *CODEC.encode("HOST_STATE", counter, **standby))
    assert bench.run(1500).state == "ESTOP"


def test_commands_without_proof_do_not_feed_the_watchdog():
    bench = driving()
    bench.prover = None
    assert bench.run(101).state == "STOPPING"
    assert bench.out.stop_cause == "COMMAND_TIMEOUT"


def test_a_stranger_who_shouts_neither_steers_nor_stops():
    """Well-sealed commands of the right session at full speed, three for each of the host's."""
    bench = driving()
    accepted = bench.out.accepted_commands
    for counter in range(300):
        bench.run(5)
        foreign = {"mode": "SPEED", "left_speed": -8.0, "right_speed": 8.0, "valid_for": 0.5, "session": 7}
        bench.core.receive(bench.now_us, *CODEC.encode("WHEEL_COMMAND", counter % 16, **foreign))
        assert bench.out.state == "ARMED"
        assert (bench.out.left_setpoint_rad_s, bench.out.right_setpoint_rad_s) == pytest.approx((4.0, 2.0))
    assert bench.out.accepted_commands == accepted + 75
    assert refused(bench) == 300


class RecordingCore(FirmwareCore):
    """Keeps every frame that its host sends."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.frames = []

    def receive(self, now_us, can_id, data):
        self.frames.append((can_id, data))
        super().receive(now_us, can_id, data)


def recorded_run():
    """Return a bench that has been brought to drive, and every frame that its host sent on the way."""
    bench = Bench(LOCKED)
    bench.core = RecordingCore(LOCKED, 1)
    bench.to_driving()
    return bench, list(bench.core.frames)


def replay(bench, frames):
    """Send frames again, one every 5 ms, to a robot that is to stay in STANDBY; return how many more it has refused."""
    before, accepted = refused(bench), bench.out.accepted_commands
    for can_id, data in frames:
        bench.core.receive(bench.now_us, can_id, data)
        assert bench.run(5).state == "STANDBY"
        assert not bench.out.driver_enabled
    assert bench.out.accepted_commands == accepted
    return refused(bench) - before


def test_a_recorded_run_played_to_another_start_does_nothing():
    assert replay(Bench(LOCKED, entropy=2), recorded_run()[1]) > 20


def test_a_recorded_run_played_again_later_in_the_same_start_does_nothing():
    bench, frames = recorded_run()
    bench.to_standby()
    bench.request = None
    bench.run(1000)
    assert replay(bench, frames) > 20


def test_a_frame_played_again_in_its_session_is_refused():
    bench, frames = recorded_run()
    commands = [data for can_id, data in frames if can_id == 0x100]
    proofs = [data for can_id, data in frames if can_id == 0x0F0]
    accepted = bench.out.accepted_commands
    for proof, command in zip(proofs[-3:], commands[-3:], strict=True):
        bench.core.receive(bench.now_us, 0x0F0, proof)
        bench.core.receive(bench.now_us, 0x100, command)
    assert bench.step().accepted_commands == accepted
    assert refused(bench) == 3


def test_who_holds_the_key_drives_and_the_nonce_is_new_in_every_session_and_for_every_host():
    bench = driving()
    armed = bench.prover._nonce
    bench.hello().run(100)
    assert bench.prover._nonce == armed, "none but the host's own end changes it within a session"
    assert bench.out.state == "ARMED"
    bench.to_standby()
    assert refused(bench) == 0
    bench.step()
    standby = bench.prover._nonce
    assert standby != armed
    bench.run(30)
    bench.hello().run(2)
    assert bench.prover._nonce != standby


def test_a_host_that_starts_anew_is_heard():
    bench = Bench.ready(config=LOCKED)
    bench.to_standby()
    bench.run(500)
    bench.prover = Prover(KEY, CODEC)
    bench.run(600)
    bench.hello()
    bench.set_request("READY", 9).run_until("READY")


def test_parameters_are_read_and_written_with_the_key_alone():
    bench = Bench(LOCKED)
    bench.run(5)
    write = {"operation": "WRITE", "key": 4, "value": 5.0}
    bench.core.receive(bench.now_us, *CODEC.encode("PARAM_REQUEST", 0, **write))
    bench.run(5)
    assert (bench.messages("PARAM_RESPONSE"), refused(bench)) == ([], 1)
    bench.send("PARAM_REQUEST", **write)
    bench.run(5)
    assert [decoded.values["status"] for decoded in bench.messages("PARAM_RESPONSE")] == [0]


@pytest.mark.parametrize("can_id", [0x0F0, 0x0F1, 0x0F2])
@pytest.mark.parametrize("length", [*range(8), 9])
def test_a_proof_of_wrong_length_is_refused(can_id, length):
    bench = Bench(LOCKED)
    bench.core.receive(bench.now_us, can_id, bytes(length))
    assert bench.core.rejections["LENGTH"] == 1


def test_damaged_commands_still_count_against_the_sender():
    bench = driving()
    bench.command = None
    zero = {"mode": "SPEED", "left_speed": 0.0, "right_speed": 0.0, "valid_for": 0.1, "session": 7}
    for counter in range(5):
        can_id, data = CODEC.encode("WHEEL_COMMAND", counter, **zero)
        bench.core.receive(bench.now_us, can_id, bytes((data[0] ^ 1,)) + data[1:])
    assert bench.step().stop_cause == "E2E_DISQUALIFIED"
    assert (refused(bench), bench.core.rejections["CRC"]) == (0, 5)


def test_the_nonces_are_the_draws_in_their_order_however_they_are_prepared():
    """The nonce after this one is drawn in a cycle with nothing to send, or at once where there was none."""
    entropy = 12345
    a = ffi.new("disco_authentication_t *")
    lib.disco_authentication_init(a, True, KEY, entropy)
    nonces = [bytes(a.nonce)]
    for prepares in (0, 1, 2, 0, 0, 3):
        for _ in range(prepares):
            lib.disco_authentication_prepare(a)
        lib.disco_authentication_renew(a)
        assert not a.nonce_shown
        nonces.append(bytes(a.nonce))
    cipher = [CMAC(algorithms.AES(KEY)) for _ in nonces]
    for draw, one in enumerate(cipher, start=1):
        one.update(struct.pack("<QQ", entropy, draw))
    assert nonces == [one.finalize()[:6] for one in cipher]


def test_the_next_nonce_is_drawn_in_a_cycle_with_nothing_to_send():
    bench = Bench(LOCKED)
    a = bench.core._core.authentication
    bench.to_ready()
    draws = a.draws
    bench.to_standby()
    sending = bench.messages("MAC_CHALLENGE", bench.now_us)
    assert sending
    assert (a.prepared, a.draws) == (False, draws)
    bench.run(2)
    assert (a.prepared, a.draws) == (True, draws + 1)
    bench.run(50)
    assert a.draws == draws + 1
