"""Pictures, clips and exported pages of a log, without a browser; test_commands.py has what is in an exported page."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from disco_hw.errors import InputError
from disco_hw.viewer import picture, scene
from tools.viewer_run import FAN_TICK


def count(pixels, colour, tolerance=12):
    """Count the pixels of a picture (height, width, 3) that have this colour."""
    return int((np.abs(pixels - colour).max(axis=2) <= tolerance).sum())


def pixels_of(recording, t_s, path):
    picture.draw_picture(recording, t_s, path)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def count_shades(pixels, colour, palest):
    """Pixels of this colour mixed with white, as those of the fan are by their weight."""
    missing = 255.0 - np.array(colour)
    part = (255.0 - pixels) / missing
    alike = np.ptp(part, axis=2) < 0.05
    return int((alike & (part.min(axis=2) > palest)).sum())


def test_every_layer_is_in_the_picture(recording, tmp_path):
    pixels = pixels_of(recording, FAN_TICK * 0.02 + 0.1, tmp_path / "a.png")
    assert count(pixels, scene.LAYERS["task"].colour) > 500
    assert count(pixels, scene.LAYERS["plan"].colour) > 50
    assert count_shades(pixels, scene.LAYERS["fan"].colour, 0.2) > 60
    assert count(pixels, scene.LAYERS["ellipse"].colour) > 10


def test_a_picture_of_a_robot_that_drives_backwards_shows_the_reference_backwards(recording):
    recording.stage = replace(recording.stage, drives_backwards=True)
    figure = picture._figure()
    picture._draw(figure, recording, 1.0)
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    assert set(lines["reference"].get_ydata()) == {-recording.stage.task.speed_m_s}


def test_a_longer_log_is_exported_with_pictures_further_apart(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "_MOST_PICTURES", 5)
    parts = []
    picture.export_html(recording, tmp_path / "run.html", parts.append)
    assert len(parts) == 6
    assert parts == sorted(parts)
    assert parts[-1] == 1.0


def test_an_export_to_where_nothing_can_be_written_is_told(recording, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        picture.export_html(recording, tmp_path / "none" / "run.html", lambda part: None)


def drawn(recording, t_s):
    """Titles, lines and areas of a picture."""
    figure = picture._figure()
    picture._draw(figure, recording, t_s)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    lines = [line.get_xydata() for axes in figure.axes for line in axes.get_lines()]
    areas = [patch.get_verts() for axes in figure.axes for patch in axes.patches]
    return titles, np.concatenate(lines), np.concatenate(areas)


def test_an_instant_before_the_log_and_one_after_it_are_its_ends(recording):
    for outside_s, end_s in ((-5.0, 0.0), (1e6, recording.duration_s)):
        for beyond, at_end in zip(drawn(recording, outside_s), drawn(recording, end_s), strict=True):
            np.testing.assert_array_equal(beyond, at_end)
    (start, *_), (end, *_) = drawn(recording, 0.0), drawn(recording, recording.duration_s)
    assert start != end


def test_a_clip_has_ten_pictures_a_second_and_tells_how_far_it_is(recording, tmp_path):
    parts = []
    picture.draw_clip(recording, tmp_path / "a.gif", 20.0, parts.append)
    assert Image.open(tmp_path / "a.gif").n_frames == 3
    assert parts == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("name", ["a", "a.exe"])
def test_a_picture_of_no_kind_is_refused_before_anything_is_written(recording, tmp_path, name):
    with pytest.raises(InputError, match="no such kind of picture"):
        picture.draw_picture(recording, 0.0, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
