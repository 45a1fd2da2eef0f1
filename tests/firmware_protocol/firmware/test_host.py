"""Handshake, requests, sessions and challenges."""

import dataclasses
import itertools

import pytest

from firmware_protocol.firmware_core import FirmwareCore
from firmware_protocol.protection import challenge_answer
from tests.firmware_protocol.bench import CODEC, CONFIG, FAULTS, MS, STATIONARY, Bench, sealed
from tests.tables import thinned


def test_without_a_handshake_nothing_gets_ready(bench):
    assert bench.set_request("READY").run(500).state == "STANDBY"
    assert bench.blockers() == {"HANDSHAKE", "CHALLENGE", "ZERO_COMMANDS"}


def test_another_dbc_is_refused_and_named_and_the_right_one_accepted_afterwards():
    bench = Bench().hello(dbc_hash=CODEC.dbc_hash ^ 1)
    assert bench.set_request("READY").run(300).state == "STANDBY"
    assert bench.out.fault == FAULTS["DBC_HASH_MISMATCH"]
    assert {"HANDSHAKE", "FAULT"} <= bench.blockers()
    assert bench.core.rejections["HANDSHAKE"] == 1
    assert bench.messages("BUILD")[-1].values["dbc_hash"] == CODEC.dbc_hash
    assert bench.hello().run_until("READY").fault == FAULTS["NONE"]


def test_another_dbc_stops_motion():
    bench = Bench.driving()
    bench.hello(dbc_hash=1).run(2)
    assert (bench.out.state, bench.out.stop_cause) == ("STOPPING", "FAULT")


@pytest.mark.parametrize("major", [0, 2, 255])
def test_a_host_of_another_major_is_heard_refused_and_answered(major, bench):
    bench.run(100)
    before = len(bench.messages("HELLO"))
    bench.hello(protocol_major=major)
    assert bench.set_request("READY").run(300).state == "STANDBY"
    assert bench.out.fault == FAULTS["PROTOCOL_MAJOR_MISMATCH"]
    assert len(bench.messages("HELLO")) == before + 1


def test_firmware_of_another_major_is_understood_as_such_and_nothing_else_of_it_is():
    core = FirmwareCore(dataclasses.replace(CONFIG, protocol_major=2))
    core.step(1000, STATIONARY)
    decoded = {can_id: CODEC.decode(can_id, data) for can_id, data in core.drain()}
    assert decoded.pop(0x140).values["protocol_major"] == 2
    assert {fault.reason.value for fault in decoded.values()} == {"crc"}


def test_another_minor_is_accepted():
    bench = Bench().hello(protocol_minor=9)
    bench.step()
    assert "HANDSHAKE" not in bench.blockers()


def test_a_host_silent_for_long_must_introduce_itself_again():
    bench = Bench().hello()
    bench.run(5000)
    assert "HANDSHAKE" not in bench.blockers()
    bench.step()
    assert "HANDSHAKE" in bench.blockers()


@pytest.mark.parametrize("wrong", [{"protocol_major": 2}, {"dbc_hash": 1}])
def test_a_refused_host_is_forgotten_too(wrong):
    bench = Bench().hello(**wrong)
    assert bench.run(5000).fault != 0
    assert bench.run(502).fault == 0


def test_any_sound_frame_keeps_the_acquaintance():
    bench = Bench().hello()
    bench.run(4000)
    bench.send("TIME_REQUEST", sequence=1)
    bench.run(4000)
    assert "HANDSHAKE" not in bench.blockers()


def test_host_state_counts_only_once_qualified():
    bench = Bench().hello()
    for _ in range(3):
        bench.host_state(request="READY", session=7)
        assert bench.step().state == "STANDBY"
    bench.host_state(request="READY", session=7)
    assert bench.step().state == "READY"


def test_unknown_request_changes_nothing():
    bench = Bench.driving()
    bench.host_state(request=4, session=7)
    assert bench.run(2).state == "ARMED"
    assert bench.core.rejections["MODE"] == 1


