"""A script fits itself into the fence from where the robot stands, or says how much room it needs."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from disco_hw.drive import ManualInput, RobotView
from disco_hw.drive.fit import FittedScriptSource, ScriptDoesNotFit, ScriptGeometry, driven_path, fit_script
from disco_hw.drive.script import Manoeuvre, Room, Script, ScriptSource
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime import State

ROBOT = ScriptGeometry(0.06, 0.4, 0.1)
FOOTPRINT = Footprint(0.5, 0.4, 0.05)
ROOM_NEEDED = Room((-0.5, 2.5), (-1.0, 1.0))
CENTER = (0.0, 0.0, 0.0)


def straight(name="straight", seconds=5.0, **fields) -> Manoeuvre:
    return Manoeuvre(name, "speed", seconds, lambda t_s: (5.0, 5.0), **fields)


def bend() -> Manoeuvre:
    return Manoeuvre("bend", "turning", 4.0, lambda t_s: (2.0, 5.0))


def fitted(script: Script, fence: Fence, pose=CENTER) -> Script:
    *_, last = fit_script(script, pose, ROBOT, Boundaries(FOOTPRINT, fence), ROOM_NEEDED)
    assert last is not None
    return last


def least_m(script: Script, fence: Fence, pose=CENTER) -> float:
    least, bounds = math.inf, Boundaries(FOOTPRINT, fence)
    for manoeuvre in script.manoeuvres:
        path = driven_path(manoeuvre, pose, ROBOT)
        pose = tuple(path[-1].tolist())
        least = min(least, float(bounds.clearance_m(path).min()))
    return least


def test_a_path_is_that_of_the_wheels():
    ahead = driven_path(straight(), (1.0, 2.0, math.pi / 2), ROBOT)
    np.testing.assert_allclose(ahead[[0, -1]], [[1.0, 2.0, math.pi / 2], [1.0, 3.5, math.pi / 2]], atol=1e-12)
    turned = driven_path(Manoeuvre("spin", "", 2.0, lambda t_s: (-2.0, 2.0)), CENTER, ROBOT)
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


def test_limits_are_found_before_what_is_scaled_into_them():
    manoeuvres = (straight("a", finds_limits=True), straight("b", within_limits=True), straight("c"))
    found = fitted(Script("s", manoeuvres), Fence(keep_in=Circle((0, 0), 2.2)))
    names = [one.name for one in found.manoeuvres]
    assert names.index("a") < names.index("b")


def test_a_script_that_fits_nowhere_says_how_much_room_it_needs():
    with pytest.raises(ScriptDoesNotFit, match=r"does not fit .* needs about 2.5 m ahead, 0.5 m behind"):
        fitted(Script("long", (straight(seconds=20.0),)), Fence(keep_in=Circle((0, 0), 0.8)))


class Held:
    """A deadman that is always held."""

    ended = None
    completed = False
    words = "held"
    task = ""

    def poll(self, now_ns, robot):
        return ManualInput(now_ns, 0.0, 0.0, deadman=True)

    def close(self):
        pass


def source(fence: Fence, *manoeuvres: Manoeuvre) -> FittedScriptSource:
    return FittedScriptSource(Script("s", manoeuvres), Held(), ROBOT, Boundaries(FOOTPRINT, fence), ROOM_NEEDED)


def test_the_deadman_is_open_until_the_script_fits():
    fits = source(Fence(keep_in=Circle((0, 0), 9.0)), straight(), bend())
    assert not fits.poll(0, RobotView(State.READY, False)).deadman
    assert fits.words.startswith("waiting for a pose")
    inputs = [fits.poll(k, RobotView(State.READY, False, pose=CENTER)) for k in range(5)]
    held = [one.deadman for one in inputs]
    assert [False, True] in [list(pair) for pair in pairwise(held)]
    assert held[-1]
    assert fits.ended is None


def test_a_script_that_does_not_fit_ends_before_anything_moves():
    refused = source(Fence(keep_in=Circle((0, 0), 0.8)), straight(seconds=20.0))
    for k in range(20):
        assert not refused.poll(k, RobotView(State.READY, False, pose=CENTER)).deadman
    assert refused.ended.startswith("script s does not fit into the fence")
    assert not refused.completed


def test_a_script_that_the_fence_stops_ends_and_is_not_complete():
    playing = ScriptSource(Script("s", (straight("far"),)), Held())
    assert playing.poll(0, RobotView(State.ARMED, True)).deadman
    stopped = playing.poll(20_000_000, RobotView(State.ARMED, True, fence_stopped=True))
    assert not stopped.deadman
    assert playing.ended == "the fence stopped the script s in far; see the event before it"
    assert not playing.completed
