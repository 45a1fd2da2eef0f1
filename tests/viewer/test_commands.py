"""Pictures, clips and exported pages of a log, and the pages as processes."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request

import numpy as np
import pytest
from PIL import Image

from disco_hw.cli.logs import view
from disco_hw.errors import InputError
from disco_hw.viewer import commands, picture, scene
from disco_hw.viewer.commands import export_log, in_figures, snapshot_log, video_log
from tests.tables import thinned
from tests.viewer.test_picture import count
from tools.viewer_run import FAULT_TICK


def pixels_of(image):
    return np.asarray(image.convert("RGB")).astype(int)


def test_a_snapshot_shows_circle_and_robot(log_file, tmp_path):
    snapshot_log(log_file, tmp_path / "end.png")
    snapshot_log(log_file, tmp_path / "start.png", at_s=0.0)
    end, start = (pixels_of(Image.open(tmp_path / f"{name}.png")) for name in ("end", "start"))
    assert count(end, scene.LAYERS["task"].colour) > 500
    assert count(end, scene.LAYERS["plan"].colour) > 50
    assert np.abs(end - start).max() > 100, "nothing moved"


@pytest.mark.thorough
@thinned(("ending", "kind"), [("gif", "GIF"), ("webp", "WEBP"), ("apng", "PNG")], quick=1)
def test_a_clip_moves_with_nothing_installed(log_file, tmp_path, monkeypatch, ending, kind):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    video_log(log_file, tmp_path / f"clip.{ending}", speed=20.0)
    clip = Image.open(tmp_path / f"clip.{ending}")
    assert (clip.format, clip.n_frames) == (kind, 3)
    clip.load()
    assert clip.info["duration"] == 100
    first = pixels_of(clip)
    assert count(first, scene.LAYERS["task"].colour, 40) > 200
    clip.seek(2)
    assert np.abs(pixels_of(clip) - first).max() > 100


def test_an_exported_page_is_whole(log_file, tmp_path):
    export_log(log_file, tmp_path / "run.html")
    text = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert text.lstrip().lower().startswith("<!doctype html")
    assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(?:https?:)?//', text)
    assert len(text) > 500_000


@pytest.mark.parametrize(
    ("write", "name", "message"),
    [
        (snapshot_log, "a.txt", "no such kind of picture"),
        (snapshot_log, "none/a.png", "no such directory"),
        (video_log, "a.avi", "no such kind of clip"),
        (video_log, "none/a.gif", "no such directory"),
        (export_log, "none/a.html", "no such directory"),
    ],
)
def test_a_name_that_cannot_be_written_is_told(log_file, tmp_path, write, name, message):
    with pytest.raises(InputError, match=message):
        write(log_file, tmp_path / name)


def test_mp4_needs_ffmpeg(log_file, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"writing \.mp4 needs ffmpeg; install it, or pip install 'disco-hw\[video"):
        video_log(log_file, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.skipif(picture._ffmpeg() is None, reason="no ffmpeg: install it, or pip install 'disco-hw[video]'")
def test_an_mp4_is_written_and_has_every_picture(log_file, tmp_path):
    video_log(log_file, tmp_path / "a.mp4", speed=40.0)
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"
    into = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run(
        [picture._ffmpeg(), "-v", "error", "-i", str(tmp_path / "a.mp4"), *into], capture_output=True, check=True
    )
    pictures = np.frombuffer(read.stdout, np.uint8).reshape(-1, 448, 784, 3).astype(int)
    assert len(pictures) == 2
    assert count(pictures[0], scene.LAYERS["task"].colour, 39) > 200
    assert np.abs(pictures[1] - pictures[0]).max() > 100


def test_a_log_in_figures_has_every_mark(recording):
    figures = in_figures(recording)
    assert figures["ticks"] == 200
    assert figures["duration_s"] == pytest.approx(3.98)
    found = {mark["kind"]: mark["t_s"] for mark in figures["marks"]}
    assert found["fault"] == pytest.approx(FAULT_TICK * 0.02)
    assert set(found) == {"event", "fault", "overrun", "rejected frames", "pose rejected"}
    json.dumps(figures)


def test_json_is_one_object_on_standard_output(log_file, tmp_path, capsys):
    view(log_file, snapshot=tmp_path / "a.png", as_json=True)
    assert json.loads(capsys.readouterr().out) == {"written": [str(tmp_path / "a.png")]}


def test_a_clip_without_end_is_refused(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "_LONGEST_IN_MEMORY_S", 1.0)
    with pytest.raises(InputError, match="--speed to at least 4"):
        picture.draw_clip(recording, tmp_path / "a.gif", 1.0, lambda part: None)


def status_of(page):
    """What a page answers a browser: its address carries the token, a cookie keeps it."""
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with browser.open(page, timeout=60) as response:
        return response.status


def test_a_page_is_served_until_it_is_told_to_end(log_file, monkeypatch, capsys):
    statuses, print_served = [], commands._print_served

    def visit(page):
        try:
            statuses.append(status_of(page))
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    def printed(report, as_json):
        print_served(report, as_json)
        threading.Thread(target=visit, args=[report["page"]]).start()

    monkeypatch.setattr(commands, "_print_served", printed)
    assert commands.view_log(log_file, port=0, as_json=True) == 0
    assert statuses == [200]
    report = json.loads(capsys.readouterr().out)
    assert report["ticks"] == 200
    with pytest.raises(OSError, match=r"refused|closed"):
        status_of(report["page"])


@pytest.mark.thorough
def test_the_process_of_a_page_ends_when_it_is_told_to(log_file):
    code = "import sys; from pathlib import Path; from disco_hw.viewer.commands import view_log\n"
    code += f"sys.exit(view_log(Path({str(log_file)!r}), port=0, as_json=True))"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        report = json.loads(line)
        assert report["ticks"] == 200
        assert status_of(report["page"]) == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert process.stdout.read() == ""
    finally:
        process.kill()
        process.wait()
