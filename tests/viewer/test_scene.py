"""What of a snapshot is drawn, where and in which colour; the browser's part is in test_page.py."""

import math
from dataclasses import replace

import numpy as np
import pytest
from viser.infra import WebsockServer

from disco_hw.fence import Circle, Fence
from disco_hw.log import records
from disco_hw.log.records import GuardVerdict
from disco_hw.runtime.robot_setup import record_of
from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer import scene as scene_module
from disco_hw.viewer.recording import snapshot_at, stage_of_robot
from disco_hw.viewer.scene import LAYERS, Scene, first_camera
from disco_hw.viewer.server import serving
from disco_hw.viewer.timeline import Timeline
from tests.runtime.path_robot import path_robot
from tools.viewer_run import PERIOD_NS, ROBOT_FILE, START_NS, plan_at, pose_at

TICK = 150
FAN = records.Fan(
    START_NS + TICK * PERIOD_NS, (0.4, 0.1, 0.0), (0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.0, 0.1, 0.2),
    (0.0, 0.0, 0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.3),
)  # fmt: skip


FENCE = Fence(keep_in=((-2.0, -2.0), (2.0, -2.0), (0.0, 2.0)), keep_out=(Circle((0.5, 0.5), 0.2),))
GUARD = GuardVerdict(
    0, "free", 1.0, 0.5, path_x_m=(0.0, 0.1), path_y_m=(0.0, 0.0), path_yaw_rad=(0.0, 0.1), obstacles=(1.0, 0.0, 0.3)
)


@pytest.fixture(scope="module")
def stage():
    return replace(stage_of_robot(ROBOT_FILE), fence=FENCE)


@pytest.fixture
def scene(stage):
    with serving("test", port=0) as page:
        yield Scene(page.server, stage)


@pytest.fixture
def shot(timeline):
    cut = snapshot_at(timeline, START_NS + TICK * PERIOD_NS, plan_at(TICK))
    return replace(cut, fan=FAN, guard=GUARD)


def node(scene, layer):
    return {"task": scene._task, "robot": scene._robot, **scene._lines}[layer]


def test_every_layer_is_drawn_and_can_be_switched_off_and_on(scene, shot):
    scene.show(shot)
    assert {layer: node(scene, layer).visible for layer in LAYERS} == dict.fromkeys(LAYERS, True)
    for layer in LAYERS:
        scene.layers[layer] = False
        scene.show(shot)
        assert [name for name in LAYERS if not node(scene, name).visible] == [layer]
        scene.layers[layer] = True
    scene.show(shot)
    assert all(node(scene, layer).visible for layer in LAYERS)


def test_nothing_known_draws_the_task_alone(scene):
    scene.show(snapshot_at(Timeline(), 5, None))
    assert [layer for layer in LAYERS if node(scene, layer).visible] == ["task", "fence"]


def test_the_robot_is_to_scale_and_stands_at_its_pose_and_its_wheels_turn_as_measured(scene, shot, stage):
    scene.show(shot)
    x_m, y_m, yaw_rad = pose_at(TICK)
    assert scene._robot.position[:2] == pytest.approx((x_m, y_m))
    assert scene._robot.wxyz[0] == pytest.approx(math.cos(yaw_rad / 2))
    for wheel, angle in zip(scene._wheels, (*shot.wheel_angles, *shot.wheel_angles), strict=True):
        assert wheel.wxyz[2] == pytest.approx(math.sin(angle / 2), abs=1e-6)
    assert {tuple(np.sign(wheel.position[:2])) for wheel in scene._wheels} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    across = {round(abs(wheel.position[1]), 6) for wheel in scene._wheels}
    assert across == {round(stage.axial_distance_m / 2, 6)}
    assert {wheel.position[2] for wheel in scene._wheels} == {stage.wheel_radius_m}


def test_the_circle_is_the_tasks_and_follows_its_changes(scene, shot):
    def radii(x_m=0.0):
        points = np.asarray(scene._task.points)
        return np.hypot(points[..., 0] - x_m, points[..., 1])

    assert radii() == pytest.approx(0.75, abs=1e-5)
    scene.show(replace(shot, task=record_of(0, CircleTask(center_x_m=1.0, radius_m=0.5))))
    assert radii(1.0) == pytest.approx(0.5, abs=1e-5)
    scene.show(shot)
    assert radii() == pytest.approx(0.75, abs=1e-5)


