import math
import typing

import msgspec
import pytest

from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.log.mcap_log import VIEWS, scene_message, views
from disco_hw.log.records import Command, Estimate, Event, Fan, GuardVerdict, Level, Plan
from disco_hw.runtime.robot_setup import scene_of
from drivers.types import PoseSample

WALL_NS = 1_700_000_000_123_456_789
CLASSES = dict(VIEWS)
FOOTPRINT = Footprint(0.5, 0.4, 0.05)


def shown(record):
    found = {}
    for topic, data in views(record, WALL_NS):
        found[topic] = CLASSES[topic]()
        found[topic].ParseFromString(data)
    return found


def estimate(x_m=1.0, y_m=2.0, yaw_rad=0.5):
    return Estimate(1, x_m, y_m, yaw_rad, (0.0,) * 9, 0.0, 0.0, 0.0, 0.0)


def test_an_estimate_is_a_pose_and_a_transform_at_wall_time():
    found = shown(estimate())
    pose, transform = found["/view/estimate"], found["/view/transform"]
    assert (pose.timestamp.seconds, pose.timestamp.nanos) == (1_700_000_000, 123_456_789)
    assert (pose.frame_id, transform.parent_frame_id, transform.child_frame_id) == ("world", "world", "robot")
    assert (pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) == (1.0, 2.0, 0.0)
    assert (transform.translation.x, transform.translation.y) == (1.0, 2.0)
    for rotation in (pose.pose.orientation, transform.rotation):
        assert 2.0 * math.atan2(rotation.z, rotation.w) == pytest.approx(0.5)
        assert (rotation.x, rotation.y) == (0.0, 0.0)


def test_a_measured_pose_and_a_plan_are_poses():
    found = shown(PoseSample(1, 2, 3.0, 4.0, -1.0, 0.01, 0.02)) | shown(
        Plan(1, 1, 0.1, (), (), path_x_m=(0.0, 1.0), path_y_m=(2.0, 3.0), path_yaw_rad=(0.0, 0.5))
    )
    measured, plan = found["/view/measured_pose"], found["/view/plan"]
    assert (measured.pose.position.x, measured.pose.position.y) == (3.0, 4.0)
    assert [(pose.position.x, pose.position.y) for pose in plan.poses] == [(0.0, 2.0), (1.0, 3.0)]


@pytest.mark.parametrize("level", typing.get_args(Level))
def test_every_level_of_an_event_has_its_own(level):
    log = shown(Event(1, level, "bus-off", "the bus is off"))["/view/log"]
    assert CLASSES["/view/log"].Level.Name(log.level) == level.upper()
    assert (log.name, log.message) == ("bus-off", "the bus is off")


@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
def test_a_broken_estimate_is_shown_as_broken(broken):
    pose = shown(estimate(x_m=broken, yaw_rad=broken))["/view/estimate"].pose
    assert not math.isfinite(pose.position.x)
    assert math.isnan(pose.orientation.w)


def test_rollouts_are_lines_the_fainter_the_less_they_weigh():
    scene = shown(Fan(1, (0.5, 0.25), (0.0, 1.0, 2.0, 3.0), (4.0, 5.0, 6.0, 7.0)))["/view/rollouts"]
    heavy, light = scene.entities[0].lines
    assert [(point.x, point.y) for point in heavy.points] == [(0.0, 4.0), (1.0, 5.0)]
    assert [(point.x, point.y) for point in light.points] == [(2.0, 6.0), (3.0, 7.0)]
    assert (heavy.color.a, light.color.a) == pytest.approx((1.0, 0.575))


@pytest.mark.parametrize(
    ("fan", "points"),
    [
        (Fan(1, (0.0,), (1.0, 2.0), (3.0, 4.0)), 2),
        (Fan(1, (math.nan,), (math.nan, math.inf), (3.0, 4.0)), 2),
        (Fan(1, (1.0,), (1.0, 2.0), (3.0,)), 1),
        (Fan(1, (1.0,), (), (3.0,)), 0),
    ],
)
def test_broken_rollouts_are_shown_as_far_as_they_go(fan, points):
    (line,) = shown(fan)["/view/rollouts"].entities[0].lines
    assert len(line.points) == points


def points_of(line):
    return [(point.x, point.y) for point in line.points]


def test_the_scene_shows_the_fence_in_the_world_and_the_footprint_on_the_robot():
    config = load_robot_config(SHIPPED_ROBOT)
    corners = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5))
    fence = Fence(keep_in=corners, keep_out=(Circle((0.0, 0.0), 0.3),))
    robot = msgspec.structs.replace(config.robot, footprint_m=FOOTPRINT)
    config = msgspec.structs.replace(config, robot=robot, fence=fence)
    update = CLASSES["/view/fence"]()
    update.ParseFromString(scene_message(scene_of(config)))
    task, body = update.entities
    _, keep_in, pillar = task.lines
    assert points_of(keep_in) == [*corners, corners[0]]
    assert {round(math.hypot(x, y), 9) for x, y in points_of(pillar)} == {0.3}
    (outline,) = body.lines
    assert (body.frame_id, body.frame_locked) == ("robot", True)
    assert points_of(outline)[:4] == [pytest.approx(corner) for corner in FOOTPRINT.corners_m()]
    assert points_of(outline)[4] == points_of(outline)[0]


@pytest.mark.parametrize(("verdict", "is_red"), [("free", False), ("scaled", False), ("stopped", True)])
def test_the_stopping_path_is_red_where_the_guard_holds_the_robot(verdict, is_red):
    found = GuardVerdict(
        1, verdict, 0.5, 0.1, path_x_m=(0.0, 0.2), path_y_m=(1.0, 1.1), path_yaw_rad=(0.0, 0.1),
        obstacles=(1.0, 2.0, 0.3, 4.0, 5.0, 0.6),
    )  # fmt: skip
    (entity,) = shown(found)["/view/fence"].entities
    (path,) = entity.lines
    assert points_of(path) == [(0.0, 1.0), (0.2, 1.1)]
    assert (path.color.r > path.color.g) is is_red
    assert [(one.pose.position.x, one.pose.position.y, one.size.x) for one in entity.cylinders] == [
        (1.0, 2.0, 0.6),
        (4.0, 5.0, 1.2),
    ]


def test_nothing_is_shown_of_a_plan_without_path_or_a_command():
    assert views(Plan(1, 1, 0.1, (1.0,), (1.0,)), WALL_NS) == []
    assert views(Command(1, 0.0, 0.0, 0.0, 0.0, 0.1, True), WALL_NS) == []
