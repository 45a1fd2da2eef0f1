"""docs/results.md: every row names its day, its revision and its command."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "results.md").read_text("utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.split("\n## Tables\n")[0].splitlines()
    if line.startswith("| ") and not line.startswith("| what")
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:40])
def test_every_figure_in_words_has_its_day_and_a_command_that_is_there(row):
    what, _, noted, shown_by = row
    assert re.match(r"\d+ \w{3} `[0-9a-f]{7}`", noted), what
    gone = re.findall(r"`(tools/[\w/]+\.py)[^`]*` of `[0-9a-f]{7}`", shown_by)
    assert not [tool for tool in gone if (ROOT / tool).exists()], what
    commands = [] if gone else re.findall(r"`([^`]+)`", re.sub(r" of `[0-9a-f]{7}`", "", shown_by))
    assert commands or gone, what
    targets = set(re.findall(r"^([a-z][\w\-]*):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for command in commands:
        parts = command.removeprefix("sudo ").split()
        if parts[0] == "make":
            assert {part for part in parts[1:] if "=" not in part} <= targets, command
        elif parts[:2] == ["python", "-m"]:
            assert (ROOT / (parts[2].replace(".", "/") + ".py")).exists(), command
        elif parts[0] == "pytest":
            assert all((ROOT / part).exists() for part in parts[1:] if part.startswith("tests/")), command
        else:
            assert parts[0] == "disco-hw", command