def test_wrong_crc_and_repeated_host_states_are_not_used():
    bench = Bench.driving()
    body = CODEC.encode(
        "HOST_STATE", bench.counters["HOST_STATE"] + 1, request="STANDBY", session=7, challenge_answer=0, host_fault=0
    ).data
    bench.core.receive(bench.now_us, 0x101, bytes((body[0] ^ 1,)) + body[1:])
    bench.counters["HOST_STATE"] -= 1
    bench.host_state(request="STANDBY", session=7)
    assert bench.run(2).state == "ARMED"


def test_a_host_that_babbles_is_disqualified_and_motion_stops():
    bench = Bench.driving()
    for _ in range(5):
        bench.core.receive(bench.now_us, 0x101, sealed(0x101, bytes(7), major=3))
    bench.run(2)
    assert (bench.out.state, bench.out.stop_cause) == ("STOPPING", "E2E_DISQUALIFIED")


def test_a_session_dies_with_the_stop_and_it_never_arms_again_by_itself():
    bench = Bench.driving()
    command, bench.command = bench.command, None
    assert bench.out.session == 7
    assert bench.run_until("STOPPING").session == 0
    bench.run_until("STANDBY")
    bench.command = command
    for request in ("ARM", "READY", "ARM"):
        assert bench.set_request(request).run(1000).state == "STANDBY"
    bench.command = {}
    assert bench.run(1000).state == "STANDBY"


def test_a_new_session_in_ready_goes_through_standby_with_a_new_challenge():
    bench = Bench.ready(session=7)
    challenge = bench.core.challenge
    bench.set_request("READY", session=8).run(60)
    assert (bench.out.state, bench.out.session) == ("READY", 8)
    assert bench.core.challenge != challenge


def challenges(bench, sessions):
    """The challenges from now on, as these sessions are opened and closed."""
    seen = [bench.core.challenge]
    for session in sessions:
        for request in ("READY", "STANDBY"):
            bench.set_request(request, session).run_until(request)
            seen.append(bench.core.challenge)
    return seen


def test_every_entry_of_standby_and_ready_has_a_new_challenge_never_zero(bench):
    seen = challenges(bench.hello(), range(1, 60))
    assert all(a != b for a, b in itertools.pairwise(seen))
    assert len(set(seen)) > 110
    assert 0 not in seen


@thinned(("sessions", "most_alike"), [(5, 17), (10, 69)], quick=1)
def test_a_counted_start_gives_none_of_the_challenges_of_the_starts_before(sessions, most_alike):
    """Two for each session of a hundred starts: as few are alike as of numbers drawn at random from 65535."""
    seen = []
    for start in range(1, 101):
        bench = Bench(entropy=start, last_entropy=start - 1).hello()
        seen += challenges(bench, range(1, 1 + sessions))[1:]
    assert len(seen) - len(set(seen)) <= most_alike, "of 2000 thirty are expected, of 1000 eight"


@pytest.mark.parametrize(("entropy", "last_entropy"), [(0, 0), (0, 5), (5, 5), (2**64 - 1, 2**64 - 1)])
def test_a_start_without_entropy_or_with_that_of_the_last_one_is_refused_for_good(entropy, last_entropy):
    bench = Bench(entropy=entropy, last_entropy=last_entropy).hello()
    assert bench.set_request("READY").run(200).state == "FAULT"
    assert bench.out.fault == FAULTS["ENTROPY_INVALID"]
    bench.set_request("RESET").run(800)
    assert (bench.out.state, bench.out.driver_enabled) == ("FAULT", False)


@pytest.mark.parametrize(("entropy", "last_entropy"), [(1, 0), (5, 6), (2**32, 0), (2**32, 2**33)])
def test_a_start_with_entropy_of_its_own_is_taken(entropy, last_entropy):
    assert Bench(entropy=entropy, last_entropy=last_entropy).to_armed().out.state == "ARMED"


@pytest.mark.parametrize(
    ("entropy", "outputs"),
    [
        (1234567, (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431)),
        (2**64 - 1, (0xE4D971771B652C20, 0xE99FF867DBF682C9, 0x382FF84CB27281E9, 0x6D1DB36CCBA982D2)),
    ],
)
def test_challenges_are_the_upper_sixteen_bits_of_splitmix64(entropy, outputs):
    """Its published first outputs for the seed 1234567; those for 2^64 - 1 from an implementation in Python."""
    bench = Bench(entropy=entropy).hello()
    seen = challenges(bench, (7, 8))
    assert seen[:4] == [output >> 48 for output in outputs]


