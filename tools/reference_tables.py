"""`python -m tools.reference_tables`: writes the reference tables of the documentation from the code.

The pages are docs/robot.md, docs/commands.md and docs/safety.md. A table stands between two comments that name it.
Everything that the code knows is written anew: keys, allowed values, defaults, commands, states. Only the column
`meaning` of robot.toml's keys is written by hand, in the page; it is kept for each key. A new key gets an empty
meaning, which a test refuses.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_type_hints

import click
import msgspec
import typer
from msgspec import inspect

from disco_hw.cli import app
from disco_hw.config import RobotConfig
from disco_hw.runtime import TRANSITIONS, State
from disco_hw.tasks import kinds, task_class
from drivers.motor import motor_drivers

ROOT = Path(__file__).resolve().parents[1]
ROBOT, COMMANDS, SAFETY = (ROOT / "docs" / name for name in ("robot.md", "commands.md", "safety.md"))
_NOT_WRITTEN = {"of_driver"}
_COMPUTED = {"prior": "from [robot]"}
_TABLE = re.compile(r"(<!-- begin table: (.+?) -->\n).*?(\n<!-- end table -->)", re.DOTALL)


def settings() -> dict[str, tuple[type, set[str]]]:
    """By the name of its table, each struct of robot.toml and those of its fields that are not written there."""
    hints = get_type_hints(RobotConfig)
    found: dict[str, tuple[type, set[str]]] = {
        f"[{name}]": (hints[name], _NOT_WRITTEN) for name in RobotConfig.__struct_fields__ if name != "task"
    }
    for kind in kinds():
        task = task_class(kind)
        found[f"[task] {kind}"] = (task, set(task.read_fields))
    for name, driver in sorted(motor_drivers().items()):
        if driver.settings.__struct_fields__:
            found[f"[link] {name}"] = (driver.settings, set())
    return found


def settings_table(name: str, present: str) -> str:
    """Markdown of the keys of one struct, with the meanings that the present table has."""
    descriptions = dict(re.findall(r"^\| `(\w+)` \|.*\| ([^|]*) \|$", present, re.MULTILINE))
    struct, left_out = settings()[name]
    information = inspect.type_info(struct)
    assert isinstance(information, inspect.StructType)
    lines = ["| key | allowed | default | meaning |", "|---|---|---|---|"]
    for field in information.fields:
        if field.name not in left_out:
            default = _COMPUTED.get(name.strip("[]")) or default_of(field)
            description = descriptions.get(field.name, "")
            lines.append(f"| `{field.name}` | {allowed(field.type)} | {default} | {description} |")
    return "\n".join(lines)


def allowed(kind: inspect.Type) -> str:
    """Return the allowed values of a type, in the fewest words."""
    match kind:
        case inspect.Metadata():
            return allowed(kind.type)
        case inspect.UnionType():
            return " or ".join(
                dict.fromkeys(allowed(one) for one in kind.types if not isinstance(one, inspect.NoneType))
            )
        case inspect.LiteralType():
            return ", ".join(literal(value) for value in kind.values)
        case inspect.FloatType() | inspect.IntType():
            return interval(kind)
        case inspect.BoolType():
            return "true, false"
        case inspect.StrType():
            return "text"
        case inspect.TupleType():
            types = dict.fromkeys(map(allowed, kind.item_types))
            return f"{len(kind.item_types)} x {' / '.join(types)}"
        case inspect.ListType() | inspect.VarTupleType():
            return f"list of {allowed(kind.item_type)}"
        case _:
            return "table"


def interval(kind: inspect.FloatType | inspect.IntType) -> str:
    """The numbers that are allowed: a round bracket excludes its bound, a square one includes it."""
    low, high = (
        next((one for one in pair if one is not None), None) for pair in ((kind.gt, kind.ge), (kind.lt, kind.le))
    )
    high = None if high is not None and high > 1e9 else high
    number_type = "integer" if isinstance(kind, inspect.IntType) else ""
    if low is None:
        return number_type or "number"
    if high is None:
        return f"{number_type} {'>' if kind.gt is not None else '>='}{low:g}".strip()
    left, right = "(" if kind.gt is not None else "[", ")" if kind.lt is not None else "]"
    return f"{number_type} {left}{low:g}, {high:.8g}{right}".strip()


def literal(value: Any) -> str:
    """A value as it is written in robot.toml."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(literal, value))}]"
    return str(value)


def default_of(field: inspect.Field) -> str:
    """The value of a field that is left out; nothing where another source decides, or none is needed."""
    if field.required:
        return "required"
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    return "" if value is None or isinstance(value, dict) else literal(value)


def commands(command: click.Command, name: str) -> Iterator[tuple[str, str]]:
    """Each command below this one that does something, with its arguments and the first sentence of its help."""
    if isinstance(command, click.Group):
        for subcommand, inner in command.commands.items():
            yield from commands(inner, f"{name} {subcommand}")
        return
    arguments = " ".join(
        parameter.make_metavar(click.Context(command))
        for parameter in command.params
        if parameter.param_type_name == "argument"
    )
    yield f"{name} {arguments}".strip(), first_sentence(command.help or "")


def first_sentence(text: str) -> str:
    """The first sentence of a help text, on one line."""
    return re.split(r"(?<=[.])\s+(?=[A-Z])", " ".join(text.split()))[0]


def commands_table(_name: str, _present: str) -> str:
    """Markdown of every command of the command line."""
    rows = [
        f"| `{call.replace('|', ' ')}` | {summary} |"
        for call, summary in commands(typer.main.get_command(app()), "disco-hw")
    ]
    return "\n".join(["| command | what it does |", "|---|---|", *rows])


def states_table(_name: str, _present: str) -> str:
    """Markdown of the ways between the daemon's states, in the order in which they are tried."""
    lines = ["| from | to | reason, as in the event |", "|---|---|---|"]
    for row in TRANSITIONS:
        sources = [state.name for state in State if state in row.sources]
        others = [state.name for state in State if state not in row.sources]
        source_text = ", ".join(sources) if len(sources) <= len(others) + 1 else f"any but {', '.join(others)}"
        lines.append(f"| {source_text} | {row.target.name} | {row.reason} |")
    return "\n".join(lines)


def written(page: str) -> str:
    """A page with each of its tables written anew. Raises KeyError for a table that nothing makes."""
    makers: dict[str, Callable[[str, str], str]] = {"commands": commands_table, "states": states_table}
    makers |= dict.fromkeys(settings(), settings_table)
    return _TABLE.sub(lambda found: f"{found[1]}{makers[found[2]](found[2], found[0])}{found[3]}", page)


def main() -> int:
    argparse.ArgumentParser(prog="python -m tools.reference_tables", description=__doc__).parse_args()
    for page in (ROBOT, COMMANDS, SAFETY):
        present = page.read_text("utf-8")
        if written(present) != present:
            page.write_text(written(present), "utf-8")
            print(f"{page.relative_to(ROOT)}: written")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
