"""A skid-steer robot in MuJoCo, as a truth that is not ours.

Four wheels in contact with a floor, each on a velocity servo with a lag and a limited torque, driven by a script like a
person with a joystick. It shares no constant and no equation with the virtual robot or with the model that the search
for missing effects fits (`tests/tools/test_mujoco_robot.py` holds it to that), but for what delay and dead band are:
turning, slip and droop are what contact and servos make of them.

Poses are of the base's middle and carry white noise on each axis and on the yaw; encoders are those of the motors, the
mean of a side's two, in steps of a turn over their counts. Stamps are exact, unless its `Habits` are others. There are
robots of three sizes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import DriveLog
from tools.joystick import STEPS_PER_COMMAND, STEPS_PER_S, TOP_RAD_S, joystick, keyboard, recorded_drive

Array = NDArray[np.float64]

STEPS_PER_READING = 8
STEPS_PER_POSE = 2 * STEPS_PER_READING
WHEEL_RADIUS_M, TRACK_M, WHEELBASE_M = 0.133, 0.49, 0.43
COUNTS_PER_TURN = 1470
POSITION_STD_M, YAW_STD_RAD = 0.0062, 0.0073
DURATION_S = 153.0
SERVO_NM_S = 13.7
"""Torque of a motor for each rad/s that its wheel is too slow."""
SERVO_LAG_S = 0.037
TORQUE_NM = 28.5
DOWNHILL_RAD = 0.57
"""Which way a slope falls, from the x axis."""

EFFECTS = {
    "command_delay": (0.145, "s from a command to the servos"),
    "motor_lag": (0.23, "s, time constant of the servos in place of theirs"),
    "dead_band": (0.57, "rad/s of each command that the servos ignore"),
    "dry_friction": (0.57, "rad/s that dry friction of a motor takes from a wheel"),
    "unequal_wheels": (0.042, "by so much the right wheels are larger"),
    "pose_latency": (0.21, "s by which poses are stamped late"),
    "slope": (5.7, "degrees that the floor falls"),
    "payload": (14.5, "kg over the wheels of the left side"),
    "torque_limit": (5.7, "N m of each motor"),
    "worn_tyre": (0.37, "share that is left of the front left wheel's friction"),
    "backlash": (0.11, "rad of play between motor and wheel"),
}
"""What can be hidden: a usual size, and what the size means."""
Hidden = dict[str, float]


@dataclass(frozen=True, slots=True)
class Habits:
    """Habits of a driver and a log: one of so many commands, readings and poses that there are is kept.

    A joystick or the keys of a keyboard ask for `pace` of what the robot can. Stamps are late at random, by half a
    normal distribution of `jitter_s`; a share of readings and of poses is lost.
    """

    seconds: float = DURATION_S
    pace: float = 1.0
    keyboard: bool = False
    command_every: int = 1
    reading_every: int = 1
    pose_every: int = 1
    jitter_s: float = 0.0
    lost: float = 0.0


@dataclass(frozen=True, slots=True)
class Robot:
    """Robot with its sizes in m and kg, its servos, encoders and poses; `sizes`: of what is hidden, where not as usual.

    `half_m`: half the base's length, width and height; `above_m`: of its middle above the wheels'; `rotor_kg_m2`: of a
    motor, seen from its wheel; `payload_m`: half the edge of the box that is put on, and where.
    """

    wheel_radius_m: float = WHEEL_RADIUS_M
    track_m: float = TRACK_M
    wheelbase_m: float = WHEELBASE_M
    top_rad_s: float = TOP_RAD_S
    counts_per_turn: int = COUNTS_PER_TURN
    position_std_m: float = POSITION_STD_M
    yaw_std_rad: float = YAW_STD_RAD
    servo_nm_s: float = SERVO_NM_S
    servo_lag_s: float = SERVO_LAG_S
    torque_nm: float = TORQUE_NM
    friction: float = 0.57
    base_kg: float = 33.0
    half_m: tuple[float, float, float] = (0.29, 0.165, 0.055)
    above_m: float = 0.033
    wheel_kg: float = 1.9
    wheel_half_m: float = 0.042
    rotor_kg_m2: float = 0.105
    bearing_nm_s: float = 0.023
    payload_m: Mapping[str, float] = field(default_factory=lambda: {"half": 0.07, "aside": 0.165, "high": 0.165})
    sizes: Mapping[str, float] = field(default_factory=dict)
    habits: Habits = Habits()

    def size(self, effect: str) -> float:
        """Usual size of what can be hidden."""
        return self.sizes.get(effect, EFFECTS[effect][0])


_SIZES = {
    "command_delay": (0.097, 0.205),
    "motor_lag": (0.155, 0.31),
    "dead_band": (0.36, 0.81),
    "dry_friction": (0.36, 0.81),
    "unequal_wheels": (0.021, 0.031),
    "pose_latency": (0.125, 0.155),
    "slope": (4.1, 7.2),
    "payload": (18.5, 2.1),
    "torque_limit": (14.3, 0.81),
    "worn_tyre": (0.51, 0.41),
    "backlash": (0.053, 0.155),
}
"""Usual sizes of what can be hidden in the heavy robot and in the light one."""

ROBOTS = {
    "middle": Robot(),
    "heavy": Robot(
        wheel_radius_m=0.163,
        track_m=0.63,
        wheelbase_m=0.39,
        top_rad_s=6.1,
        counts_per_turn=3900,
        position_std_m=0.0032,
        yaw_std_rad=0.0041,
        servo_nm_s=24.7,
        servo_lag_s=0.059,
        torque_nm=61.0,
        friction=0.79,
        base_kg=47.0,
        sizes={name: of[0] for name, of in _SIZES.items()},
    ),
    "light": Robot(
        wheel_radius_m=0.0615,
        track_m=0.266,
        wheelbase_m=0.205,
        top_rad_s=9.1,
        counts_per_turn=2060,
        position_std_m=0.0021,
        yaw_std_rad=0.0053,
        servo_nm_s=0.91,
        servo_lag_s=0.031,
        torque_nm=4.1,
        friction=0.69,
        base_kg=5.2,
        half_m=(0.135, 0.081, 0.029),
        above_m=0.0155,
        wheel_kg=0.255,
        wheel_half_m=0.0195,
        rotor_kg_m2=0.0061,
        bearing_nm_s=0.0021,
        payload_m={"half": 0.031, "aside": 0.081, "high": 0.0815},
        sizes={name: of[1] for name, of in _SIZES.items()},
    ),
}
"""Robots of three sizes; where none is named, the first."""

_WHEELS = (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1))
_MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{step_s}" integrator="implicitfast" cone="elliptic" impratio="9" gravity="{gravity}"/>
  <worldbody>
    <geom name="floor" type="plane" size="99 99 1" solref="0.0042 1"/>
    <body name="base" pos="0 0 {high}"><freejoint/>
      <geom type="box" size="{half}" mass="{base_kg}" pos="0 0 {above}"/>{payload}{wheels}
    </body>
  </worldbody>
  <actuator>{servos}
  </actuator>
</mujoco>"""
_WHEEL = """
      <body pos="{x} {y} -0.021">
        <joint name="{name}" type="hinge" axis="0 1 0" damping="{damping}" armature="{rotor}" frictionloss="{dry_nm}"/>
        <geom type="sphere" size="0.011" mass="0.13" contype="0" conaffinity="0"/>
        <body>{play}
          <geom type="cylinder" size="{radius} {width}" zaxis="0 1 0" mass="{wheel_kg}" priority="1" condim="4"
                friction="{friction} 0.0044 0.0011" solref="0.0042 1"/>
        </body>
      </body>"""
