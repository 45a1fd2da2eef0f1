"""A node of real ROS 2, for the Python of an environment that has rclpy; it imports nothing of ours.

python rclpy_node.py echo X Y YAW      says where the robot is by its own odometry, from X Y YAW on
python rclpy_node.py listen            a line for each message that the bridge says: topic, frame
python rclpy_node.py base PORT RADIUS TRACK X Y YAW    a base: obeys /cmd_vel for 0.5 s, says /joint_states, and its
                                       pose in datagrams to that port; a line each 50 ms as of tools.ros2_base_node
python rclpy_node.py speed V OMEGA     speeds, and a request to arm once a second until it is granted
"""

import json
import math
import socket
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import String


def echo(node, x, y, yaw):
    publisher = node.create_publisher(PoseStamped, "/pose", 10)

    def publish_pose(message):
        place, turned = message.pose.pose.position, message.pose.pose.orientation
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = message.header.stamp, "map"
        pose.pose.position.x = x + math.cos(yaw) * place.x - math.sin(yaw) * place.y
        pose.pose.position.y = y + math.sin(yaw) * place.x + math.cos(yaw) * place.y
        half = 0.5 * (yaw + 2.0 * math.atan2(turned.z, turned.w))
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(half), math.cos(half)
        publisher.publish(pose)

    node.create_subscription(Odometry, "/odom", publish_pose, qos_profile_sensor_data)


def listen(node):
    def print_topic(topic, frame):
        return lambda message: print(topic, frame(message), flush=True)

    def stamped(message):
        return message.header.frame_id

    reliable = QoSProfile(depth=10)
    node.create_subscription(Odometry, "/odom", print_topic("odom", stamped), reliable)
    node.create_subscription(
        JointState, "/joint_states", print_topic("joint_states", lambda m: ",".join(m.name)), reliable
    )
    node.create_subscription(Path, "/plan", print_topic("plan", stamped), reliable)
    node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        print_topic("diagnostics", lambda m: m.status[0].name.replace(" ", "")),
        reliable,
    )


def speed(node, forward, turn):
    speed_publisher, request_publisher = (
        node.create_publisher(Twist, "/cmd_vel", 10),
        node.create_publisher(String, "/disco_hw/ctl", 10),
    )
    granted = []

    def reply(message):
        print(message.data, flush=True)
        granted.extend([message.data] if '"ok": true' in message.data else [])

    def drive():
        twist = Twist()
        twist.linear.x, twist.angular.z = forward, turn
        speed_publisher.publish(twist)

    node.create_subscription(String, "/disco_hw/reply", reply, 10)
    node.create_timer(0.05, drive)
    node.create_timer(1.0, lambda: granted or request_publisher.publish(String(data="arm")))


def base(node, port, radius, track, x, y, yaw):
    """Wheels without inertia on a body that drives as the shipped model says."""
    axial, x_icr, period = 0.415, 0.238, 0.02
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    joints = node.create_publisher(JointState, "/joint_states", 10)
    now = {"v": 0.0, "omega": 0.0, "heard": 0.0, "x": x, "y": y, "yaw": yaw, "left": 0.0, "right": 0.0, "tick": 0}

    def obey(message):
        now.update(v=message.linear.x, omega=message.angular.z, heard=time.monotonic())

    def step():
        v, omega = (now["v"], now["omega"]) if time.monotonic() - now["heard"] < 0.5 else (0.0, 0.0)
        left, right = (v - 0.5 * track * omega) / radius, (v + 0.5 * track * omega) / radius
        turn, forward = radius * (right - left) / axial, 0.5 * radius * (left + right)
        cosine, sine = math.cos(now["yaw"]), math.sin(now["yaw"])
        now["x"] += period * (forward * cosine + turn * x_icr * sine)
        now["y"] += period * (forward * sine - turn * x_icr * cosine)
        now["yaw"] += period * turn
        now["left"] += period * left
        now["right"] += period * right
        now["tick"] += 1
        joint_state = JointState(name=["fl", "rl", "fr", "rr"])
        joint_state.header.stamp = node.get_clock().now().to_msg()
        joint_state.position, joint_state.velocity = [now["left"]] * 2 + [now["right"]] * 2, [left] * 2 + [right] * 2
        joints.publish(joint_state)
        if now["tick"] % 2 == 0:
            pose = {"x_m": now["x"], "y_m": now["y"], "yaw_rad": now["yaw"], "position_std_m": 0.005}
            sender.sendto(json.dumps({**pose, "yaw_std_rad": 0.01, "age_s": 0.0}).encode(), ("127.0.0.1", int(port)))
            print(time.monotonic_ns(), left, right, v, omega, flush=True)

    node.create_subscription(Twist, "/cmd_vel", obey, 10)
    node.create_timer(period, step)


def main(kind, *numbers):
    rclpy.init()
    node = rclpy.create_node(f"test_{kind}")
    {"echo": echo, "listen": listen, "speed": speed, "base": base}[kind](node, *map(float, numbers))
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
