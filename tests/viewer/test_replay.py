import pytest

from disco_hw.viewer.pages import ReplayPage, _spread
from disco_hw.viewer.server import serving
from disco_hw.viewer.timeline import EVENT, GATED, Mark
from tools.viewer_run import pose_at


@pytest.fixture
def page(recording):
    with serving("test", port=0) as served:
        yield ReplayPage(served.server, recording)


def robot_place(page):
    return tuple(page.scene._robot.position[:2])


def test_it_begins_at_the_beginning(page):
    page.step(0.05)
    assert page.t_s == 0.0
    assert robot_place(page) == pytest.approx(pose_at(0)[:2])


def test_it_goes_where_it_is_told_within_the_log(page, recording):
    page.go_to(1.0)
    page.step(0.05)
    assert robot_place(page) == pytest.approx(pose_at(50)[:2])
    assert page._slider.value == 1.0
    page.go_to(99.0)
    page.step(0.05)
    assert page.t_s == recording.duration_s
    page.go_to(-1.0)
    assert page.t_s == 0.0


def test_it_steps_by_ticks(page):
    page.go_to(1.0)
    page.step_ticks(1)
    assert page.t_s == pytest.approx(1.02)
    page.step_ticks(-10)
    assert page.t_s == pytest.approx(0.82)
    page.step_ticks(-1000)
    assert page.t_s == 0.0


def test_it_plays_at_its_speed_and_stops_at_the_end(page, recording):
    page._play(True)
    page._speed = 2.0
    for _ in range(10):
        page.step(0.05)
    assert page.t_s == pytest.approx(1.0)
    assert robot_place(page) == pytest.approx(pose_at(50)[:2])
    for _ in range(40):
        page.step(0.05)
    assert page.t_s == recording.duration_s
    assert not page.playing
    assert page._play_button.label == "Play"


def test_a_hidden_layer_is_hidden(page):
    page.go_to(2.0)
    page.step(0.0)
    shown = [name for name, line in page.scene._lines.items() if line.visible]
    assert set(shown) == {"trail", "fan", "points", "plan", "ellipse", "centre", "poses"}
    page.scene.layers |= {"plan": False, "robot": False}
    page._redraw()
    page.step(0.0)
    assert not page.scene._lines["plan"].visible
    assert not page.scene._robot.visible


def test_too_many_marks_are_thinned_with_the_grave_ones_kept():
    many = [Mark(t, GATED, "") for t in range(1000)]
    kept = _spread((*many, Mark(500, EVENT, "fell over")), 40)
    assert len(kept) == 40
    assert any(mark.kind == EVENT for mark in kept)
    assert [mark.t_ns for mark in kept] == sorted(mark.t_ns for mark in kept)
    assert _spread((), 40) == []
