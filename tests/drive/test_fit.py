"""A script fits itself into the fence from where the robot stands, or says how much room it needs."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.drive import ManualInput, RobotView, fit
from disco_hw.drive.fit import FittedScriptSource, ScriptDoesNotFit, fit_script
from disco_hw.drive.hand_pilot import Deadman
from disco_hw.drive.script import (
    Manoeuvre,
    RobotModel,
    Room,
    Script,
    ScriptSource,
    Unattended,
    driven_path,
    room_needed,
)
from disco_hw.drive.scripts import create_script
from disco_hw.estimation.odometry import OdometryParameters, Pose, arc, moved
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import Governor, WheelLimits
from disco_hw.runtime.robot_setup import load_setup

ROBOT = RobotModel(OdometryParameters(0.06, 0.4, 0.1), math.inf)
FOOTPRINT = Footprint(0.5, 0.4, 0.05)
ROOM_NEEDED = Room((-0.5, 2.5), (-1.0, 1.0))
CENTER = (0.0, 0.0, 0.0)


def straight(name="straight", seconds=5.0, **fields) -> Manoeuvre:
    return Manoeuvre(name, "speed", seconds, lambda t_s: (5.0, 5.0), **fields)


def bend() -> Manoeuvre:
    return Manoeuvre("bend", "turning", 4.0, lambda t_s: (2.0, 5.0))


def shipped(name: str) -> Script:
    setup = load_setup(SHIPPED_ROBOT)
    return create_script(name, setup.config.robot, setup.config.task, 0.6)


def fitted(script: Script, fence: Fence, pose=CENTER) -> Script:
    *_, last = fit_script(script, pose, ROBOT, Boundaries(FOOTPRINT, fence), ROOM_NEEDED)
    assert last is not None
    return last


def least_m(script: Script, fence: Fence, pose=CENTER) -> float:
    least, bounds = math.inf, Boundaries(FOOTPRINT, fence)
    for manoeuvre in script.manoeuvres:
        path, _ = driven_path(manoeuvre, pose, ROBOT)
        pose = tuple(path[-1].tolist())
        least = min(least, float(bounds.clearance_m(path).min()))
    return least


def test_a_path_is_that_of_the_wheels():
    ahead, _ = driven_path(straight(), (1.0, 2.0, math.pi / 2), ROBOT)
    np.testing.assert_allclose(ahead[[0, -1]], [[1.0, 2.0, math.pi / 2], [1.0, 3.5, math.pi / 2]], atol=1e-12)
    turned, _ = driven_path(Manoeuvre("spin", "", 2.0, lambda t_s: (-2.0, 2.0)), CENTER, ROBOT)
    assert turned[-1, 2] == pytest.approx(0.06 * 4.0 / 0.4 * 2.0)
    # About a point ahead of the tracked one.
    centre = turned[:, :2] + 0.1 * np.stack([np.cos(turned[:, 2]), np.sin(turned[:, 2])], axis=1)
    np.testing.assert_allclose(centre, np.broadcast_to([0.1, 0.0], centre.shape), atol=1e-12)


def test_what_fits_as_it_is_stays_as_it_is():
    script = Script("s", (straight(), bend()))
    assert fitted(script, Fence(keep_in=Circle((0, 0), 9.0))).manoeuvres == script.manoeuvres


@pytest.mark.parametrize("size", [1.6, 1.9, 2.4])
def test_a_script_is_turned_round_and_reordered_until_it_stays_inside(size):
    script = Script("s", (straight("one"), straight("two"), bend(), straight("three"), bend()))
    fence = Fence(keep_in=((-size, -size), (size, -size), (size, size), (-size, size)))
    found = fitted(script, fence)
    assert sorted(one.name for one in found.manoeuvres) == sorted(one.name for one in script.manoeuvres)
    assert found.duration_s == script.duration_s
    assert least_m(found, fence) >= 0.05 + 0.08
    assert least_m(script, fence) < 0.0
    notes = " ".join(one.purpose for one in found.manoeuvres)
    assert "backward" in notes or "mirrored" in notes or "at " in notes


@pytest.mark.parametrize(("name", "side_m"), [("excite", 2.5), ("steps", 2.5), ("separate", 2.0), ("curves", 2.5)])
def test_the_shipped_scripts_fit_into_a_small_room(name, side_m):
    half, script = 0.5 * side_m, shipped(name)
    fence = Fence(keep_in=((-half, -half), (half, -half), (half, half), (-half, half)))
    found = fitted(script, fence, (0.0, 0.0, 0.3))
    assert sorted(one.name for one in found.manoeuvres) == sorted(one.name for one in script.manoeuvres)
    assert least_m(found, fence, (0.0, 0.0, 0.3)) >= 0.05 + 0.08
    assert least_m(script, fence, (0.0, 0.0, 0.3)) < 0.05 + 0.08


def test_slow_wheels_stay_inside_too():
    setup = load_setup(SHIPPED_ROBOT)
    slow = msgspec.structs.replace(setup.config.robot, max_wheel_acceleration_rad_s2=2.0)
    script = create_script("separate", slow, setup.config.task, 0.8)
    bounds = Boundaries(FOOTPRINT, Fence(keep_in=((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))))
    model = RobotModel(ROBOT.geometry, 2.0)
    *_, found = fit_script(script, CENTER, model, bounds, room_needed(script, slow))
    governor, pose, path = Governor(WheelLimits(8.0, 2.0, 2.0), 0.02), Pose(*CENTER), []
    for k in range(round(found.duration_s / 0.02)):
        sent = governor.step(*found.at(k * 0.02), 0.02)
        pose = moved(pose, arc(ROBOT.geometry, sent.left_rad_s * 0.02, sent.right_rad_s * 0.02))
        path.append((pose.x_m, pose.y_m, pose.yaw_rad))
    assert bounds.clearance_m(np.array(path)).min() > 0.05


def test_limits_are_found_before_what_is_scaled_into_them():
    manoeuvres = (straight("a", finds_limits=True), straight("b", within_limits=True), straight("c"))
    found = fitted(Script("s", manoeuvres), Fence(keep_in=Circle((0, 0), 2.2)))
    names = [one.name for one in found.manoeuvres]
    assert names.index("a") < names.index("b")


@pytest.mark.parametrize(("x_m", "fits"), [(1.65, True), (1.72, False)])
def test_from_beside_the_fence_a_script_leads_away_from_it_but_not_from_outside(x_m, fits):
    room = Fence(keep_in=((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)))
    script = Script("s", (straight(seconds=2.0),))
    assert least_m(script, room, (x_m, 0.0, 0.0)) < 0.0
    assert (0.0 < 2.0 - x_m - 0.3 < 0.13) is fits
    if not fits:
        with pytest.raises(ScriptDoesNotFit):
            fitted(script, room, (x_m, 0.0, 0.0))
        return
    assert "backward" in fitted(script, room, (x_m, 0.0, 0.0)).manoeuvres[0].purpose


def test_a_script_that_fits_nowhere_says_how_much_room_it_needs():
    with pytest.raises(ScriptDoesNotFit, match=r"does not fit .* needs about 2.5 m ahead, 0.5 m behind"):
        fitted(Script("long", (straight(seconds=20.0),)), Fence(keep_in=Circle((0, 0), 0.8)))


class AlwaysPressed:
    """A deadman that is always held."""

    ended = None
    completed = False
    status_text = "held"
    task = ""
    deadman = True

    def poll(self, now_ns, robot):
        return ManualInput(now_ns, 0.0, 0.0, self.deadman)

    def close(self):
        pass


def drive(source: FittedScriptSource, robot: RobotModel, bounds: Boundaries) -> float:
    """Let a robot with another geometry obey until the source ends; returns its least clearance (m)."""
    pose, deadman, least = CENTER, False, math.inf
    for tick in range(20_000):
        given = source.poll(tick * 20_000_000, RobotView(State.ARMED, deadman, pose=pose))
        deadman = given.deadman
        wheels = (given.left_rad_s, given.right_rad_s) if deadman else (0.0, 0.0)
        path, _ = driven_path(Manoeuvre("tick", "", 0.02, lambda t_s, wheels=wheels: wheels), pose, robot)
        pose = tuple(path[-1].tolist())
        if tick % 10 == 0:
            least = min(least, float(bounds.clearance_m(path).min()))
        if source.ended is not None:
            return least
    raise AssertionError(source.status_text)


def test_a_robot_that_is_otherwise_than_its_model_is_fitted_anew_before_it_leaves_the_fence():
    fence = Fence(keep_in=((-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)))
    bounds, other = Boundaries(FOOTPRINT, fence), RobotModel(OdometryParameters(0.068, 0.36, 0.1), math.inf)
    script = shipped("steps")
    pose, planned = CENTER, math.inf
    for manoeuvre in fitted(script, fence).manoeuvres:
        path, _ = driven_path(manoeuvre, pose, other)
        pose, planned = tuple(path[-1].tolist()), min(planned, float(bounds.clearance_m(path).min()))
    playing = FittedScriptSource(script, AlwaysPressed(), ROBOT, bounds, ROOM_NEEDED)
    assert planned < 0.0
    assert drive(playing, other, bounds) > 0.0
    assert playing.completed
    assert playing.ended == "script steps completed"


def interrupted(playing: FittedScriptSource, ticks: int, again: Pose) -> ManualInput:
    """Fit, drive for so long, release the deadman, and press it with the robot at a pose; returns the last input."""
    views = 6 * [RobotView(State.READY, False, pose=CENTER)] + ticks * [RobotView(State.ARMED, True, pose=CENTER)]
    views += 3 * [RobotView(State.READY, False, pose=CENTER)]
    views += [
        RobotView(State.ARMED, False, pose=msgspec.structs.astuple(again)),
        RobotView(State.ARMED, True, pose=msgspec.structs.astuple(again)),
    ]
    return [playing.poll(tick * 20_000_000, view) for tick, view in enumerate(views)][-1]


@pytest.mark.parametrize("ticks", [0, 100])
def test_a_manoeuvre_that_begins_late_or_again_is_fitted_anew_where_it_would_leave_the_fence(ticks):
    script = straight("far", 4.0), straight("other", 1.0)
    assert interrupted(source(Fence(keep_in=Circle((0, 0), 2.4)), *script), ticks, Pose(0, 0, 0)).left_rad_s == 5.0
    playing = source(Fence(keep_in=Circle((0, 0), 2.4)), *script)
    held = interrupted(playing, ticks, Pose(1.2, 0.0, 0.0))
    assert (held.left_rad_s, held.right_rad_s, held.deadman) == (0.0, 0.0, True)
    for tick in range(4):
        view = RobotView(State.ARMED, True, pose=(1.2, 0.0, 0.0))
        held = playing.poll((ticks + 11 + tick) * 20_000_000, view)
    assert held.left_rad_s < 0.0
    assert "backward" in playing.task


def test_a_robot_that_was_moved_while_it_was_fitted_anew_is_fitted_once_more():
    playing = source(Fence(keep_in=Circle((0, 0), 2.4)), straight("far", 4.0), straight("other", 1.0))
    interrupted(playing, 100, Pose(1.2, 0.0, 0.0))
    # Pushed to the other side meanwhile, from where backward leads out.
    for tick in range(8):
        view = RobotView(State.ARMED, True, pose=(-1.2, 0.0, 0.0))
        held = playing.poll((111 + tick) * 20_000_000, view)
    assert held.left_rad_s > 0.0


def test_while_it_is_fitted_anew_the_robot_stands_and_the_deadman_counts():
    far = Manoeuvre("far", "", 4.0, lambda t_s: (5.0, 5.0))
    playing = source(Fence(keep_in=Circle((0, 0), 2.4)), straight(seconds=1.0), far)
    pose, deadman, given = CENTER, False, None
    for tick in range(30):
        given = playing.poll(tick * 20_000_000, RobotView(State.ARMED, deadman, pose=pose))
        deadman = given.deadman
    while playing.task.startswith("straight"):
        tick += 1
        given = playing.poll(tick * 20_000_000, RobotView(State.ARMED, True, pose=pose))
    # It is where it must not go on ahead.
    standstill = playing.poll((tick + 1) * 20_000_000, RobotView(State.ARMED, True, pose=(1.5, 0.0, 0.0)))
    assert (standstill.left_rad_s, standstill.right_rad_s, standstill.deadman) == (0.0, 0.0, True)
    for more in range(2, 6):
        given = playing.poll((tick + more) * 20_000_000, RobotView(State.ARMED, True, pose=(1.5, 0.0, 0.0)))
    assert given.left_rad_s < 0.0
    assert "backward" in playing.task


def test_wheels_that_still_run_count_in_what_leads_out_and_in_where_it_is_fitted_from(monkeypatch):
    starts = []
    monkeypatch.setattr(fit, "fit_script", lambda script, start, *_: iter([starts.append(start), script]))
    rest = Manoeuvre("rest", "", 0.6, lambda _t_s: (0.0, 0.0))
    playing = FittedScriptSource(
        Script("s", (straight(seconds=1.0), rest)),
        AlwaysPressed(),
        RobotModel(ROBOT.geometry, 2.0),
        Boundaries(FOOTPRINT, Fence(keep_in=Circle((0, 0), 2.4))),
        ROOM_NEEDED,
    )
    for tick in range(100):
        begun = playing.task.startswith("rest")
        # It runs at 0.3 m/s near the fence when the rest begins.
        view = (
            RobotView(State.ARMED, tick > 3, (5.0, 5.0), (1.9, 0.0, 0.0))
            if begun
            else RobotView(State.ARMED, tick > 3, (0.0, 0.0), CENTER)
        )
        playing.poll(tick * 20_000_000, view)
        if begun:
            break
    assert starts[0] == CENTER
    assert starts[1] == pytest.approx((1.9 + 0.375, 0.0, 0.0), abs=0.01)


def test_a_robot_that_came_to_where_nothing_fits_ends_the_script():
    playing = source(Fence(keep_in=Circle((0, 0), 2.4)), straight(seconds=1.0), straight("far", 4.0))
    deadman = False
    for tick in range(200):
        pose = (2.2, 0.0, 1.57) if playing.task.startswith("far") else CENTER
        deadman = playing.poll(tick * 20_000_000, RobotView(State.ARMED, deadman, pose=pose)).deadman
    assert not deadman
    assert playing.ended.startswith("script s does not fit into the fence")
    assert not playing.completed


def source(fence: Fence, *manoeuvres: Manoeuvre) -> FittedScriptSource:
    return FittedScriptSource(
        Script("s", manoeuvres), AlwaysPressed(), ROBOT, Boundaries(FOOTPRINT, fence), ROOM_NEEDED
    )


def test_the_deadman_is_open_until_the_script_fits():
    fits = source(Fence(keep_in=Circle((0, 0), 9.0)), straight(), bend())
    assert not fits.poll(0, RobotView(State.READY, False)).deadman
    assert fits.status_text.startswith("waiting for a pose")
    inputs = [fits.poll(k, RobotView(State.READY, False, pose=CENTER)) for k in range(5)]
    deadman_states = [one.deadman for one in inputs]
    assert [False, True] in [list(pair) for pair in pairwise(deadman_states)]
    assert deadman_states[-1]
    assert fits.ended is None


def test_a_deadman_held_before_the_script_fits_is_no_press():
    held_ns, deadman = 0, Deadman()
    fits = source(Fence(keep_in=Circle((0, 0), 9.0)), straight())

    def verdicts(ticks, pose):
        nonlocal held_ns
        for _ in range(ticks):
            held_ns += 20_000_000
            view = RobotView(State.READY, False, pose=pose)
            yield deadman.step(held_ns, fits.poll(held_ns, view), State.READY)

    assert not [verdict for verdict in verdicts(50, None) if verdict.requests]
    assert not [verdict for verdict in verdicts(50, CENTER) if verdict.requests]
    fits._deadman.deadman = False
    assert not [verdict for verdict in verdicts(2, CENTER) if verdict.requests]
    fits._deadman.deadman = True
    assert [verdict for verdict in verdicts(2, CENTER) if verdict.requests]


def test_a_deadman_that_ends_while_a_pose_is_waited_for_ends_the_script():
    fits = source(Fence(keep_in=Circle((0, 0), 9.0)), straight())
    polls = []
    fits._deadman.poll = lambda now_ns, _robot: polls.append(now_ns)
    assert fits.poll(0, RobotView(State.READY, False)) is None
    assert polls == [0]
    fits._deadman.ended = "the operator ended the drive at the keyboard"
    assert fits.ended == "the operator ended the drive at the keyboard"


def test_without_a_person_the_deadman_is_pressed_once_the_script_fits():
    fits, deadman, armed = source(Fence(keep_in=Circle((0, 0), 9.0)), straight()), Deadman(), []
    fits._deadman = Unattended()
    for tick in range(600):
        # Longer than it may stand once it is pressed.
        view = RobotView(State.READY, False, pose=CENTER if tick >= 500 else None)
        verdict = deadman.step(tick * 20_000_000, fits.poll(tick * 20_000_000, view), State.READY)
        armed += [tick] if verdict.requests else []
    assert armed[0] >= 500


def test_a_script_that_does_not_fit_ends_before_anything_moves():
    refused = source(Fence(keep_in=Circle((0, 0), 0.8)), straight(seconds=20.0))
    for k in range(20):
        assert not refused.poll(k, RobotView(State.READY, False, pose=CENTER)).deadman
    assert refused.ended.startswith("script s does not fit into the fence")
    assert not refused.completed


def test_a_script_that_the_fence_stops_ends_and_is_not_complete():
    playing = ScriptSource(Script("s", (straight("far"),)), AlwaysPressed())
    assert playing.poll(0, RobotView(State.ARMED, True)).deadman
    stopped = playing.poll(20_000_000, RobotView(State.ARMED, True, fence_stopped=True))
    assert not stopped.deadman
    assert playing.ended == "the fence stopped the script s in far; the event before this one says where"
    assert not playing.completed


def test_a_manoeuvre_that_was_fitted_anew_begins_at_its_beginning_however_long_the_fit_took():
    rising = Manoeuvre("rising", "for a test", 5.0, lambda t_s: (t_s, t_s))
    playing = ScriptSource(Script("s", (straight("first"),)), AlwaysPressed())
    view = RobotView(State.ARMED, True, pose=CENTER)
    for tick in range(5):
        playing.poll(tick * 20_000_000, view)
    playing.replace_remaining((rising,))
    assert playing.poll(200_000_000, view).left_rad_s == 0.0
    assert playing.poll(220_000_000, view).left_rad_s == pytest.approx(0.02)
