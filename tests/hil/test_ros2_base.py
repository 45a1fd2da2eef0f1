"""The stack drives a base that is reached over ROS 2 alone: a real node on DDS, with the simulated robot behind it."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: make venv")

from disco_hw.config import load_robot_config
from disco_hw.experiments import READY_TIMEOUT_S, Operator, is_stationary
from disco_hw.experiments import disco_hw_process as process_of
from tests.hil.test_ros2 import real_node, real_ros
from tools.stack import FAST_START, FAST_TASK, write_robot_file

pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.timeout(400)]
JOINTS = 'left_joints = ["fl", "rl"]\nright_joints = ["fr", "rr"]\n'


class Base:
    """Node, bridge and daemon, each in a process of its own."""

    def __init__(self, directory, stack, lines=JOINTS, real=False):
        self.directory, self.stack = directory, stack
        self.robot_file = write_robot_file(directory, task=FAST_TASK, device="ros2_base")
        text = self.robot_file.read_text(encoding="utf-8").replace("watchdog_s = 0.5\n", f"watchdog_s = 0.5\n{lines}")
        text += f"[ros2]\ndomain = {100 + os.getpid() % 100}\n"
        self.robot_file.write_text(text, encoding="utf-8")
        self.output_lines = directory / "node.txt"
        self.node = self.begin_real_node() if real else self.begin_node()
        self.bridge = self.begin_bridge()
        daemon = ["run", str(self.robot_file), "--log", str(directory / "run.mcap")]
        self.daemon = stack.enter_context(process_of("daemon", daemon, directory / "daemon.txt")).process
        self.operator = Operator(directory / "control.sock")

    def begin_node(self):
        sink = self.stack.enter_context(self.output_lines.open("ab"))
        node = subprocess.Popen(
            [sys.executable, "-m", "tools.ros2_base_node", str(self.robot_file), *map(str, FAST_START)], stdout=sink
        )
        self.stack.callback(node.wait)
        self.stack.callback(node.kill)
        return node

    def begin_real_node(self):
        """The base as a node of real ROS 2, with another DDS than ours."""
        config = load_robot_config(self.robot_file)
        settings = config.link.settings()
        numbers = (config.pose.port, settings.wheel_radius_m, settings.track_m, *FAST_START)
        return self.stack.enter_context(real_node(self.output_lines, "base", *numbers))

    def begin_bridge(self):
        arguments = ["bridge", "ros2-base", str(self.robot_file)]
        return self.stack.enter_context(process_of("bridge", arguments, self.directory / "bridge.txt")).process

    def begin_other_speaker(self):
        domain = str(100 + os.getpid() % 100)
        other = subprocess.Popen([sys.executable, "-m", "tools.ros2_node", domain, "speed", "0.1", "0.0", "0.0"])
        self.stack.callback(other.wait)
        self.stack.callback(other.kill)

    def drive(self):
        operator = self.operator
        operator.wait_for("READY", READY_TIMEOUT_S)
        operator.wait_until("a pose", lambda status: status["pose_ok"], 30.0)
        operator.arm(10.0)
        operator.request("start")
        operator.wait_until("at speed", lambda status: status["wheels"] and max(status["wheels"]) > 6.0, 20.0)

    def truth(self):
        """(monotonic ns, faster true wheel, rad/s, forward speed in force, m/s) of each line of the node."""
        rows = [line.split() for line in self.output_lines.read_text(encoding="utf-8").splitlines()]
        return [
            (int(row[0]), max(abs(float(row[1])), abs(float(row[2]))), float(row[3])) for row in rows if len(row) == 5
        ]

    def wait_for_true_standstill(self, timeout_s=30.0):
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            rows = self.truth()[-5:]
            if rows and max(row[1] for row in rows) < 0.05 and not any(row[2] for row in rows):
                return
            time.sleep(0.1)
        raise AssertionError(f"still turning: {self.truth()[-3:]}")


def test_it_drives_the_circle_and_stops_when_the_daemon_dies(tmp_path):
    with ExitStack() as stack:
        base = Base(tmp_path, stack)
        base.drive()
        status = base.operator.wait_until("two metres on", lambda status: status["pose"][1] > 2.0, 60.0)
        assert status["task"]["distance_m"] < 0.2
        base.daemon.kill()
        base.wait_for_true_standstill()
        # The bridge goes on and says that nobody drives.
        assert (tmp_path / "bridge.txt").read_text(encoding="utf-8").splitlines()[-1].endswith("on standby")


@real_ros
def test_a_base_of_real_ros_is_driven_round_and_the_stack_stops_when_it_dies(tmp_path):
    with ExitStack() as stack:
        base = Base(tmp_path, stack, real=True)
        base.drive()
        base.operator.wait_until("half a circle on", lambda status: status["pose"][0] < -2.5, 120.0)
        assert base.operator.status()["task"]["distance_m"] < 0.1
        base.operator.request("stop")
        base.wait_for_true_standstill()
        base.operator.request("start")
        base.operator.wait_until("at speed", lambda status: max(status["wheels"]) > 6.0, 20.0)
        base.node.kill()
        base.operator.wait_until("disarmed", lambda status: status["state"] != "ARMED", 60.0)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("whom", ["bridge", "node", "daemon"])
def test_it_stops_whoever_dies_or_freezes_and_does_not_go_on_by_itself(tmp_path, whom, how):
    with ExitStack() as stack:
        base = Base(tmp_path, stack)
        base.drive()
        process = {"bridge": base.bridge, "node": base.node, "daemon": base.daemon}[whom]
        process.send_signal(how)
        if whom != "node":
            base.wait_for_true_standstill()
        if whom != "daemon":
            base.operator.wait_until("not armed", lambda status: status["state"] != "ARMED", 10.0)
        process.send_signal(signal.SIGCONT)
        if how == signal.SIGKILL:
            process.wait()
            if whom == "daemon":
                return
            base.begin_bridge() if whom == "bridge" else base.begin_node()
        time.sleep(2.0)
        base.wait_for_true_standstill()
        at_rest = base.operator.wait_until("at rest", lambda status: status["state"] in ("READY", "FAULT"), 60.0)
        if at_rest["state"] == "FAULT":
            base.operator.request("reset")
            base.operator.wait_for("READY", 30.0)
        time.sleep(1.0)
        assert is_stationary(base.operator.status())


@pytest.mark.parametrize(
    "lines", [JOINTS, "", f"speed_stamped = true\n{JOINTS}"], ids=["joints", "odometry", "stamped"]
)
def test_it_keeps_to_the_circle_by_joint_states_and_by_odometry(tmp_path, lines):
    with ExitStack() as stack:
        base = Base(tmp_path, stack, lines)
        base.drive()
        base.operator.wait_until("half a circle on", lambda status: status["pose"][0] < -2.5, 120.0)
        base.operator.wait_until("round again", lambda status: status["pose"][0] > 2.5, 120.0)
        assert base.operator.status()["task"]["distance_m"] < 0.1
        base.operator.request("stop")
        base.wait_for_true_standstill()


@pytest.mark.parametrize(
    ("fault", "message"),
    [(signal.SIGUSR1, "the angles of its wheels jumped"), (signal.SIGUSR2, "no odometry"), (None, "another node")],
)
def test_a_base_that_restarts_falls_silent_or_hears_another_stops(tmp_path, fault, message):
    with ExitStack() as stack:
        base = Base(tmp_path, stack)
        base.drive()
        base.operator.wait_until("some way on", lambda status: status["pose"][1] > 1.0, 60.0)
        if fault is not None:
            base.node.send_signal(fault)
        else:
            base.begin_other_speaker()
        base.operator.wait_until("disarmed", lambda status: status["state"] != "ARMED", 60.0)
        base.wait_for_true_standstill()
        assert message in (tmp_path / "daemon.txt").read_text(encoding="utf-8")
