"""A base that is reached over ROS 2 alone, with the simulated robot behind it: speeds in, joint states or odometry out.

    python -m tools.ros2_base_node ROBOT.toml [X Y YAW]

A node on DDS in a process of its own, in real time, by the topics of robot.toml's [link]. It obeys the last speeds for
`watchdog_s`; measured poses go out as datagrams where `pose.source` takes those. A line each 50 ms: monotonic time
(ns), true wheel speeds (rad/s), the speeds in force (m/s, rad/s). SIGUSR1 restarts it: the joints count from zero;
SIGUSR2 has it say its wheels no more.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from pathlib import Path
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import join_domain, wire_name
from disco_hw.config import RobotConfig
from disco_hw.experiments.virtual import true_parameters
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor.ros2_base_wire import Ros2BaseSettings
from drivers.pose.udp import SOURCE as UDP_POSES
from sim.body_dynamics import BodyPose
from sim.plant import Plant
from sim.process import PoseSender

STEP_S, PUBLISH_S, LINE_S = 0.005, 0.02, 0.05
RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))


class BaseNode:
    """Base on ROS 2 with its plant, its own kinematics, and its topics."""

    def __init__(self, config: RobotConfig, settings: Ros2BaseSettings, plant: Plant) -> None:
        self.settings, self.plant = settings, plant
        self.silent = False
        self.zero_ticks = (0, 0)
        self._commanded = (0.0, 0.0)
        self._commanded_s = -math.inf
        self._pose = [0.0, 0.0, 0.0]
        self._angles = (0.0, 0.0)
        self._domain, participant = join_domain(config)
        speed: Any = msg.TwistStamped if settings.speed_stamped else msg.Twist
        wheels: Any = msg.JointState if settings.left_joints else msg.Odometry
        namespace = config.ros2.namespace
        self._speeds = DataReader(
            participant, Topic(participant, wire_name(settings.speed_topic, namespace), speed), RELIABLE
        )
        self._wheel_writer = DataWriter(
            participant, Topic(participant, wire_name(settings.wheels_from, namespace), wheels), RELIABLE
        )

    def obey(self, now_s: float) -> tuple[float, float]:
        """The speeds in force: the last that were heard, for as long as the base's time-out lasts."""
        for sample in self._speeds.take(20):
            if sample.sample_info.valid_data:
                twist = sample.twist if self.settings.speed_stamped else sample
                self._commanded, self._commanded_s = (twist.linear.x, twist.angular.z), now_s
        return self._commanded if now_s - self._commanded_s <= self.settings.watchdog_s else (0.0, 0.0)

    def wheels_of(self, speeds: tuple[float, float]) -> tuple[float, float]:
        """Return the wheel speeds of speeds of the body, by the nominal geometry."""
        half = 0.5 * self.settings.track_m * speeds[1]
        return (speeds[0] - half) / self.settings.wheel_radius_m, (speeds[0] + half) / self.settings.wheel_radius_m

    def publish(self) -> None:
        """Publish the wheels' state now."""
        if self.silent:
            return
        per_tick = math.tau / self.plant.parameters.ticks_per_rev
        pairs = zip(self.plant.encoder_ticks, self.zero_ticks, strict=True)
        left, right = (per_tick * (now - zero) for now, zero in pairs)
        speeds, settings = self.plant.measured_wheel_speeds_rad_s, self.settings
        header = msg.Header(msg.stamp_of(time.time_ns()), "" if settings.left_joints else "odom")
        if settings.left_joints:
            sides = (settings.left_joints, settings.right_joints)
            names = [name for side in sides for name in side]
            angles = [angle for side, angle in zip(sides, (left, right), strict=True) for _ in side]
            turning = [speed for side, speed in zip(sides, speeds, strict=True) for _ in side]
            self._wheel_writer.write(msg.JointState(header, names, angles, turning))
            return
        radius, track = settings.wheel_radius_m, settings.track_m
        moved = (radius * (left - self._angles[0]), radius * (right - self._angles[1]))
        self._angles = (left, right)
        turn = (moved[1] - moved[0]) / track
        middle = self._pose[2] + 0.5 * turn
        self._pose[0] += 0.5 * (moved[0] + moved[1]) * math.cos(middle)
        self._pose[1] += 0.5 * (moved[0] + moved[1]) * math.sin(middle)
        self._pose[2] += turn
        pose = msg.RosPose(msg.Point(self._pose[0], self._pose[1], 0.0), msg.about_z(self._pose[2]))
        linear, angular = 0.5 * radius * (speeds[0] + speeds[1]), radius * (speeds[1] - speeds[0]) / track
        twist = msg.Twist(msg.Vector3(linear, 0.0, 0.0), msg.Vector3(0.0, 0.0, angular))
        self._wheel_writer.write(
            msg.Odometry(header, "base_link", msg.PoseWithCovariance(pose), msg.TwistWithCovariance(twist))
        )


def main(robot: str, *start: str) -> None:
    setup = load_setup(Path(robot))
    config, settings = setup.config, setup.config.link.settings()
    assert isinstance(settings, Ros2BaseSettings)
    place = BodyPose(*map(float, start)) if start else BodyPose(*config.task_start)
    plant = Plant(true_parameters(setup, None).with_ideal_motors(), start=place)
    # Kernels are compiled before anybody hears of the base.
    plant.step(1000, 0.0, 0.0)
    node = BaseNode(config, settings, plant)
    named = config.pose.of(UDP_POSES)
    poses = None if named is None else PoseSender((named.address, named.port))

    def restart(*_: object) -> None:
        node.zero_ticks = plant.encoder_ticks

    def fall_silent(*_: object) -> None:
        node.silent = True

    signal.signal(signal.SIGUSR1, restart)
    signal.signal(signal.SIGUSR2, fall_silent)
    begun_s = time.monotonic()
    next_publish_s = next_line_s = begun_s
    while True:
        now_s = time.monotonic()
        speeds = node.obey(now_s)
        now_us = max(plant.now_us, round(1e6 * (now_s - begun_s)))
        for pose in plant.step(now_us, *node.wheels_of(speeds)):
            if poses is not None:
                poses.send(pose, now_us)
        if now_s >= next_publish_s:
            next_publish_s = max(next_publish_s + PUBLISH_S, now_s - PUBLISH_S)
            node.publish()
        if now_s >= next_line_s:
            next_line_s = now_s + LINE_S
            truth = plant.truth
            values = (truth.left_speed_rad_s, truth.right_speed_rad_s, *speeds)
            print(time.monotonic_ns(), *(f"{value:.4f}" for value in values), flush=True)
        time.sleep(STEP_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