def test_the_trail_is_coloured_by_the_distance_to_the_task_in_force(scene, shot):
    scene.show(shot)
    on_it = np.array(scene._lines["trail"].colors)[-1, 1]
    scene.show(replace(shot, task=record_of(0, CircleTask(radius_m=0.5))))
    off_it = np.asarray(scene._lines["trail"].colors)[-1, 1]
    assert tuple(on_it) == tuple(scene_module.distance_colours(np.zeros(1), scene_module.TRAIL_FULL_M)[0])
    assert tuple(off_it) == tuple(scene_module.distance_colours(np.full(1, 0.25), scene_module.TRAIL_FULL_M)[0])


def test_the_trail_lies_below_all_else_and_fades_behind_the_robot(scene, shot):
    scene.show(shot)

    def height(layer):
        return np.asarray(node(scene, layer).points)[..., 2].min()

    assert all(height("trail") < height(layer) for layer in ("task", "fan", "points", "plan", "poses"))
    assert height("task") < height("fan") < height("plan")
    around = np.linspace(0.0, 6.0 * math.pi, 600)
    laps = replace(shot, trail=0.75 * np.column_stack((np.cos(around), np.sin(around))))
    scene.show(laps)
    darkest = np.asarray(scene._lines["trail"].colors)[:, 0].astype(int).min(axis=1)
    assert (np.diff(darkest) <= 0).all()
    assert darkest[0] > 220
    assert darkest[-1] < 60
    scene.background = scene_module.DARK
    scene.show(laps)
    assert np.asarray(scene._lines["trail"].colors)[0, 0].max() < 60


def test_the_trail_has_few_points_and_is_nowhere_beside_what_was_driven(scene, shot):
    laps = np.linspace(0.0, 40.0 * math.pi, 15_000)
    driven = 0.75 * np.column_stack((np.cos(laps), np.sin(laps)))
    standing = np.repeat(driven[-1:], 3000, axis=0)
    scene.show(replace(shot, trail=np.concatenate((driven, standing))))
    points = np.asarray(scene._lines["trail"].points)[..., :2]
    assert len(points) < 900
    assert np.array_equal(points[1:, 0], points[:-1, 1])
    assert points[0, 0] == pytest.approx(driven[0])
    assert points[-1, 1] == pytest.approx(driven[-1])
    off_m = 0.75 - np.hypot(*points.mean(axis=1).T)
    assert off_m.max() < 0.005
    assert off_m[-190:].max() < 0.0005


def test_a_growing_trail_keeps_the_points_near_the_robot():
    around = np.linspace(0.0, 2.0 * math.pi, 600)
    driven = 0.75 * np.column_stack((np.cos(around), np.sin(around)))
    shorter, longer = (scene_module.sparse(driven[:count], 0.75) for count in (550, 600))
    assert longer[: len(shorter) - 1].tolist() == shorter[:-1].tolist()


def test_nothing_is_drawn_that_costs_a_browser_without_a_graphics_card_ten_times_as_much(stage, monkeypatch):
    sent = []
    queue = WebsockServer.queue_message
    monkeypatch.setattr(
        WebsockServer, "queue_message", lambda self, message: (sent.append(message), queue(self, message))[1]
    )
    with serving("test", port=0) as page:
        Scene(page.server, stage)
    lines = [message.props.thickness_units for message in sent if hasattr(message, "props")
             and hasattr(message.props, "thickness_units")]  # fmt: skip
    assert len(lines) == 13
    assert set(lines) == {"screen"}
    assert not any(type(message).__name__ == "GridMessage" for message in sent)
    by_type = {type(message).__name__: message for message in sent}
    assert not by_type["EnableLightsMessage"].cast_shadow
    assert by_type["EnvironmentMapMessage"].hdri_data is None


