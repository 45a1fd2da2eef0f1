"""The rules that keep the tree habitable: imports only go down, no tool needs the tests, nothing loose at the top.

docs/architecture.md draws the same rooms.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = (
    "cli", "experiments", "viewer", "bridge", "first_use", "drive", "daemon", "runtime", "adaptation", "inference",
    "gap", "control", "estimation", "log", "model", "effects", "jit", "reports", "config", "tasks", "fence", "files",
    "processes", "errors",
)  # fmt: skip
"""From top to bottom; a room may import the rooms below it."""
MAY_IMPORT_SIM = ("cli", "experiments")
LOOSE = {"__init__", "__main__", "errors"}
LOWER = {"sim": {"drivers", "firmware_protocol"}, "drivers": {"firmware_protocol"}, "firmware_protocol": set()}
OURS = {"disco_hw", "sim", "drivers", "firmware_protocol", "tests", "tools"}


# To parse whole modules takes ten times as long.
IMPORT = re.compile(r"^[ \t]*((?:from|import) (?:[^\n(]|\([^)]*\))*)", re.MULTILINE)


def parsed(text: str) -> ast.stmt | None:
    """The statement that a text is, None for prose."""
    try:
        return ast.parse(text).body[0]
    except SyntaxError:
        return None


def imports(file: Path) -> Iterator[str]:
    """Dotted names of the modules that a file imports, those in functions too."""
    for node in map(parsed, IMPORT.findall(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            # `from disco_hw import control` imports the room control.
            bare = node.module == "disco_hw"
            yield from (f"disco_hw.{alias.name}" for alias in node.names) if bare else (node.module,)


def room_of(module: str) -> str:
    """The room of a dotted name below disco_hw, or the top-level package."""
    parts = module.split(".")
    return parts[1] if parts[0] == "disco_hw" and len(parts) > 1 else parts[0]


def product() -> list[Path]:
    return sorted((ROOT / "disco_hw").rglob("*.py"))


def test_rooms_import_only_rooms_below_them():
    wrong = []
    for file in product():
        room = file.relative_to(ROOT / "disco_hw").parts[0].removesuffix(".py")
        for module in imports(file) if room not in {"__main__", "__init__"} else ():
            if module.split(".")[0] not in OURS or module == "disco_hw":
                continue
            other = room_of(module)
            if module.split(".")[0] == "disco_hw":
                allowed = other == room or (other in ROOMS and room in ROOMS and ROOMS.index(other) > ROOMS.index(room))
            else:
                allowed = other in {"drivers", "firmware_protocol"} or (other == "sim" and room in MAY_IMPORT_SIM)
            if not allowed:
                wrong.append(f"{file.relative_to(ROOT)} imports {module}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", LOWER)
def test_what_talks_to_hardware_knows_nothing_of_what_thinks(package):
    wrong = [
        f"{file.relative_to(ROOT)} imports {module}"
        for file in sorted((ROOT / package).rglob("*.py"))
        for module in imports(file)
        if module.split(".")[0] in OURS - {package} - LOWER[package]
    ]
    assert not wrong, "\n".join(wrong)


def test_no_tool_imports_tests():
    wrong = [file.name for file in (ROOT / "tools").glob("*.py") if any(m.startswith("tests") for m in imports(file))]
    assert not wrong


def test_nothing_lies_loose_at_the_top():
    assert {file.stem for file in (ROOT / "disco_hw").glob("*.py")} == LOOSE
