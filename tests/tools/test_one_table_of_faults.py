"""What to do about a fault stands in one file."""

from pathlib import Path

from firmware_protocol.status_codes import FAULTS

ROOT = Path(__file__).parents[2]
# Where the table stands, and the page on which it is printed, equal to it by test_readme.py.
HOMES = {"firmware_protocol/status_codes.py", "firmware_protocol/README.md"}


def test_no_other_file_holds_a_remedy_or_lists_the_faults():
    """No file but the table's own holds what it says, or has a mapping from names of faults to text."""
    remedies = {fault.hint.lower() for fault in FAULTS.values()}
    files = [path for folder in ("disco_hw", "drivers", "firmware_protocol", "sim", "docs", "README.md")
             for path in ([ROOT / folder] if folder.endswith(".md") else (ROOT / folder).rglob("*"))
             if path.suffix in {".py", ".md", ".html", ".js", ".toml", ".dbc"}]  # fmt: skip
    assert len(files) > 200
    for path in files:
        name = path.relative_to(ROOT).as_posix()
        if name not in HOMES:
            text = path.read_text("utf-8")
            assert not [hint for hint in remedies if hint in text.lower()], name
            assert not [fault for fault in FAULTS if f'"{fault}": ' in text or f"`{fault}` |" in text], name
