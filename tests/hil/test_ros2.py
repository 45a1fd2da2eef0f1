"""The stack with poses from a node of ROS 2: it drives by them, and stops when node or bridge fail it in any way."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from disco_hw.experiments import READY_TIMEOUT_S, disco_hw_process, is_stationary
from tests.hil.test_drive import Bench
from tools import stack as rig
from tools.stack import FAST_START

pytestmark = [pytest.mark.hil, pytest.mark.timeout(400)]


def domain():
    """One for each worker of the suite, so that two never hear each other."""
    return 100 + os.getpid() % 100


def with_poses_of_ros(robot_file):
    lines = f'[pose]\nsource = "ros2"\nport = {5100 + domain()}\n[ros2]\ndomain = {domain()}\nmay_move = true\n'
    robot_file.write_text(robot_file.read_text(encoding="utf-8") + lines, encoding="utf-8")
    return robot_file


@contextmanager
def node(kind, output, start=FAST_START):
    """A node in a process of its own, which is killed at the end."""
    with output.open("wb") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "tools.ros2_node", str(domain()), kind, *map(str, start)],
            stdin=subprocess.PIPE,
            stdout=sink,
            bufsize=0,
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()


@contextmanager
def stack_with_bridge(directory, monkeypatch):
    written = rig.write_robot_file
    monkeypatch.setattr(rig, "write_robot_file", lambda *given: with_poses_of_ros(written(*given)))
    with rig.running_stack(directory) as stack:
        bridge = ["bridge", "ros2", str(stack.robot_file)]
        with disco_hw_process("bridge", bridge, directory / "bridge.txt") as child:
            yield stack, child.process


@contextmanager
def bench_with_bridge(directory):
    """A robot that is driven by speeds from ROS 2; yields its operator and the bridge's process."""
    with ExitStack() as stack:
        bench = Bench(directory, stack)
        with_poses_of_ros(bench.robot_file)
        bench.drive("--ros2")
        bench.ready()
        bridge = ["bridge", "ros2", str(bench.robot_file)]
        with disco_hw_process("bridge", bridge, directory / "bridge.txt") as child:
            yield bench.operator, child.process


def is_driving(status):
    return status["drive"]["driving"] and not is_stationary(status)


def received_positions(output):
    """(x, y) of each odometry that the node heard, m."""
    rows = [line.split() for line in output.read_text(encoding="utf-8").splitlines()]
    return [(float(row[3]), float(row[4])) for row in rows if len(row) == 5]


RCLPY = Path(__file__).parents[2] / ".venv-ros" / "bin" / "python"
real_ros = pytest.mark.skipif(not RCLPY.exists(), reason="no rclpy here: make test-all installs it where it can")