def test_the_grid_has_a_line_every_metre_and_is_seen_in_the_dark_as_the_turning_centre_is(scene, shot):
    cells, metres = scene_module.grid_lines((1.0, 2.0), 4.0, 0.5)
    assert len(metres) == 2 * 5
    assert len(cells) == 2 * 4
    assert {float(x_m) for x_m in metres[:5, 0, 0]} == {-1.0, 0.0, 1.0, 2.0, 3.0}
    assert metres[:5, :, 1].tolist() == [[0.0, 4.0]] * 5
    scene.background = scene_module.DARK
    scene.show(shot)
    assert max(np.asarray(lines.colors).max() for lines in scene._grid) < 90
    assert np.asarray(scene._lines["centre"].colors).min() > 180
    scene.background = scene_module.LIGHT
    scene.show(shot)
    assert min(np.asarray(lines.colors).min() for lines in scene._grid) > 180
    assert np.asarray(scene._lines["centre"].colors).max() == 0


def test_the_fan_is_shaded_by_weight_and_the_weightiest_lies_on_top(scene, shot):
    scene.show(shot)
    points, colours = np.asarray(scene._lines["fan"].points), np.asarray(scene._lines["fan"].colors).astype(int)
    assert points.shape == (6, 2, 3)
    assert points[0, 1, :2] == pytest.approx((0.1, 0.0))
    strengths = [255 - colours[2 * path, 0].min() for path in range(3)]
    assert strengths[0] > strengths[1] > strengths[2] > 0
    assert points[0, 0, 2] > points[2, 0, 2] > points[4, 0, 2]
    assert tuple(colours[0, 0]) == scene_module.LAYERS["fan"].colour
    for broken_or_none in (records.Fan(0, (0.5, 0.5), (1.0, 2.0, 3.0), (1.0, 2.0, 3.0)), None):
        scene.show(shot)
        assert scene._lines["fan"].visible
        scene.show(replace(shot, fan=broken_or_none))
        assert not scene._lines["fan"].visible


def test_an_adapted_belief_bends_the_plan_under_its_sigma_points(scene, shot, stage):
    scene.show(shot)
    before = np.asarray(scene._lines["points"].points).copy()
    names = ("x_icr_m", "wheel_radius_m", "axial_distance_m")
    change = records.BeliefChange(0, "adapted", names, (0.1, 0.05, 0.4), tuple(np.diag((1e-6, 1e-8, 1e-6)).ravel()))
    scene.show(replace(shot, belief=change))
    after = np.asarray(scene._lines["points"].points)
    assert np.abs(after[-1] - before[-1]).max() > 0.01
    scene.show(replace(shot, belief=records.BeliefChange(1, "model")))
    assert np.asarray(scene._lines["points"].points) == pytest.approx(before)


def test_long_lines_are_left_alone_where_only_movement_is_wanted(scene, shot, timeline):
    scene.show(shot)
    points = np.asarray(scene._lines["trail"].points)
    later = snapshot_at(timeline, START_NS + 190 * PERIOD_NS, plan_at(190))
    scene.show(later, everything=False)
    assert np.asarray(scene._lines["trail"].points).shape == points.shape
    assert scene._robot.position[:2] == pytest.approx(pose_at(190)[:2])


def test_the_first_camera_sees_the_whole_task():
    task = CircleTask(center_x_m=2.0, center_y_m=-1.0, radius_m=3.0)
    eye, look_at = first_camera(task)
    assert look_at == (2.0, -1.0, 0.0)
    assert eye[2] > task.radius_m


def test_a_path_is_drawn_where_it_is_and_not_at_all_where_it_is_unknown(tmp_path, shot):
    stage = stage_of_robot(path_robot(tmp_path, "x_m,y_m\n3,0\n4,0\n4,1\n"))
    with serving("test", port=0) as page:
        scene = Scene(page.server, stage)
        scene.show(shot)
        np.testing.assert_allclose(np.asarray(scene._task.points)[:, :, :2], [[[3, 0], [4, 0]], [[4, 0], [4, 1]]])
        far = tuple(scene_module.distance_colours(np.ones(1), scene_module.TRAIL_FULL_M)[0])
        assert tuple(np.asarray(scene._lines["trail"].colors)[-1, 1]) == far
        scene.knows_task = False
        scene.show(shot)
        assert not scene._task.visible
    assert first_camera(stage.task)[1] == (3.5, 0.5, 0.0)
