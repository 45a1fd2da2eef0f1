"""The shipped robot on its circle in simulated time, with poses that come by datagrams through a real socket."""

import json
import math
import socket

from disco_hw.log import records
from disco_hw.runtime.robot_setup import load_setup
from tests.drivers.waiting import free_port
from tests.runtime.simulated import recorded, robot_toml, simulated_stack, start
from tools.faults.run import circling_planner


class Sender:
    """Tells by datagrams where the robot is, `off(t_s)` (m) east of the truth; `transform` changes each pose."""

    def __init__(self, port, rate_hz, off=lambda t_s: 0.0, transform=lambda pose: pose):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self.name = "{}:{}".format(*self._socket.getsockname())
        self._period_us, self._off, self._transform = round(1e6 / rate_hz), off, transform
        self.is_silent = False

    def step(self, now_us, truth):
        if now_us % self._period_us == 0 and not self.is_silent:
            pose = {"x_m": truth.x_m + self._off(now_us * 1e-6), "y_m": truth.y_m, "yaw_rad": truth.yaw_rad}
            pose |= {"position_std_m": 0.005, "yaw_std_rad": 0.01, "age_s": 0.0}
            self._socket.send(json.dumps(self._transform(pose)).encode())

    def close(self):
        self._socket.close()


class PoseBench:
    """The robot with these lines of robot.toml, in which PORT is a free port; by default it drives without DISCO."""

    def __init__(self, directory, lines, planner_of=circling_planner):
        self.port = free_port(socket.SOCK_DGRAM)
        file = robot_toml(directory, lines.replace("PORT", str(self.port)))
        self.stack = simulated_stack(planner_of(load_setup(file)), robot_file=file)
        self.senders = []
        self._advance = self.stack.robot.advance
        self.stack.robot.advance = self.advance

    def advance(self, now_us):
        self._advance(now_us)
        for sender in self.senders:
            sender.step(now_us, self.stack.robot.truth)

    def send(self, *of, **more):
        self.senders.append(Sender(self.port, *of, **more))
        return self.senders[-1]

    def start(self, seconds=0.5):
        return start(self.stack, seconds)[-1].output.running

    def events(self, fragment=""):
        """Texts of the recorded events that contain this."""
        return [event.text for event in recorded(self.stack, records.Event) if fragment in event.text]

    def error_m(self):
        found, truth = self.stack.core.last.pipeline.estimate, self.stack.robot.truth
        return math.hypot(found.x_m - truth.x_m, found.y_m - truth.y_m)

    def close(self):
        self.stack.core.pose_source.close()
        for sender in self.senders:
            sender.close()
