"""Fields of a robot.toml changed in its text, so that comments, order and everything else stay; pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_SECTION = re.compile(r"^\s*\[([^\[\]]+)\]\s*(#.*)?$")


def in_toml(value: Any) -> str:
    """A number, text, truth or list of them as TOML writes it."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        case list() | tuple():
            return f"[{', '.join(map(in_toml, value))}]"
        case _:
            return repr(value)


def with_fields(text: str, fields: Mapping[tuple[str, str], Any]) -> str:
    """The text with these fields, by section and name, set; what is not there yet is added to its section.

    A field whose old value goes over several lines is not understood: look at the result before it is written.
    """
    lines = text.splitlines()
    for (section, name), value in fields.items():
        _set(lines, section, name, in_toml(value))
    return "\n".join(lines) + "\n"


def _set(lines: list[str], section: str, name: str, value: str) -> None:
    begin = next((k for k, line in enumerate(lines) if _name_of(line) == section), None)
    if begin is None:
        lines += [*([""] if lines and lines[-1] else []), f"[{section}]", f"{name} = {value}"]
        return
    end = next((k for k in range(begin + 1, len(lines)) if _name_of(lines[k]) is not None), len(lines))
    field = re.compile(rf"^(\s*{re.escape(name)}\s*=\s*)([^#]*?)(\s*#.*)?$")
    for k in range(begin + 1, end):
        found = field.match(lines[k])
        if found is not None:
            lines[k] = f"{found[1]}{value}{found[3] or ''}"
            return
    lines.insert(begin + 1, f"{name} = {value}")


def _name_of(line: str) -> str | None:
    found = _SECTION.match(line)
    return None if found is None else found[1].strip()
