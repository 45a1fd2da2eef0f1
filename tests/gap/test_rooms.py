"""The rooms of gap import downward only: report -> search -> noise -> data -> settings."""

import ast
from pathlib import Path

import disco_hw.gap

ROOMS = ("settings", "data", "noise", "search", "report")
HOUSE = Path(disco_hw.gap.__file__).parent


def rooms_of(source):
    """Rooms of gap that a source imports from, wherever in it; `top` for its own top level."""
    for node in ast.walk(ast.parse(source)):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if name == "disco_hw.gap" or name.startswith("disco_hw.gap."):
                part = [*name.split("."), "top"][2]
                yield part if part in ROOMS else "top"


def test_no_room_imports_from_one_above_it():
    wrong = []
    for place, room in enumerate(ROOMS):
        paths = [HOUSE / "settings.py"] if room == "settings" else (HOUSE / room).glob("*.py")
        for path in paths:
            above = [one for one in rooms_of(path.read_text()) if one == "top" or ROOMS.index(one) > place]
            wrong += [f"{path.name} imports from {one}" for one in above]
    assert not wrong


def test_an_import_of_a_room_above_would_be_seen():
    assert list(rooms_of("def f():\n    from disco_hw.gap.report import figures")) == ["report"]
    assert list(rooms_of("from disco_hw.gap import find_gap\nimport disco_hw.gap")) == ["top", "top"]
    assert list(rooms_of("from disco_hw.gap.settings import GapSettings")) == ["settings"]
