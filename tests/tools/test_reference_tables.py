"""The reference tables of the pages are those that the code makes, and every key of robot.toml has a meaning."""

import re

import pytest

from tools import reference_tables
from tools.reference_tables import COMMANDS, ROBOT, SAFETY, settings, settings_table, written

TABLES = re.compile(r"<!-- begin table: (.+?) -->\n(.*?)\n<!-- end table -->", re.DOTALL)


@pytest.mark.parametrize("page", [ROBOT, COMMANDS, SAFETY], ids=lambda page: page.name)
def test_the_tables_of_a_page_are_those_of_the_code(page):
    text = page.read_text("utf-8")
    assert TABLES.search(text)
    assert written(text) == text, "run python -m tools.reference_tables"


def test_every_struct_of_robot_toml_has_its_table():
    assert sorted(name for name, _ in TABLES.findall(ROBOT.read_text("utf-8"))) == sorted(settings())


def test_every_key_has_a_meaning():
    rows = re.findall(r"^\| `\w+` \|.*$", ROBOT.read_text("utf-8"), re.MULTILINE)
    assert len(rows) > 100
    assert [row for row in rows if row.endswith("|  |")] == []


def test_a_new_default_or_key_changes_the_table_and_keeps_what_was_written_by_hand():
    stale = "| `rate_hz` | [1, 2] | 3.0 | how often |\n| `gone` | text | | what was |"
    table = settings_table("[control]", stale)
    assert "| `rate_hz` | [20, 100] | 50.0 | how often |" in table
    assert "gone" not in table
    assert '| `mode` | "default", "paper", "sampled" | "default" |  |' in table


def test_a_table_that_nothing_makes_is_refused():
    with pytest.raises(KeyError, match="nothing"):
        written("<!-- begin table: nothing -->\nold\n<!-- end table -->")


def test_a_page_that_differs_is_written_and_named(tmp_path, monkeypatch, capsys):
    page = tmp_path / "commands.md"
    page.write_text("<!-- begin table: commands -->\nold\n<!-- end table -->\n", "utf-8")
    monkeypatch.setattr(reference_tables, "ROOT", tmp_path)
    for name in ("ROBOT", "COMMANDS", "SAFETY"):
        monkeypatch.setattr(reference_tables, name, page)
    monkeypatch.setattr("sys.argv", ["reference_tables"])
    assert reference_tables.main() == 0
    assert "commands.md: written" in capsys.readouterr().out
    assert "disco-hw run ROBOT.toml" in page.read_text("utf-8")
