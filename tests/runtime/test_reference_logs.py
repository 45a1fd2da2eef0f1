"""Logs of an earlier build are still read, and give the estimates, plans and commands that they gave then.

Where one does not on purpose, `python -m tools.generate.reference_logs` writes them anew.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from mcap.reader import make_reader

from disco_hw.control.plan import SAME_SINCE_VERSION
from disco_hw.estimation import filter  # noqa: A004 - the module's name
from disco_hw.estimation.odometry import arc
from disco_hw.log.reader import open_log
from disco_hw.runtime.replay import replay
from tests.runtime.simulated import replayed
from tests.tables import thinned

LOGS = Path(__file__).parent / "reference_logs"
# Another processor rounds sums otherwise: with the plainest instructions there are, everything stayed within 1e-5.
TOLERANCE = 1e-4


@pytest.mark.parametrize(
    ("name", "ticks", "values"),
    [
        pytest.param("circle", 255, 7380, marks=pytest.mark.thorough),
        pytest.param("adapted", 240, 7050, marks=pytest.mark.thorough),
        ("drive", 225, 4900),
        ("refined", 175, 5000),
    ],
)
def test_a_reference_log_gives_what_it_gave(name, ticks, values):
    report = replayed(LOGS / f"{name}.mcap", TOLERANCE)
    assert report.ticks == ticks
    assert report.values > values


@thinned("name", ["drive", "circle", "adapted", "refined"], quick=2)
def test_every_message_obeys_the_schema_in_its_log(name):
    """As another reader sees the file, which knows the schemas from it alone."""
    checked = Counter()
    with (LOGS / f"{name}.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema.encoding != "jsonschema":
                continue
            _validator(schema.data).validate(json.loads(message.data))
            checked[channel.topic] += 1
    assert {"/estimate", "/estimate/innovation", "/command"} <= set(checked)
    assert ("/plan" in checked) == (name != "drive")


@functools.cache
def _validator(schema):
    return Draft202012Validator(json.loads(schema))


def test_logs_from_before_planner_versions_are_still_among_them():
    with open_log(LOGS / "refined.mcap") as refined, open_log(LOGS / "circle.mcap") as sampled:
        assert (refined.metadata.planner, sampled.metadata.planner) == (SAME_SINCE_VERSION, 0)


def test_what_was_driven_by_hand_is_replayed_without_a_planner(monkeypatch):
    class PlannedError(Exception):
        pass

    def refused(*_):
        raise PlannedError

    monkeypatch.setattr("disco_hw.runtime.replay.create_planner", refused)
    assert replay(LOGS / "drive.mcap", TOLERANCE).ok
    with pytest.raises(PlannedError):
        replay(LOGS / "refined.mcap", TOLERANCE)


def test_a_changed_build_is_reported_by_tick_and_field(monkeypatch):
    def longer(parameters, left_rad, right_rad):
        return arc(parameters, 1.001 * left_rad, right_rad)

    monkeypatch.setattr(filter, "arc", longer)
    report = replay(LOGS / "drive.mcap", TOLERANCE)
    assert report.difference.field.startswith(("Estimate.", "Innovation."))
    # The hand takes hold at 1 s.
    assert 50 < report.difference.tick < 110


def test_reference_logs_are_small():
    assert 0 < sum(path.stat().st_size for path in LOGS.glob("*.mcap")) < 1_000_000