_PLAY = """
          <joint type="hinge" axis="0 1 0" limited="true" range="-{half} {half}" damping="0.0031"
                 solreflimit="0.0042 1"/>"""
_SERVO = """
    <general joint="{name}" dyntype="filterexact" dynprm="{lag_s}" gainprm="{gain}" biastype="affine"
             biasprm="0 0 -{gain}" forcerange="-{most} {most}"/>"""
_PAYLOAD = '<geom type="box" size="{half} {half} {half}" mass="{kg}" pos="0 {aside} {high}"/>'


@dataclass(frozen=True, eq=False)
class Recording:
    """Recording of a drive with the truth beside it.

    Times in s from the start, as stamped; commands and counted angles (N, 2), left and right, in rad/s and rad; poses
    (P, 3) in m and rad. `truth`: where the robot was at `truth_s`, (T, 3), its yaw not wrapped; `turned`: its wheels'
    angles there, (T, 4), as in `_WHEELS`; `noise`: what was added to the poses, (P, 3).
    """

    command_s: Array
    command: Array
    wheel_s: Array
    angle: Array
    pose_s: Array
    pose: Array
    truth_s: Array
    truth: Array
    turned: Array
    noise: Array
    hidden: Hidden = field(default_factory=dict)
    robot: Robot = ROBOTS["middle"]

    def as_drive(self) -> DriveLog:
        """The log that a host would have: nothing of the truth."""
        return recorded_drive("mujoco", self.command_s, self.command, self.wheel_s, self.angle, self.pose_s, self.pose)


def mjcf(hidden: Hidden, robot: Robot = ROBOTS["middle"]) -> str:
    """A robot as MuJoCo's model text."""
    tilt = math.radians(hidden.get("slope", 0.0))
    pull = [9.81 * math.sin(tilt) * part for part in (math.cos(DOWNHILL_RAD), math.sin(DOWNHILL_RAD))]
    wheels = "".join(
        _WHEEL.format(
            name=name,
            x=front * robot.wheelbase_m / 2,
            y=left * robot.track_m / 2,
            radius=robot.wheel_radius_m * (1.0 + (hidden.get("unequal_wheels", 0.0) if left < 0 else 0.0)),
            width=robot.wheel_half_m,
            wheel_kg=robot.wheel_kg,
            damping=robot.bearing_nm_s,
            rotor=robot.rotor_kg_m2,
            friction=robot.friction * (hidden.get("worn_tyre", 1.0) if name == "fl" else 1.0),
            dry_nm=hidden.get("dry_friction", 0.0) * robot.servo_nm_s,
            play=_PLAY.format(half=hidden["backlash"] / 2) if "backlash" in hidden else "",
        )
        for name, front, left in _WHEELS
    )
    servos = "".join(
        _SERVO.format(
            name=name,
            lag_s=hidden.get("motor_lag", robot.servo_lag_s),
            gain=robot.servo_nm_s,
            most=hidden.get("torque_limit", robot.torque_nm),
        )
        for name, *_ in _WHEELS
    )
    return _MODEL.format(
        step_s=1.0 / STEPS_PER_S,
        gravity=f"{pull[0]} {pull[1]} {-9.81 * math.cos(tilt)}",
        high=robot.wheel_radius_m + 0.022,
        half=" ".join(map(str, robot.half_m)),
        base_kg=robot.base_kg,
        above=robot.above_m,
        payload=_PAYLOAD.format(kg=hidden["payload"], **robot.payload_m) if "payload" in hidden else "",
        wheels=wheels,
        servos=servos,
    )


