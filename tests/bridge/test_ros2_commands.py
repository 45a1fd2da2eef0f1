"""Speeds, requests and e-stops from ROS: what may move the robot, and what is refused for which reason."""

import itertools
import json
import math
import os
import random
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from disco_hw.bridge import ros2, ros2_commands
from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import LATCHED, RELIABLE, SENSOR, Bridge, TopicReaders, UnreadCounts
from disco_hw.bridge.ros2_commands import Errands, SpeedInlet, refusal
from disco_hw.config import Drive, Robot
from disco_hw.config.robot import Ros2
from disco_hw.daemon.emergency import EstopOutcome
from disco_hw.drive import PageSource, RobotView, steering_from
from disco_hw.drive.hand_pilot import Deadman
from disco_hw.drive.terminal import wheel_speeds
from disco_hw.errors import InputError, WorkError
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.runtime import State
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from tests.first_use.miswired import robot_file
from tests.tables import thinned

MONO_NS, WALL_NS = 50_000_000_000, 1_800_000_000_000_000_000
MS = 1_000_000
PARAMETERS = OdometryParameters(0.1, 0.8, 0.0)
ROBOT = Robot(
    name="r",
    wheel_radius_m=0.1,
    axial_distance_m=0.8,
    max_wheel_speed_rad_s=10.0,
    max_wheel_acceleration_rad_s2=10.0,
    ticks_per_rev=1000,
)
DRIVE = Drive(speed_share=0.5, turn_share=0.6)


def twist(speed, turn):
    return msg.Twist(msg.Vector3(speed, 0.0, 0.0), msg.Vector3(0.0, 0.0, turn))


def request_speed(inlet, speed, turn=0.0, now_ns=0, age_ns=0):
    return inlet.request(twist(speed, turn), WALL_NS + now_ns - age_ns, MONO_NS + now_ns, WALL_NS + now_ns)


@pytest.fixture
def fresh():
    """An inlet of speeds, for which nobody has asked to arm."""
    return SpeedInlet(ROBOT, DRIVE, PARAMETERS)


@pytest.fixture
def permitted(fresh):
    """An inlet whose speeds may drive, as arming was asked for while they came."""
    assert request_speed(fresh, 0.0)["held"] is False
    assert fresh.permit(MONO_NS) is None
    for _ in range(2):
        assert request_speed(fresh, 0.0)["held"] is False
    return fresh


@pytest.mark.parametrize(("speed", "turn"), [(0.2, 0.0), (0.1, 0.3), (-0.2, -0.2), (0.0, 0.4)])
def test_a_speed_becomes_the_wheel_speeds_that_make_it(permitted, speed, turn):
    request = request_speed(permitted, speed, turn)
    del request["do"]
    steering = steering_from(request)
    left, right = wheel_speeds(steering.forward, steering.left * 0.6, 5.0)
    assert 0.1 * (left + right) / 2 == pytest.approx(speed)
    assert 0.1 * (right - left) / 0.8 == pytest.approx(turn)


def test_what_is_too_fast_is_slowed_down_on_the_same_curve(permitted):
    request = request_speed(permitted, 3.0, 3.0)
    left, right = wheel_speeds(request["forward"], request["left"] * 0.6, 5.0)
    assert max(abs(left), abs(right)) <= 5.0 + 1e-9
    assert 0.1 * (right - left) / 0.8 == pytest.approx(0.1 * (left + right) / 2)


def test_speeds_drive_only_once_arming_was_asked_for_while_they_came(fresh):
    assert "no speeds" in fresh.permit(MONO_NS)
    for _ in range(5):
        assert request_speed(fresh, 0.1)["held"] is False


def test_a_silence_takes_the_permission_away(permitted):
    assert request_speed(permitted, 0.1)["held"] is True
    for _ in range(5):
        assert request_speed(permitted, 0.1, now_ns=201 * MS)["held"] is False


@pytest.mark.parametrize(("speed", "turn"), [(math.nan, 0.0), (0.1, math.inf)])
def test_a_speed_that_is_none_takes_it_away_too(permitted, speed, turn):
    assert request_speed(permitted, speed, turn) is None
    assert request_speed(permitted, 0.1)["held"] is False


