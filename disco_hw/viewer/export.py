"""A log as one HTML file that plays in any browser, without Python and without a network."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from disco_hw.errors import InputError
from disco_hw.viewer.recording import Recording
from disco_hw.viewer.scene import Scene
from disco_hw.viewer.server import serving

PICTURES_PER_S = 10
_REDRAW_PICTURES = 5
_MOST_PICTURES = 6000
Progress = Callable[[float], None]


def export_html(recording: Recording, path: Path, progress: Progress) -> None:
    """Write the scene of the whole log, 10 pictures a second and at most 6000 of them, with a clock; no plots.

    `progress` gets the part done. Raises InputError if the file cannot be written.
    """
    count = min(max(1, math.ceil(recording.duration_s * PICTURES_PER_S)), _MOST_PICTURES)
    period_s = recording.duration_s / count
    # Serialising needs a server; nobody can reach this one but from this machine, and it is gone at the end.
    with serving(path.name, port=0) as page:
        drawn = Scene(page.server, recording.stage)
        clock = page.server.scene.add_label("/clock", "0.0 s", position=_clock_place(recording))
        serializer = page.server.get_scene_serializer()
        for number in range(count + 1):
            t_s = number * period_s
            drawn.show(recording.at(t_s), everything=number % _REDRAW_PICTURES == 0)
            clock.text = f"{t_s:.1f} s"
            serializer.insert_sleep(period_s)
            progress(number / count)
        text = serializer.as_html()
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give another name") from None


def _clock_place(recording: Recording) -> tuple[float, float, float]:
    course = recording.stage.task.course()
    x_m, y_m = course.middle_m
    return (x_m, y_m + 1.2 * course.reach_m, 0.2)