@contextmanager
def real_node(output, *arguments):
    """A node of real ROS 2, with another DDS than ours, which is killed at the end."""
    ros = {"ROS_DOMAIN_ID": str(domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    script = Path(__file__).parents[1] / "bridge" / "rclpy_node.py"
    with output.open("wb") as sink:
        process = subprocess.Popen(
            [str(RCLPY), str(script), *map(str, arguments)], stdout=sink, stderr=subprocess.STDOUT, env={**clean, **ros}
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@real_ros
@pytest.mark.long
def test_real_ros_gives_the_poses_hears_the_odometry_in_another_node_and_stops_it_by_dying(tmp_path, monkeypatch):
    listener_file = tmp_path / "listener.txt"
    with (
        stack_with_bridge(tmp_path, monkeypatch) as (stack, _),
        real_node(tmp_path / "node.txt", "echo", *FAST_START) as process,
        real_node(listener_file, "listen"),
    ):
        drive(stack)
        stack.operator.wait_until("on the circle", lambda status: status["pose"][1] > 1.0, 60.0)
        assert stack.operator.status()["task"]["distance_m"] < 0.2
        process.kill()
        assert_stops(stack)
    lines = [line.split() for line in listener_file.read_text(encoding="utf-8").splitlines()]
    expected = {
        ("odom", "odom"),
        ("joint_states", "left_wheel_joint,right_wheel_joint"),
        ("plan", "map"),
        ("diagnostics", "disco-hw:daemon"),
    }
    assert expected <= {tuple(line) for line in lines}
    assert sum(line[0] == "odom" for line in lines) > 200


@real_ros
@pytest.mark.long
def test_real_ros_arms_and_drives_by_its_speeds(tmp_path):
    node_file = tmp_path / "node.txt"
    with bench_with_bridge(tmp_path) as (operator, _), real_node(node_file, "speed", 0.15, 0.3) as process:
        operator.wait_until("driving", is_driving, 30.0)
        process.kill()
        operator.wait_for("READY", 20.0)
        operator.wait_for_standstill(20.0)


def drive(stack):
    stack.operator.wait_until("a pose", lambda status: status["pose_ok"], READY_TIMEOUT_S)
    stack.drive()


def assert_stops(stack):
    stack.operator.wait_until("without a pose", lambda status: not status["pose_ok"], 20.0)
    stack.operator.wait_until("holding still", lambda status: not status["running"], 20.0)
    stack.operator.wait_for_standstill(20.0)


def test_it_drives_by_the_poses_of_a_node_that_hears_its_odometry_and_stops_when_the_node_dies(tmp_path, monkeypatch):
    node_file = tmp_path / "node.txt"
    with stack_with_bridge(tmp_path, monkeypatch) as (stack, _), node("echo", node_file) as process:
        stack.operator.wait_until("a pose", lambda status: status["pose_ok"], READY_TIMEOUT_S)
        status = stack.drive_until("half a metre further", lambda _: far(node_file) > 0.5, 30.0)
        assert status["pose_ok"]
        assert status["task"]["distance_m"] < 0.2
        process.kill()
        assert_stops(stack)


@pytest.mark.long
def test_it_drives_by_the_transforms_of_a_localisation_and_stops_when_that_dies(tmp_path, monkeypatch):
    node_file, plain = tmp_path / "node.txt", with_poses_of_ros

    def by_transforms(robot_file):
        text = plain(robot_file).read_text(encoding="utf-8")
        robot_file.write_text(text.replace('source = "ros2"\n', 'source = "ros2"\ntopic = "tf"\n'), encoding="utf-8")
        return robot_file

    monkeypatch.setitem(globals(), "with_poses_of_ros", by_transforms)
    with stack_with_bridge(tmp_path, monkeypatch) as (stack, _), node("tf", node_file) as process:
        stack.operator.wait_until("a pose", lambda status: status["pose_ok"], READY_TIMEOUT_S)
        status = stack.drive_until("a metre further", lambda _: far(node_file) > 1.0, 30.0)
        assert status["task"]["distance_m"] < 0.2
        process.kill()
        assert_stops(stack)


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("whom", ["node", "bridge"])
def test_speeds_drive_once_asked_to_arm_and_their_silence_disarms_for_good(whom, how, tmp_path):
    node_file = tmp_path / "node.txt"
    with bench_with_bridge(tmp_path) as (operator, bridge), node("speed", node_file, (0.15, 0.0, 0.3)) as speaker:
        request_until(speaker, node_file, "arm", '"ok": true')
        operator.wait_until("driving", is_driving, 20.0)
        {"node": speaker, "bridge": bridge}[whom].send_signal(how)
        operator.wait_for("READY", 20.0)
        operator.wait_for_standstill(20.0)
        {"node": speaker, "bridge": bridge}[whom].send_signal(signal.SIGCONT)
        time.sleep(1.0)
        assert operator.status()["state"] == "READY"


@pytest.mark.long
@pytest.mark.parametrize("action", ["button", "estop"])
def test_an_estop_from_ros_is_latched_until_it_is_reset(action, tmp_path):
    node_file = tmp_path / "node.txt"
    with bench_with_bridge(tmp_path) as (operator, _), node("speed", node_file, (0.15, 0.0, 0.3)) as speaker:
        request_until(speaker, node_file, "arm", '"ok": true')
        operator.wait_until("driving", is_driving, 20.0)
        speaker.stdin.write(f"{action}\n".encode())
        operator.wait_until("stopped", lambda status: status["estop"], 10.0)
        operator.wait_for_standstill(10.0)
        speaker.stdin.write(b"arm\n")
        time.sleep(1.0)
        assert operator.status()["estop"]
        request_until(speaker, node_file, "reset", '"do": "reset", "ok": true')
        operator.wait_for("READY", 10.0)


def request_until(speaker, node_file, request, reply, timeout_s=30.0):
    """Ask once a second, as who asks before the bridge is there is not heard."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        speaker.stdin.write(f"{request}\n".encode())
        time.sleep(1.0)
        if reply in node_file.read_text(encoding="utf-8"):
            return
    raise AssertionError(node_file.read_text(encoding="utf-8"))


def far(output):
    rows = received_positions(output)
    return max((abs(x) + abs(y) for x, y in rows), default=0.0)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["nan", "frame", "late", "garbage"])
def test_it_stops_when_the_nodes_poses_become_wrong(kind, tmp_path, monkeypatch):
    with stack_with_bridge(tmp_path, monkeypatch) as (stack, _), node(kind, tmp_path / "node.txt") as process:
        drive(stack)
        process.send_signal(signal.SIGUSR1)
        assert_stops(stack)


@pytest.mark.long
def test_a_flood_of_poses_stops_nothing_and_the_node_frozen_does(tmp_path, monkeypatch):
    node_file = tmp_path / "node.txt"
    with stack_with_bridge(tmp_path, monkeypatch) as (stack, _), node("flood", node_file) as process:
        drive(stack)
        process.send_signal(signal.SIGUSR1)
        stack.operator.wait_until("flooded for a while", lambda _: len(received_positions(node_file)) > 400, 60.0)
        assert stack.operator.status()["running"]
        process.send_signal(signal.SIGSTOP)
        assert_stops(stack)


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_it_stops_when_the_bridge_dies_or_freezes(how, tmp_path, monkeypatch):
    with stack_with_bridge(tmp_path, monkeypatch) as (stack, bridge), node("echo", tmp_path / "node.txt"):
        drive(stack)
        bridge.send_signal(how)
        assert_stops(stack)
        time.sleep(0.5)
        bridge.send_signal(signal.SIGCONT)
        # Poses alone bring nothing back into motion.
        time.sleep(1.0)
        assert not stack.operator.status()["running"]


_NODE = """
import sys, time
import msgspec
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from disco_hw.bridge import ros2, ros2_messages
from disco_hw.config import Ros2

word, domain, localhost_only = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "True"
config = msgspec.defstruct("Config", [("ros2", Ros2)])(Ros2(domain=domain, localhost_only=localhost_only))
joined = ros2.join_domain(config)
topic = Topic(joined[1], "rt/who", ros2_messages.String)
if word == "listen":
    reader, heard, end_s = DataReader(joined[1], topic, ros2.RELIABLE), set(), time.monotonic() + 60.0
    while time.monotonic() < end_s and len(heard) < 2:
        before = len(heard)
        heard |= {sample.data for sample in reader.take(20)}
        if len(heard) > before:
            end_s = time.monotonic() + 10.0
        time.sleep(0.05)
    print(*sorted(heard))
else:
    writer = DataWriter(joined[1], topic, ros2.RELIABLE)
    while True:
        writer.write(ros2_messages.String(word))
        time.sleep(0.1)
"""
_TWO_COMPUTERS = """
set -e
ip link set lo up
unshare -n sleep 100 & far=$!
trap 'kill $(jobs -p)' EXIT
until [ "$(readlink /proc/$far/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.05; done
ip link add v0 type veth peer name v1
ip link set v1 netns $far
ip addr add 10.9.0.1/24 dev v0
ip link set v0 up
nsenter -t $far -n sh -c 'ip link set lo up; ip addr add 10.9.0.2/24 dev v1; ip link set v1 up'
nsenter -t $far -n "$PYTHON" -c "$NODE" far $1 False &
"$PYTHON" -c "$NODE" near $1 $2 &
"$PYTHON" -c "$NODE" listen $1 $2
"""


def _can_have_networks():
    return shutil.which("ip") and not subprocess.run(["unshare", "-n", "true"], check=False).returncode


@pytest.mark.long
@pytest.mark.skipif(not _can_have_networks(), reason="networks of one's own take root and iproute2")
@pytest.mark.parametrize(("localhost_only", "expected"), [(True, "near"), (False, "far near")])
def test_nodes_on_another_computer_are_heard_only_where_robot_toml_lets_them(localhost_only, expected):
    command = ["unshare", "-n", "bash", "-c", _TWO_COMPUTERS, "two computers", str(domain()), str(localhost_only)]
    environment = {**os.environ, "PYTHON": sys.executable, "NODE": _NODE}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200.0, check=False)
    assert (done.stdout.strip(), done.returncode) == (expected, 0), done.stderr
