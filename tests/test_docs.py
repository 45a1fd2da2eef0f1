"""The documentation holds together: links lead somewhere, every page has its place, every command is one there is."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path

import click
import pytest
import typer

from disco_hw.cli import app

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")), *(ROOT / "docs").rglob("*.md")]
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
COMMAND = re.compile(r"^(?:\s*|.*`)(?:sudo )?(?:\.venv/bin/)?disco-hw +([^`]*)")


def names(page: Path) -> str:
    return str(page.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub and mkdocs make them."""
    found = re.findall(r"^#+ +(.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in found}


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_every_link_leads_to_a_file_and_to_a_heading_in_it(page):
    dead = []
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            dead.append(link)
    assert not dead


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_a_link_that_is_named_by_a_file_leads_to_that_file(page):
    named = re.findall(r"\[`([\w./\-]+\.\w+)`\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    assert not [(name, link) for name, link in named if not (page.parent / link).resolve().match(name.lstrip("./"))]


def test_every_page_has_its_place_in_the_shelves_and_on_the_site():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {page.name for page in (ROOT / "docs").glob("*.md")} - {"index.md"}
    assert pages == {link for link in LINK.findall(index) if "/" not in link}
    assert pages == set(re.findall(r": ([\w\-]+\.md)$", site, re.MULTILINE)) - {"index.md"}


def commands_of(page: Path) -> list[str]:
    """The calls of `disco-hw` in the page's blocks of code, without comments."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:sh|bash|console)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    # An arrow is a drawing's.
    lines = [line for block in blocks for line in block.splitlines() if "<--" not in line]
    return [found[1] for line in lines if (found := COMMAND.match(line)) is not None]


@cache
def root_command() -> click.Command:
    return typer.main.get_command(app())


def wrong_in(line: str) -> str | None:
    """What of a call is not there: its verb, or an option."""
    parts = shlex.split(line, comments=True)
    command = root_command()
    while isinstance(command, click.Group):
        if not parts or parts[0].startswith("-"):
            break
        verb, *parts = parts
        if verb not in command.commands:
            return f"there is no {verb}"
        command = command.commands[verb]
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    options = {part.split("=")[0] for part in parts if re.match(r"--?[a-z]", part)} - {"--help", "--install-completion"}
    return f"{line}: no option {', '.join(sorted(options - known))}" if options - known else None


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_every_command_of_a_page_is_one_that_there_is(page):
    assert not [wrong for line in commands_of(page) if (wrong := wrong_in(line)) is not None]


def test_a_wrong_command_would_be_seen():
    assert wrong_in("drives ROBOT.toml") == "there is no drives"
    assert "--scripts" in (wrong_in("drive ROBOT.toml --scripts excite") or "")
    assert len([line for page in PAGES for line in commands_of(page)]) > 40


@pytest.mark.parametrize("page", [page for page in PAGES if not page.name.startswith("add-a")], ids=names)
def test_every_file_tool_and_test_that_a_page_names_is_there(page):
    text = page.read_text(encoding="utf-8")
    paths = {f"{module.replace('.', '/')}.py" for module in re.findall(r"python -m (tools[.\w]+)\b", text)}
    paths |= set(re.findall(r"\btests/[\w/\-.]*\w", text))
    paths |= set(re.findall(r"(?<![\w/])(?:disco_hw|drivers|sim|firmware_protocol)/[\w/\-.@]*\.[a-z]+\b", text))
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_make_offers_what_the_pages_say():
    targets = set(re.findall(r"^([a-z][\w\-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        mentioned = set(re.findall(r"(?:^|`)make ([a-z][\w\-]*)", page.read_text(encoding="utf-8"), re.MULTILINE))
        assert mentioned <= targets, page


def sentences(page: Path) -> list[str]:
    """The sentences of a page's running text, without its code, tables and headings."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(("|", "#", "!", "<"))]
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(lines))
    return [found for found in re.split(r"(?<=[.?!])\s+(?=[A-Z`*(])", text.strip()) if len(found.split()) > 2]


def test_sentences_have_20_words_in_the_mean():
    lengths = [len(sentence.split()) for page in PAGES for sentence in sentences(page)]
    assert len(lengths) > 500
    assert sum(lengths) / len(lengths) <= 20.0


@pytest.mark.parametrize("page", PAGES, ids=names)
def test_a_page_begins_with_a_sentence_that_says_what_it_is_for(page):
    _, title, first = re.split(r"^# (.+)\n+", page.read_text(encoding="utf-8"), maxsplit=1, flags=re.MULTILINE)
    assert title
    assert re.match(r"[A-Z`a-z\[(*]", first)
    assert len(first.split("\n\n")[0].split()) >= 5


def test_a_long_sentence_would_be_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A title\n\nIt is short. `code` begins another [linked](there.md) one.\n\n| a | table. |\n", "utf-8"
    )
    assert sentences(page) == ["It is short.", "`code` begins another linked one."]


def test_each_tool_has_its_line_and_each_line_its_tool():
    named = set(re.findall(r"`(\w+\.(?:py|c))`", (ROOT / "tools" / "README.md").read_text(encoding="utf-8")))
    there = {path.name for path in (ROOT / "tools").rglob("*.[pc]*") if path.suffix in {".py", ".c"}}
    assert named == there - {"__init__.py"}
