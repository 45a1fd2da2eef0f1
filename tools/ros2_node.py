"""A node of ROS 2 in a process of its own: hears /odom, says what it is asked to, and is killed by tests and trials.

    python -m tools.ros2_node DOMAIN KIND X Y YAW

`echo` says where the robot is by its own odometry, from X Y YAW on; `tf` says where that odometry is in the map, dated
ahead, as a localisation does; `nan`, `frame`, `flood`, `garbage` and `late` do so
wrongly from SIGUSR1 on. A line for each odometry heard: its stamp (wall clock), when it was heard and answered
(monotonic), in ns, and where it is (m). `speed` says speeds X (m/s) and YAW (rad/s), 20 a second, asks the bridge for
each line of its input, presses the e-stop for the line `button`, and writes the answers.
"""

import contextlib
import math
import os
import signal
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from disco_hw.bridge import ros2_messages as msg


@dataclass
class Garbage(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """A message that says that it is a pose."""

    text: str


def main(domain: str, kind: str, east: str, north: str, heading: str) -> None:
    x, y, yaw = float(east), float(north), float(heading)
    _domain = Domain(int(domain), msg.LOOPBACK)
    participant = DomainParticipant(int(domain))
    best_effort = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    odometry = DataReader(participant, Topic(participant, "rt/odom", msg.Odometry), best_effort)
    if kind == "speed":
        drive(participant, msg.Twist(msg.Vector3(x, 0.0, 0.0), msg.Vector3(0.0, 0.0, yaw)))
        return
    pose_writer = DataWriter(participant, Topic(participant, "rt/pose", msg.PoseStamped))
    transforms = DataWriter(participant, Topic(participant, "rt/tf", msg.TFMessage)) if kind == "tf" else None
    # The name of a pose and the bytes of something else, once it is time.
    other = None
    wrong: list[int] = []
    signal.signal(signal.SIGUSR1, lambda *_: wrong.append(1))
    while True:
        for received in odometry.take(10):
            if not received.sample_info.valid_data:
                continue
            received_ns = time.monotonic_ns()
            place, turned = received.pose.pose.position, received.pose.pose.orientation
            at_x = x + math.cos(yaw) * place.x - math.sin(yaw) * place.y
            at_y = y + math.sin(yaw) * place.x + math.cos(yaw) * place.y
            pose = msg.RosPose(msg.Point(at_x, at_y, 0.0), msg.about_z(yaw + msg.yaw_of(turned)))
            message = msg.PoseStamped(msg.Header(received.header.stamp, "map"), pose)
            times = 1
            if transforms is not None:
                times = 0
                # A correction that is new each time.
                shift = msg.Vector3(x + 1e-6 * (received_ns % 1000), y, 0.0)
                ahead = msg.stamp_of(msg.time_of(received.header.stamp) + 200_000_000)
                one = msg.TransformStamped(msg.Header(ahead, "map"), "odom", msg.Transform(shift, msg.about_z(yaw)))
                transforms.write(msg.TFMessage([one]))
            if wrong:
                if kind == "nan":
                    pose.position.x = math.nan
                elif kind == "frame":
                    message.header.frame_id = "odom"
                elif kind == "late":
                    message.header.stamp = msg.Time(1, 0)
                elif kind == "flood":
                    times = 40
                elif kind == "garbage" and other is None:
                    other = DataWriter(participant, Topic(participant, "rt/pose", Garbage))
            for _ in range(times):
                (other or pose_writer).write(Garbage("x" * 300) if other else message)
            stamp_ns, sent_ns = msg.time_of(received.header.stamp), time.monotonic_ns()
            print(f"{stamp_ns} {received_ns} {sent_ns} {place.x:.6f} {place.y:.6f}", flush=True)
        time.sleep(0.001)


def drive(participant, twist):
    speed_writer = DataWriter(participant, Topic(participant, "rt/cmd_vel", msg.Twist))
    reliable = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))
    request_writer = DataWriter(participant, Topic(participant, "rt/disco_hw/ctl", msg.String), reliable)
    button = DataWriter(participant, Topic(participant, "rt/disco_hw/estop", msg.Bool), reliable)
    replies = DataReader(participant, Topic(participant, "rt/disco_hw/reply", msg.String), reliable)
    os.set_blocking(sys.stdin.fileno(), False)
    while True:
        speed_writer.write(twist)
        with contextlib.suppress(BlockingIOError, TypeError):
            for line in os.read(sys.stdin.fileno(), 1000).decode().splitlines():
                if line == "button":
                    button.write(msg.Bool(True))
                else:
                    request_writer.write(msg.String(line))
        for reply in replies.take(10):
            if reply.sample_info.valid_data:
                print(reply.data, flush=True)
        time.sleep(0.05)


if __name__ == "__main__":
    main(*sys.argv[1:])