def test_challenges_depend_on_the_entropy():
    seen = {Bench(entropy=seed).core.challenge for seed in range(1, 51)}
    assert len(seen) > 45
    for bit in range(16):
        assert {challenge >> bit & 1 for challenge in seen} == {0, 1}


@pytest.mark.parametrize("entry", [1, 2])
def test_a_hash_of_zero_is_passed_over(entry):
    """The hash is SplitMix64, undone here; this entropy makes its upper 16 bits zero at the given entry."""
    value = 5
    for factor, shift in ((0x94D049BB133111EB, 27), (0xBF58476D1CE4E5B9, 30)):
        value = value * pow(factor, -1, 2**64) % 2**64
        value ^= value >> shift ^ value >> 2 * shift
    bench = Bench(entropy=(value - entry * 0x9E3779B97F4A7C15) % 2**64)
    first = bench.core.challenge
    bench.to_ready()
    assert 0 not in {first, bench.core.challenge}


def test_arming_another_session_than_the_one_that_is_ready_starts_over():
    bench = Bench.ready(session=7)
    bench.set_request("ARM", session=8)
    bench.command = {}
    bench.run(400)
    assert (bench.out.state, bench.out.session) == ("STANDBY", 0)
    assert bench.core.rejections["CHALLENGE"] == 0


def arm_with(respond):
    bench = Bench.ready()
    bench.command, bench.answers = {}, False
    bench.set_request("ARM", challenge_answer=respond(bench.core.challenge)).run(400)
    return bench


def test_right_answer_arms():
    assert arm_with(lambda challenge: challenge_answer(challenge, 7, CODEC.dbc_hash)).out.state == "ARMED"


@pytest.mark.parametrize(
    "respond",
    [
        lambda challenge: 0,
        lambda challenge: challenge,
        lambda challenge: challenge_answer(challenge, 8, CODEC.dbc_hash),
        lambda challenge: challenge_answer(challenge, 7, CODEC.dbc_hash ^ 1),
        lambda challenge: challenge_answer(challenge ^ 1, 7, CODEC.dbc_hash),
    ],
)
def test_wrong_answer_does_not(respond):
    bench = arm_with(respond)
    assert bench.out.state == "READY"
    assert bench.core.rejections["CHALLENGE"] > 0
    assert bench.blockers() == {"CHALLENGE"}


def test_the_answer_to_an_old_challenge_does_not_arm():
    bench = Bench.ready(session=7)
    old = challenge_answer(bench.core.challenge, 9, CODEC.dbc_hash)
    assert bench.set_request("READY", session=9).run(60).session == 9
    bench.command, bench.answers = {}, False
    assert bench.set_request("ARM", session=9, challenge_answer=old).run(400).state == "READY"


def test_answer_given_in_standby_is_no_answer():
    bench = Bench().hello()
    bench.command = {}
    assert bench.set_request("ARM").run(400).state == "STANDBY"
    bench.answers = False
    bench.set_request("READY").run_until("READY")
    assert bench.set_request("ARM").run(300).state == "READY"


def test_arming_waits_for_wheels_below_the_speed_of_stillness():
    bench = Bench.ready(config=dataclasses.replace(CONFIG, still_speed_rad_s=0.0625))
    bench.wheels_follow = False
    bench.speeds = [0.0, -0.0625]
    bench.command = {}
    assert bench.set_request("ARM").run(400).state == "READY"
    assert bench.blockers() == {"WHEELS_MOVING"}
    bench.speeds = [0.0, -0.0624]
    assert bench.run(2).state == "ARMED"
    assert bench.out.blockers == 0


def estopped(rolling=False):
    bench = Bench.driving()
    bench.core.receive(bench.now_us, 0x080, b"")
    bench.command = None
    assert bench.set_request("ARM").run(800).state == "ESTOP"
    if rolling:
        bench.wheels_follow = False
        bench.speeds = [1.0, 1.0]
    return bench