@pytest.mark.parametrize("age", [210 * MS, -60 * MS, 10_000 * MS])
def test_an_old_speed_or_one_by_another_clock_is_refused(permitted, age):
    assert request_speed(permitted, 0.1, age_ns=age) is None
    stamped = msg.TwistStamped(msg.Header(msg.stamp_of(WALL_NS - age)), twist(0.1, 0.0))
    assert permitted.request(stamped, WALL_NS, MONO_NS, WALL_NS) is None


def test_the_daemons_deadman_counts_from_when_the_speed_was_sent(permitted):
    page, view = PageSource(5.0, 0.6), RobotView(State.READY, False)

    def steer(held, stamp_ns):
        command = {"forward": 0.1, "left": 0.0, "held": held, "stamp": str(stamp_ns)}
        return page.steer(MONO_NS, 1, steering_from(command))

    steer(False, MONO_NS)
    request = request_speed(permitted, 0.1, age_ns=150 * MS)
    assert request["held"]
    assert steer(True, int(request["stamp"])) is None
    assert MONO_NS - page.poll(MONO_NS, view).t_ns == 150 * MS


def sent_speeds(kind, draw, struck_ns):
    """(when it was sent, when it is heard, speed) of a node's speeds at 20 Hz, wrong in some way from a time on."""
    for step in range(80):
        sent = step * 50 * MS + draw.randrange(20 * MS)
        if sent < struck_ns or kind == "none":
            yield sent, sent + draw.randrange(5 * MS), 0.2
        elif kind == "nan":
            yield sent, sent + MS, math.nan
        elif kind == "frozen":
            # All that was kept back comes at once.
            yield sent, struck_ns + 700 * MS + step * MS, 0.2
        elif kind == "flood":
            yield from ((sent + i * MS // 2, sent + i * MS // 2 + MS, 0.2) for i in range(60))


@thinned("seed", range(10), quick=4)
@pytest.mark.parametrize("kind", ["none", "kill", "frozen", "nan", "flood"])
def test_at_random_times_a_fault_disarms_within_the_deadmans_time_and_nothing_else_does(kind, seed):
    draw = random.Random(f"{kind}{seed}")
    struck_ns = draw.randrange(1000 * MS, 2500 * MS)
    received = sorted(sent_speeds(kind, draw, struck_ns), key=lambda one: one[1])
    inlet, page, deadman = SpeedInlet(ROBOT, DRIVE, PARAMETERS), PageSource(5.0, 0.6), Deadman()
    state, armed_ns, disarmed_ns, last_good_ns = State.READY, [], [], 0
    for now in range(0, 4000 * MS, 20 * MS):
        while received and received[0][1] <= now:
            sent, at, speed = received.pop(0)
            if sent <= struck_ns or kind in ("none", "flood"):
                last_good_ns = sent
            if 300 * MS < at < 350 * MS:
                assert inlet.permit(MONO_NS + at) is None
            request = inlet.request(twist(speed, 0.0), WALL_NS + sent, MONO_NS + at, WALL_NS + at)
            if request is not None:
                del request["do"]
                page.steer(MONO_NS + now, 1, steering_from(request))
        newest = page.poll(MONO_NS + now, RobotView(state, state is State.ARMED))
        requests = deadman.step(MONO_NS + now, newest, state).requests
        if UserRequest.ARM in requests:
            state = State.ARMED
            armed_ns.append(now)
        elif UserRequest.DISARM in requests:
            state = State.READY
            disarmed_ns.append(now)
    assert len(armed_ns) == 1
    if kind in ("none", "flood"):
        # At the very end nothing is said any more.
        assert [now for now in disarmed_ns if now < last_good_ns + 200 * MS] == []
    else:
        (disarmed,) = disarmed_ns
        assert struck_ns - 50 * MS < disarmed <= last_good_ns + 200 * MS + 20 * MS


def test_of_a_flood_of_requests_a_few_are_taken_in_their_order():
    errands, go, done, finished = Errands(most=3), threading.Event(), [], threading.Event()

    def work(text):
        assert go.wait(60.0)
        done.append(text)
        if text == "2":
            finished.set()

    for number in range(50):
        errands.add(work, str(number))
    go.set()
    assert finished.wait(60.0)
    assert done == ["0", "1", "2"]
    assert errands.refused == 47
    errands.close()
    errands.close()


@pytest.mark.parametrize("action", ["estop", "stop", "disarm", "status"])
def test_stopping_is_taken_from_whoever_asks(action):
    assert refusal(action, False, 3_600_000 * MS) is None


@pytest.mark.parametrize("action", ["arm", "arm --unrecorded", "start", "reset", "task radius_m=1", "stopping", ""])
def test_what_lets_the_robot_move_is_taken_only_where_robot_toml_says_so(action):
    assert "ros2.may_move = true" in str(refusal(action, Ros2().may_move, 0))
    assert refusal(action, True, 0) is None


@pytest.mark.parametrize("action", ["arm", "start", "reset", "task radius_m=1"])
@pytest.mark.parametrize(("age_ms", "refused"), [(-1010, True), (-60, False), (990, False), (1010, True), (6000, True)])
def test_what_lets_the_robot_move_is_refused_when_it_comes_late_or_by_another_clock(action, age_ms, refused):
    assert ("sent over 1 s ago" in str(refusal(action, True, age_ms * MS))) is refused


def test_a_late_request_is_refused_with_a_reply_and_a_late_stop_is_passed_on(tmp_path, monkeypatch):
    file = robot_file(tmp_path)
    text = f"[ros2]\ndomain = {203 + os.getpid() % 8 * 4}\nmay_move = true\n"
    text += f'[daemon]\ncontrol_socket = "{tmp_path / "control"}"\n'
    file.write_text(file.read_text(encoding="utf-8") + text, encoding="utf-8")
    passed, replies = [], []
    monkeypatch.setattr(ros2_commands, "request_daemon", lambda _, request, __: passed.append(request) or {"ok": True})
    with closing(Bridge(load_setup(file))) as bridge:
        bridge._publish = lambda _, reply: replies.append(reply.data)
        for late_s in (6, 0):
            for request in ("start", "stop"):
                bridge._handle_request(msg.String(request), time.time_ns() - late_s * 1_000_000_000)
        bridge._asking._pool.shutdown()
    assert passed == ["stop", "start", "stop"]
    assert len(replies) == 4
    assert "sent over 1 s ago" in replies[0]


def test_arming_a_manual_drive_is_refused_unless_the_robot_can_be_armed(tmp_path, monkeypatch):
    file, replies, status = robot_file(tmp_path), [], {"ok": True, "detail": "e-stop; reset it", "drive": {}}
    file.write_text(file.read_text(encoding="utf-8") + "[ros2]\nmay_move = true\n", encoding="utf-8")
    monkeypatch.setattr(ros2, "send_request", lambda _, __: status)
    # Without a domain of DDS, which takes a second to join.
    bridge = Bridge.__new__(Bridge)
    bridge._config = load_setup(file).config
    bridge._speeds = SimpleNamespace(permit=lambda _: None)
    bridge._publish = lambda _, reply: replies.append(json.loads(reply.data))
    for state in State:
        status["state"] = state.name
        bridge._reply_to(time.time_ns(), "arm")
    refused = {state.name: reply["error"] for state, reply in zip(State, replies, strict=True) if not reply["ok"]}
    assert set(refused) == {"DISCONNECTED", "HANDSHAKE", "STOPPING", "FAULT"}
    assert refused["FAULT"] == "the robot is in state FAULT: e-stop; reset it"


def qualities(reliable, latched=False):
    return Qos(
        Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        # As ROS 2 has it; without, one message is kept for those who come later.
        Policy.DurabilityService(0, Policy.History.KeepLast(10), -1, -1, -1),
    )


@pytest.mark.parametrize("reliable", [True, False])
def test_over_dds_an_estop_and_requests_arrive_whatever_the_publishers_quality_of_service(tmp_path, reliable):
    file, requests, ended = robot_file(tmp_path), [], threading.Event()
    number = 200 + os.getpid() % 8 * 4 + reliable
    text = f'[ros2]\ndomain = {number}\n[daemon]\ncontrol_socket = "{tmp_path / "control"}"\n'
    file.write_text(file.read_text(encoding="utf-8") + text, encoding="utf-8")
    with closing(Bridge(load_setup(file))) as bridge:
        for errands in (bridge._asking, bridge._stopping):
            errands.add = lambda _, request: requests.append(request)
        thread = threading.Thread(target=bridge.run, args=(ended.is_set,))
        thread.start()
        ctl, estop = (
            DataWriter(bridge._participant, Topic(bridge._participant, f"rt/{name}", kind), qualities(reliable))
            for name, kind in (("disco_hw/ctl", msg.String), ("disco_hw/estop", msg.Bool))
        )
        deadline = time.monotonic() + 20.0
        while not (ctl.get_matched_subscriptions() and estop.get_matched_subscriptions()):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        estop.write(msg.Bool(True))
        for request in ("stop", "stop", "disarm", "status"):
            ctl.write(msg.String(request))
        while "status" not in requests and time.monotonic() < deadline:
            time.sleep(0.01)
        ended.set()
        thread.join()
    assert [request for request in requests if request != "estop"] == ["stop", "stop", "disarm", "status"]
    assert "estop" in requests


@pytest.mark.parametrize(
    ("written", "expected"),
    [([[True], [False]], {"estop"}), ([[False], [True]], {"estop"}), ([[True, False], [False, True, False]], set())],
)
def test_over_dds_a_latched_estop_counts_if_it_was_in_force_when_the_bridge_started(
    tmp_path, monkeypatch, request, written, expected
):
    """`written`: what each publisher sent before, oldest first."""
    number = 14 + os.getpid() % 20 * 3 + request.node.callspec.indices["written"]
    requests, ended = [], threading.Event()
    joined = Domain(number, msg.LOOPBACK), DomainParticipant(number)
    monkeypatch.setattr("disco_hw.bridge.ros2.join_domain", lambda _: joined)
    latched = qualities(reliable=True, latched=True)
    ctl = DataWriter(joined[1], Topic(joined[1], "rt/disco_hw/ctl", msg.String), latched)
    # A request is of the time at which it was made.
    ctl.write(msg.String("stop"))
    buttons = [DataWriter(joined[1], Topic(joined[1], "rt/disco_hw/estop", msg.Bool), latched) for _ in written]
    for button, pressed in zip(buttons, written, strict=True):
        for one in pressed:
            button.write(msg.Bool(one))
    with closing(Bridge(load_setup(robot_file(tmp_path)))) as bridge:
        for errands in (bridge._asking, bridge._stopping):
            errands.add = lambda _, request: requests.append(request)
        thread = threading.Thread(target=bridge.run, args=(ended.is_set,))
        thread.start()
        deadline = time.monotonic() + (20.0 if expected else 0.4)
        while not requests and time.monotonic() < deadline:
            time.sleep(0.01)
        ended.set()
        thread.join()
    assert set(requests) == expected


def test_over_dds_a_message_counts_once_also_if_its_publisher_has_gone():
    number, unread = 202 + os.getpid() % 8 * 4, UnreadCounts()
    _domain, participant = Domain(number, msg.LOOPBACK), DomainParticipant(number)
    topic = Topic(participant, "rt/button", msg.Bool)
    readers = TopicReaders(participant, topic, (LATCHED, RELIABLE, SENSOR))
    for reliable, latched, gone in itertools.product((True, False), repeat=3):
        writer = DataWriter(participant, topic, qualities(reliable, latched))
        assert readers.has_publisher()
        for pressed in (True, False, True):
            writer.write(msg.Bool(pressed))
        if gone:
            del writer
        taken = [message.data for message, _ in readers.take(10, unread)]
        assert taken == [True, False, True], (reliable, latched, gone)
    del writer
    assert not readers.has_publisher()
    assert unread == UnreadCounts()


@pytest.mark.parametrize(
    ("failure", "daemon_failed"),
    [(WorkError("no answer"), True), (InputError("robot.toml: not to be read"), False)],
    ids=["daemon", "robot.toml"],
)
def test_an_estop_goes_to_the_link_at_once_where_the_daemon_has_just_failed(monkeypatch, failure, daemon_failed):
    def fail(*_):
        raise failure

    given = []
    monkeypatch.setattr(ros2_commands, "ask", fail)
    monkeypatch.setattr(
        ros2_commands,
        "stop_robot",
        lambda *_, **options: given.append(options) or EstopOutcome("link", None, None, True),
    )
    assert ros2_commands.request_daemon(Path("robot.toml"), "estop", None)["do"] == "estop"
    assert given == [{"daemon_failed": daemon_failed}]