def driven(robot: Robot, seed: int) -> Array:
    """Commands (N, 2) of whoever drives a robot, as they are sent: each stays until the next."""
    habits = robot.habits
    by = keyboard if habits.keyboard else joystick
    command, every = by(seed, habits.seconds, habits.pace * robot.top_rad_s), habits.command_every
    return np.repeat(command[::every], every, axis=0)[: command.shape[0]]


def record(hidden: Hidden, seed: int, command: Array | None = None, robot: Robot = ROBOTS["middle"]) -> Recording:
    """Drive a robot with these effects hidden in it; `command`: (N, 2), in place of what its driver would do.

    Raises ValueError for an effect that does not exist, ImportError without mujoco.
    """
    import mujoco  # noqa: PLC0415  (of those who make such logs only)

    unknown = set(hidden) - set(EFFECTS)
    if unknown:
        raise ValueError(f"no such effect: {', '.join(sorted(unknown))}; give some of {', '.join(EFFECTS)}")
    command, habits = driven(robot, seed) if command is None else command, robot.habits
    effective_command = np.sign(command) * np.maximum(np.abs(command) - hidden.get("dead_band", 0.0), 0.0)
    model = mujoco.MjModel.from_xml_string(mjcf(hidden, robot))
    data = mujoco.MjData(model)
    motors = [model.joint(name).qposadr[0] for name, *_ in _WHEELS]
    waiting = deque([np.zeros(4)] * round(hidden.get("command_delay", 0.0) * STEPS_PER_S))
    for _ in range(STEPS_PER_S):
        mujoco.mj_step(model, data)
    turned_before = data.qpos[motors].copy()
    steps = command.shape[0] * STEPS_PER_COMMAND
    where, turned = np.empty((steps, 3)), np.empty((steps, len(motors)))
    for k in range(steps):
        w, x, y, z = data.qpos[3:7]
        where[k] = data.qpos[0], data.qpos[1], math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turned[k] = data.qpos[motors] - turned_before
        left, right = effective_command[k // STEPS_PER_COMMAND]
        waiting.append(np.array([left, right, left, right]))
        data.ctrl[:] = waiting.popleft()
        mujoco.mj_step(model, data)
    where[:, 2] = np.unwrap(where[:, 2])
    now_s = np.arange(steps) / STEPS_PER_S
    sides = np.column_stack([turned[:, [0, 2]].mean(axis=1), turned[:, [1, 3]].mean(axis=1)])
    count = 2 * math.pi / robot.counts_per_turn
    rng = np.random.default_rng([seed, 3131])

    def stamped(times_s: Array) -> Array:
        """Times as a host has them, in order: none overtakes another on a bus."""
        return np.sort(times_s + np.abs(rng.normal(0.0, habits.jitter_s, times_s.size)))

    def kept(every: int) -> NDArray[np.int64]:
        """Steps of which something is read and not lost."""
        at = np.arange(0, steps, every)
        return at[rng.random(at.size) >= habits.lost]

    read, seen = kept(STEPS_PER_READING * habits.reading_every), kept(STEPS_PER_POSE * habits.pose_every)
    noise = np.random.default_rng([seed, 1234]).standard_normal((seen.size, 3))
    noise *= [robot.position_std_m, robot.position_std_m, robot.yaw_std_rad]
    pose = where[seen] + noise
    pose[:, 2] = np.arctan2(np.sin(pose[:, 2]), np.cos(pose[:, 2]))
    latency_s = hidden.get("pose_latency", 0.0)
    inside = seen / STEPS_PER_S + latency_s <= now_s[-1]
    sent = np.arange(0, command.shape[0], habits.command_every)
    return Recording(
        command_s=stamped(sent * STEPS_PER_COMMAND / STEPS_PER_S),
        command=command[sent],
        wheel_s=stamped(now_s[read]),
        angle=np.round(sides[read] / count) * count,
        pose_s=stamped(seen[inside] / STEPS_PER_S + latency_s),
        pose=pose[inside],
        truth_s=now_s,
        truth=where,
        turned=turned,
        noise=noise[inside],
        hidden=dict(hidden),
        robot=robot,
    )