def test_reset_clears_an_estop_but_starts_nothing():
    bench = estopped()
    bench.set_request("RESET").run_until("STANDBY")
    bench.command = {"left": 1.0, "right": 1.0}
    bench.set_request("ARM")
    for _ in range(1000):
        assert bench.step().state == "STANDBY"
        assert not bench.out.driver_enabled


def test_a_reset_asked_for_before_the_stop_does_not_clear_it(bench):
    bench.set_request("RESET").run(300)
    bench.core.receive(bench.now_us, 0x080, b"")
    assert bench.run(1500).state == "ESTOP"
    bench.set_request("STANDBY").run(100)
    assert bench.set_request("RESET").run(60).state == "STANDBY"


def test_a_reset_that_was_asked_for_before_a_silence_does_not_clear_what_came_in_it(bench):
    bench.set_request("RESET").run(300)
    bench.request = None
    bench.run(300)
    bench.core.receive(bench.now_us, 0x080, b"")
    bench.run(700)
    assert bench.set_request("RESET").run(1000).state == "ESTOP"


def test_a_reset_waits_for_stillness_and_is_void_when_the_stop_comes_again():
    bench = estopped(rolling=True)
    assert bench.set_request("RESET").run(300).state == "ESTOP"
    bench.core.receive(bench.now_us, 0x080, b"")
    bench.speeds = [0.0, 0.0]
    assert bench.run(1000).state == "ESTOP"


def test_a_reset_is_void_once_another_request_comes():
    bench = estopped(rolling=True)
    bench.set_request("RESET").run(100)
    bench.set_request("STANDBY").run(700)
    bench.speeds = [0.0, 0.0]
    assert bench.run(300).state == "ESTOP"


@pytest.mark.parametrize(("silent_ms", "state"), [(500, "STANDBY"), (501, "ESTOP"), (700, "ESTOP")])
def test_a_reset_is_asked_for_until_the_host_is_silent_and_no_longer(silent_ms, state):
    bench = estopped(rolling=True)
    bench.set_request("RESET").run(50 - bench.now_us // MS % 50)
    bench.request = None
    assert bench.run(silent_ms - 1).state == "ESTOP"
    bench.speeds = [0.0, 0.0]
    assert bench.step().state == state
    assert bench.run(300).state == state


@pytest.mark.parametrize("source", ["estop_button", "estop_line"])
def test_a_pressed_button_cannot_be_reset_nor_does_its_release_reset(source):
    bench = Bench.driving()
    bench.inputs[source] = True
    bench.run(700)
    assert (bench.out.state, bench.out.estop_source) == ("ESTOP", source.removeprefix("estop_").upper())
    assert "ESTOP" in bench.blockers()
    bench.command = None
    bench.run(600)
    challenge = bench.core.challenge
    assert bench.set_request("RESET").run(700).state == "ESTOP"
    # A challenge is renewed on the way through STANDBY, be it between two cycles.
    assert bench.core.challenge == challenge
    bench.inputs.clear()
    assert bench.run(1000).state == "ESTOP"
    bench.set_request("STANDBY").run(100)
    assert bench.set_request("RESET").run_until("STANDBY", within_ms=60).estop_source == "NONE"


def test_motion_asked_for_delays_a_reset():
    bench = estopped()
    bench.command = {"left": 0.002, "right": 0.0, "session": 7}
    assert bench.set_request("RESET").run(1000).state == "ESTOP"
    start = bench.now_us
    bench.command = None
    bench.wheel_command(0.002, 0.0, session=7)
    bench.run_until("STANDBY")
    assert bench.now_us - start == 500_000


def test_the_first_source_of_an_estop_is_kept():
    bench = estopped()
    bench.inputs["estop_button"] = True
    assert bench.step().estop_source == "FRAME"


def test_host_fault_blocks_ready():
    bench = Bench().hello()
    assert bench.set_request("READY", host_fault=5).run(300).state == "STANDBY"
    assert "HOST_STATE" in bench.blockers()


def test_silent_host_loses_ready():
    bench = Bench.ready()
    last = bench.now_us
    bench.request = None
    bench.run_until("STANDBY")
    assert bench.now_us - last == 501_000
    assert "HOST_STATE" in bench.blockers()
