"""What `ctl` asks a daemon for, and what it does not even send."""

from pathlib import Path

import pytest

import disco_hw
from disco_hw.daemon.client import ask
from disco_hw.errors import InputError

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"


@pytest.mark.parametrize(
    ("action", "changes", "words"),
    [
        ("jump", (), "jump: no such request"),
        ("drive", ("forward=1",), "drive: no such request"),
        ("task", (), "say what to change"),
        ("arm", ("radius_m=1",), "arm takes nothing more"),
        ("task", ("radius_m",), "radius_m: not a change"),
        ("task", ("radius_m=wide",), "radius_m=wide: not a change"),
        ("task", ("radius_m=nan",), "radius_m=nan: not a change"),
        ("task", ("do=1",), "do=1: not a change"),
    ],
)
def test_what_is_no_request_is_not_sent(action, changes, words):
    with pytest.raises(InputError, match=words):
        ask(ROBOT, action, changes)
