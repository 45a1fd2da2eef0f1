"""`python -m tools.messages [WORD ...]`: every text that a user can meet, to be read in one sitting.

Found in the syntax trees of what is shipped, not in a list that somebody keeps: every literal of two words or more that
is no docstring, and of a page's HTML what it shows, labels and says. With words only the texts that hold one of them.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("disco_hw", "drivers", "sim", "firmware_protocol")
KINDS = {
    "refusal": "what is refused or failed, in one line: what happened, why, what to do",
    "fault": "faults of the robot and states of the daemon, and what to do about them",
    "page": "what the page shows, and labels",
    "help": "what --help says",
    "said": "events, progress, reports, and all other words",
}
_PROSE = re.compile(r"[A-Za-z]{2,}[,:;.)]* +\(?[a-zA-Z{]")
_SHOWN = ("alt", "aria-label", "placeholder", "title")
_SCRIPT_TEXT = re.compile(r"`((?:[^`\\]|\\.)*)`|\"((?:[^\"\\\n]|\\.)*)\"")


@dataclass(frozen=True, slots=True)
class Message:
    """A text with {what is put in}, where it is written, and what kind of text it is: one of KINDS."""

    kind: str
    text: str
    file: str
    line: int


def messages(root: Path = ROOT) -> list[Message]:
    """All of them, by kind, then by place."""
    found: list[Message] = []
    for top in SHIPPED:
        for path in sorted((root / top).rglob("*")):
            name = str(path.relative_to(root))
            if path.suffix == ".py":
                found += in_python(path.read_text(encoding="utf-8"), name)
            elif path.suffix == ".html":
                found += in_html(path.read_text(encoding="utf-8"), name)
    order = list(KINDS)
    return sorted(found, key=lambda message: (order.index(message.kind), message.file, message.line))


# Most nodes of a tree are one of these.
_WITHOUT_TEXT = (ast.Name, ast.expr_context, ast.operator, ast.unaryop, ast.cmpop, ast.boolop)


def in_python(source: str, name: str) -> list[Message]:
    """The texts of a module."""
    found: list[Message] = []
    _add_texts(ast.parse(source), name, "said", found)
    return found


def _add_texts(node: ast.AST, name: str, kind: str, found: list[Message]) -> None:
    if _is_bare_string(node):
        return
    if isinstance(node, ast.Raise):
        kind = "refusal"
    elif isinstance(node, ast.keyword) and node.arg == "help":
        kind = "help"
    elif isinstance(node, ast.Call) and re.search(r"error|refuse", _called(node).lower()):
        kind = "refusal"
    text = as_text(node)
    if text is not None:
        if _PROSE.search(text):
            found.append(Message(_kind_in(name, kind), text, name, getattr(node, "lineno", 0)))
        return
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, _WITHOUT_TEXT):
            _add_texts(child, name, kind, found)


def _is_bare_string(node: ast.AST) -> bool:
    """Documentation of what stands above it."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _called(node: ast.Call) -> str:
    return ast.unparse(node.func)


def _kind_in(name: str, kind: str) -> str:
    if kind != "said":
        return kind
    if "/viewer/" in name:
        return "page"
    return "fault" if name.endswith(("runtime/__init__.py", "firmware_protocol/status_codes.py")) else kind


def as_text(node: ast.AST) -> str | None:
    """A literal as a reader meets it, what is put in as {its expression}; None for what is no literal text."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        parts = (part.value if isinstance(part, ast.FormattedValue) else part for part in node.values)
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else f"{{{ast.unparse(part)}}}" for part in parts
        )
    return None


class _Shown(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[int, str]] = []
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = tag
        self.found += [(self.getpos()[0], value) for key, value in attrs if key in _SHOWN and value]

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        line = self.getpos()[0]
        if self._inside == "script":
            for text in _SCRIPT_TEXT.finditer(data):
                literal = text[1] or text[2] or ""
                if _PROSE.search(literal) and "=>" not in literal:
                    self.found.append((line + data[: text.start()].count("\n"), literal))
        elif self._inside != "style" and data.strip():
            self.found.append((line, data.strip()))


def in_html(source: str, name: str) -> Iterator[Message]:
    """Yield the texts that a page shows, labels and says."""
    parser = _Shown()
    parser.feed(source)
    for line, text in parser.found:
        yield Message("page", text, name, line)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.messages", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("words", nargs="*", metavar="WORD", help="only texts with one of these")
    parser.add_argument("--kind", choices=KINDS, help="only of this kind")
    given = parser.parse_args()
    chosen = [
        message
        for message in messages()
        if given.kind in (None, message.kind)
        and (not given.words or any(word.lower() in message.text.lower() for word in given.words))
    ]
    kind = file = ""
    for message in chosen:
        if message.kind != kind:
            kind, file = message.kind, ""
            print(f"\n# {kind}: {KINDS[kind]}")
        if message.file != file:
            file = message.file
            print(f"\n{file}")
        print(f"{message.line:5}  {' '.join(message.text.split())}")
    print(f"\n{len(chosen)} texts")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
