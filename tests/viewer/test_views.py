"""Tests of where the camera is put, and whom it follows; the browser's part is in test_page.py."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer.scene import first_camera
from disco_hw.viewer.server import serving
from disco_hw.viewer.views import FOLLOW, FREE, TOP, ScrubBar, Views, floor_under, moved, top_camera

TASK = CircleTask(center_x_m=2.0, center_y_m=-1.0, radius_m=3.0)


def browser(number):
    camera = SimpleNamespace(position=(2.0, -5.0, 4.0), look_at=(2.0, -1.0, 0.0))
    return SimpleNamespace(client_id=number, camera=camera, atomic=nullcontext)


@pytest.fixture
def seen():
    """Two browsers on one page, and the views of it."""
    with serving("test", port=0) as page:
        views = Views(page.server, TASK)
        clients = {0: browser(0), 1: browser(1)}
        views._clients = lambda: clients
        yield views, clients


def test_from_the_top_the_whole_task_is_seen():
    eye, look_at = top_camera(TASK)
    assert look_at == (2.0, -1.0, 0.0)
    assert eye[:2] == pytest.approx(look_at[:2], abs=0.02)
    assert eye[2] > 2.0 * TASK.radius_m


def test_a_camera_is_carried_without_being_turned():
    assert moved(((2.0, -5.0, 4.0), (2.0, -1.0, 0.0)), (0.0, 0.0)) == ((0.0, -4.0, 4.0), (0.0, 0.0, 0.0))


def test_only_who_chose_to_follow_is_carried_along_until_he_chooses_otherwise(seen):
    views, clients = seen
    views.follow((1.0, 1.0, 0.0))
    views.choose(clients[1], FOLLOW)
    assert clients[1].camera.look_at == (1.0, 1.0, 0.0)
    views.follow((2.0, 2.0, 0.0))
    assert clients[1].camera.look_at == (2.0, 2.0, 0.0)
    assert clients[1].camera.position == (2.0, -2.0, 4.0)
    assert clients[0].camera.look_at == (2.0, -1.0, 0.0)
    views.choose(clients[1], TOP)
    views.follow((3.0, 3.0, 0.0))
    assert (clients[1].camera.position, clients[1].camera.look_at) == top_camera(TASK)
    views.choose(clients[1], FREE)
    assert (clients[1].camera.position, clients[1].camera.look_at) == first_camera(TASK)


def test_the_bar_is_as_wide_as_the_picture_and_shows_the_time():
    with serving("test", port=0) as page:
        bar = ScrubBar(page.server, 10.0, (1.0, 2.0), lambda _t_s: None)
        placed = []
        panel = SimpleNamespace(float=lambda **where: placed.append(where["width"]))
        slider = SimpleNamespace(value=0.0)
        bar._bars[7] = (panel, slider)
        for width_px in (1000, 1000, 390, 0):
            bar._fit(7, width_px)
        assert placed == [976.0, 366.0]
        bar.show(3.1234)
        assert slider.value == 3.123
        bar._remove(SimpleNamespace(client_id=7))
        bar.show(4.0)
        assert slider.value == 3.123


def test_the_floor_is_under_what_is_seen_where_the_look_goes_down():
    assert floor_under((0.0, -4.0, 2.0), (1.0, -2.0, 1.0)) == pytest.approx((2.0, 0.0))
    assert floor_under((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)) is None
