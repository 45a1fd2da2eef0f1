"""What msgspec finds wrong with a file's table, in words for the user: field, fault and what to write."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence

import msgspec
from msgspec import inspect

_STEP = re.compile(r"\.(\w+)|\[\.*\d*\.*\]")


def in_words(error: msgspec.ValidationError, kinds: Sequence[type], docs: str, within: str = "") -> str:
    """One line: the field, what is wrong, the values or the name that it could have; `docs` says what each means.

    `kinds` are the types that the table could have been converted to, `within` is its section.
    """
    roots = [inspect.type_info(kind) for kind in kinds]
    text, _, where = str(error).partition(" - at `$")
    place = where.rstrip("`")
    field = f"{within}{place}".lstrip(".")
    here = _types_at(roots, place)
    found = re.match(r"Object (contains unknown|missing required) field `(.*)`", text)
    if found is None:
        choices = _choices(here) or _tags(_types_at(roots, place.rpartition(".")[0]), field)
        remedy = f"write {_one_of(choices)}" if choices else "correct the value"
        return f"{field or 'top level'}: {text[:1].lower()}{text[1:]}; {remedy}"
    section, name = f"[{field}] " if field else "", found[2]
    if found[1] == "missing required":
        choices = _tags(here, name)
        add = f"add it: {_one_of(choices)}" if choices else "add it"
        return f"{section}{name}: missing; {add} ({docs} says what it means)"
    near = nearest(
        name, (one.encode_name for kind in here if isinstance(kind, inspect.StructType) for one in kind.fields)
    )
    remedy = f"did you mean {near}?" if near else "check the spelling or remove it"
    return f"{section}{name}: no such field; {remedy} ({docs} lists every field)"


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is most like a misspelt one, or None if none is like it."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1)), None)


def _types_at(roots: Sequence[inspect.Type], place: str) -> list[inspect.Type]:
    """What may stand at a place as `.link.kind` or `.belief.mean[...]`."""
    types = _members(roots)
    for step in _STEP.finditer(place):
        following: list[inspect.Type] = []
        for one in types:
            match one:
                case inspect.StructType(fields=fields):
                    following += [field.type for field in fields if field.encode_name == step[1]]
                case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item) if step[1] is None:
                    following.append(item)
        types = _members(following)
    return types


def _members(types: Sequence[inspect.Type]) -> list[inspect.Type]:
    """The types with unions taken apart."""
    return [member for one in types for member in (one.types if isinstance(one, inspect.UnionType) else (one,))]


def _choices(types: Sequence[inspect.Type]) -> list[str]:
    return [str(value) for one in types if isinstance(one, inspect.LiteralType) for value in one.values]


def _tags(types: Sequence[inspect.Type], field: str) -> list[str]:
    """The values of the field that distinguishes the structs of a union."""
    name = field.rpartition(".")[2]
    return [str(one.tag) for one in types if isinstance(one, inspect.StructType) and one.tag_field == name]


def _one_of(choices: Sequence[str]) -> str:
    return choices[0] if len(choices) == 1 else f"one of {', '.join(choices)}"
