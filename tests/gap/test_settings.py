"""Every setting says where it comes from, and has its effect where it is used."""

import inspect
import re
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import numpy as np
import pytest

from disco_hw import gap
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from tests.gap.synthetic import body_channel, selector_of

GROUPS = [type(getattr(DEFAULT_SETTINGS, field.name)) for field in fields(GapSettings)]


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
def test_each_setting_says_where_it_comes_from_and_is_used(group):
    source = inspect.getsource(group)
    sources = "".join(path.read_text() for path in Path(gap.__file__).parent.rglob("*.py"))
    for field in fields(group):
        said = re.search(rf'\n    {field.name}: [^\n]* = .*\n    """(.+?)"""', source, re.DOTALL)
        assert said, field.name
        assert re.search(r"\b(Chosen|Measured|Literature)\b", said.group(1)), field.name
        assert re.search(rf"\.{field.name}\b", sources), field.name


def test_settings_are_frozen():
    for group in (DEFAULT_SETTINGS, *(getattr(DEFAULT_SETTINGS, field.name) for field in fields(GapSettings))):
        with pytest.raises(FrozenInstanceError):
            setattr(group, fields(group)[0].name, None)


def test_a_setting_of_the_selection_is_felt_by_who_selects():
    channel, drive = body_channel(turn_slip=0.08)
    never = replace(DEFAULT_SETTINGS, selection=replace(DEFAULT_SETTINGS.selection, telling_nats=1e9))
    lenient = type(channel).build(replace(drive, settings=never), channel.noise, channel.neutral)
    assert selector_of(channel).rivals(("turn_slip",), "turn_slip") == ()
    assert "side_slip" in selector_of(lenient).rivals(("turn_slip",), "turn_slip")


def test_a_setting_of_the_noise_is_felt_by_the_channel():
    channel, drive = body_channel()
    assert np.unique(channel.window).size > 10
    wide = replace(DEFAULT_SETTINGS, grid=replace(DEFAULT_SETTINGS.grid, block_s=1000.0))
    assert (
        np.unique(type(channel).build(replace(drive, settings=wide), channel.noise, channel.neutral).window).size == 1
    )
