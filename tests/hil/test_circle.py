"""The paper's circle, driven by the real daemon with the paper's posterior on a plant drawn from it."""

from __future__ import annotations

import json
import math
import re
import warnings
from pathlib import Path

import pytest
from mcap.reader import make_reader

import disco_hw
from tests.hil.stack import disco_here, disco_json_here

LAYOUT = Path(disco_hw.__file__).parent / "bridge" / "foxglove_layout.json"
pytestmark = pytest.mark.hil


# What is judged begins after a quarter lap.
@pytest.mark.parametrize(
    ("link", "plant_seed", "laps"),
    [
        ("can", 3, 0.5),
        pytest.param("serial", 4, 1.0, marks=pytest.mark.long),
    ],
)
def test_demo_follows_the_circle(tmp_path, link, plant_seed, laps):
    options = ["--link", link, "--laps", str(laps), "--plant-seed", str(plant_seed), "--out", str(tmp_path)]
    code, figures, errors = disco_json_here("demo", *options)
    assert code == 0, errors
    if "driving anew" in errors:
        warnings.warn(f"driven twice: {errors}", stacklevel=1)
    assert figures["success"]
    assert figures["circle"]["laps"] >= laps - 0.02
    assert figures["circle"]["settled_rms_distance_m"] < 0.02
    assert figures["estimation"]["rms_position_m"] < 0.01
    assert figures["estimation"]["rms_yaw_rad"] < math.radians(1.0)
    assert figures["frames"]["rejected"] == 0
    assert (tmp_path / "demo.mcap").stat().st_size > 100_000
    assert (tmp_path / "circle.png").read_bytes().startswith(b"\x89PNG")
    # The demonstration has no fence to show.
    assert shown_but_not_logged(tmp_path / "demo.mcap") == {"/view/fence"}
    code, output = disco_here("replay", "--json", str(tmp_path / "demo.mcap"))
    assert code == 0, output


def shown_but_not_logged(log):
    """What a panel of the shipped Foxglove layout shows and the log does not hold: topics, and fields of messages."""
    layout = LAYOUT.read_text(encoding="utf-8")
    panels = json.loads(layout)["configById"]
    fields = set(re.findall(r'"value": "(/[a-z/]+)\.([\w.]+)"', layout))
    topics = {topic for topic, _ in fields} | set(panels["3D!scene"]["topics"])
    topics |= {panels["RosOut!log"]["topicToRender"], panels["RawMessages!counters"]["topicPath"]}
    with log.open("rb") as opened:
        for _, channel, message in make_reader(opened).iter_messages(topics=list(topics)):
            topics.discard(channel.topic)
            for topic, path in [one for one in fields if one[0] == channel.topic]:
                if _at(json.loads(message.data), path) is not None:
                    fields.discard((topic, path))
    return topics | fields


def _at(message, path):
    for step in path.split("."):
        message = message.get(step) if isinstance(message, dict) else None
    return message
