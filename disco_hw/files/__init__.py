"""The one reader of files that a user names: what kind of file, how large, how deep, all bounded before it is parsed.

A path may name anything: a pipe that nobody writes to, a device without an end, a directory, a file of many gigabytes.
Each is refused in one line, at once, before a byte of it is taken in.
"""

from __future__ import annotations

import codecs
import difflib
import io
import os
import re
import stat
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from msgspec import inspect

from disco_hw.errors import InputError

# Chosen: far above any file of this project, and small enough that no file stalls or exhausts its parser.
LONGEST_LINE, LONGEST_NAME, LONGEST_STRING = 65_536, 64, 4096
DEEPEST_NESTING, MOST_KEY_PARTS = 16, 8
_KIB, _MIB = 1024, 1024 * 1024
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
_NOT_PLAIN = {stat.S_IFDIR: "a directory", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_CONTROL_CHARACTER = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
# Strings and comments whole, so that what is in them is not counted; one without its end goes on to the end.
_TOML_TOKEN = re.compile(
    r'''(?P<string>"""(?:[^\\"]|\\.|"(?!""))*+(?:"{3,5}|\\?\Z)|"(?:[^"\\\n]|\\.)*+"?'''
    r"""|'''(?:[^']|'(?!''))*+(?:'{3,5}|\Z)|'[^'\n]*+'?)"""
    r"|(?P<comment>#[^\n]*+)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<word>[\w+:-]++)|(?P<dot>\.)|(?P<end>[=,\n])",
    re.DOTALL | re.ASCII,
)


@dataclass(frozen=True, slots=True)
class FileKind:
    """Kind of a file: what it should be, in words, the most bytes that it may have, what to do where there is none."""

    what: str
    most_bytes: int
    hint: str


ROBOT_TOML = FileKind("a robot.toml", 256 * _KIB, "give the path of a robot.toml")
MODEL_TOML = FileKind("a model file", _MIB, "give the path of a model file")
FAULTS_TOML = FileKind("a fault schedule", _MIB, "give the path of a fault schedule in TOML")
WAY_POINTS = FileKind("a CSV of way-points", 4 * _MIB, "give the path of a CSV of way-points")
KEY = FileKind("a key", _KIB, "make one with `(umask 077; openssl rand -hex 16 > FILE)`")
DRIVE_CSV = FileKind("a CSV file", 128 * _MIB, "give the path of a CSV file")
CANDUMP = FileKind("a candump", 512 * _MIB, "give the path of a candump")
LOG = FileKind("a log", 16 * _KIB * _MIB, "give the path of a log")


def file_name_of(name: str) -> str:
    """Return a robot's name as part of a file name: letters, digits, - and _ alone, which leave no directory."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)


def control_character_in(text: str) -> str | None:
    """Describe the first control character in a name, as NUL or a line feed; None if there is none."""
    found = _CONTROL_CHARACTER.search(text)
    if found is None:
        return None
    what = "a NUL character" if found[0] == "\0" else f"the control character {found[0]!a}"
    return f"holds {what}, which no name may have"


def check_log_file(log_file: Path | None) -> None:
    """Raise InputError if the name given with --log cannot stand in one line of a message, or is taken."""
    if log_file is None:
        return
    if fault := control_character_in(str(log_file)):
        raise InputError(f"--log {str(log_file)!a}: {fault}; give another name")
    if os.path.lexists(log_file):
        raise InputError(f"--log {log_file}: already exists; give another name")


def open_file(path: Path, kind: FileKind) -> int:
    """Return a descriptor of a plain file that is not too large; raises InputError for anything else."""
    try:
        # A pipe without a writer would hold up a plain open for ever.
        descriptor = os.open(path, _FLAGS)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({_why(error)}); {kind.hint}") from None
    try:
        _refuse_unfit(path, kind, os.fstat(descriptor))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


@contextmanager
def _reading(path: Path, kind: FileKind) -> Iterator[BinaryIO]:
    """Open a file that is fit to be read; what fails while it is read becomes an InputError."""
    with os.fdopen(open_file(path, kind), "rb") as file:
        try:
            yield file
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({_why(error)}); {kind.hint}") from None


def read_bytes(path: Path, kind: FileKind) -> tuple[bytes, os.stat_result]:
    """Return the contents of a file, with the status of the very file that was read; raises InputError."""
    with _reading(path, kind) as file:
        # A file may grow, and those of /proc have no size to begin with.
        status, content = os.fstat(file.fileno()), file.read(kind.most_bytes + 1)
    if len(content) > kind.most_bytes:
        raise _too_large(path, kind)
    return content, status


def begin_of(path: Path, kind: FileKind, count: int) -> bytes:
    """Return the first bytes of a file, fewer where it has fewer; raises InputError."""
    with _reading(path, kind) as file:
        return file.read(count)


def read_lines(path: Path, kind: FileKind) -> Iterator[str]:
    """Yield the lines of a text file, each with its end, one at a time.

    Raises InputError, also for a line without an end.
    """
    with _reading(path, kind) as file:
        size = number = 0
        # Spreadsheets write a mark before the first column's name.
        text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
        while True:
            try:
                line = text.readline(LONGEST_LINE + 1)
            except UnicodeDecodeError as error:
                raise InputError(f"{path}: not {kind.what} (not UTF-8: {error.reason}); {kind.hint}") from None
            if not line:
                return
            number, size = number + 1, size + len(line)
            if len(line) > LONGEST_LINE:
                raise InputError(f"{path}: line {number}: over {LONGEST_LINE} characters long; {kind.hint}")
            if size > kind.most_bytes:
                raise _too_large(path, kind)
            yield line


def read_toml(path: Path, kind: FileKind) -> dict[str, Any]:
    """Return a TOML file's table; raises InputError."""
    return parse_toml(read_bytes(path, kind)[0], str(path))


def parse_toml(content: bytes, name: str) -> dict[str, Any]:
    """Return the table of a TOML file's content, `name` in messages.

    Raises InputError, also for what a parser needs for ever or a deep stack for: brackets nested more than 16 deep,
    words, numbers among them, over 64 characters, strings over 4096, keys of more than 8 parts.
    """
    try:
        # Some editors write a mark before the first line.
        text = content.removeprefix(codecs.BOM_UTF8).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: not valid TOML (not UTF-8: {error.reason}); save it as UTF-8") from None
    _refuse_hostile(text, name)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # Not all that tomllib raises is its own error.
        raise InputError(f"{name}: not valid TOML ({' '.join(str(error).split())}); correct that line") from None


def _refuse_hostile(text: str, name: str) -> None:
    depth = dots = 0

    def refuse(fault: str, at: int) -> InputError:
        line = text.count("\n", 0, at) + 1
        return InputError(f"{name}: not valid TOML (line {line}: {fault}); correct that line")

    for token in _TOML_TOKEN.finditer(text):
        match token.lastgroup:
            case "open":
                depth, dots = depth + 1, 0
                if depth > DEEPEST_NESTING:
                    raise refuse(f"brackets nested more than {DEEPEST_NESTING} deep", token.start())
            case "close":
                depth, dots = max(0, depth - 1), 0
            case "end":
                dots = 0
            case "dot":
                dots += 1
                if dots >= MOST_KEY_PARTS:
                    raise refuse(f"a key of more than {MOST_KEY_PARTS} parts", token.start())
            case "word" if token.end() - token.start() > LONGEST_NAME:
                raise refuse(f"a number or key of more than {LONGEST_NAME} characters", token.start())
            case "string" if token.end() - token.start() > LONGEST_STRING:
                raise refuse(f"a string of more than {LONGEST_STRING} characters", token.start())


def _refuse_unfit(path: Path, kind: FileKind, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        found = _NOT_PLAIN.get(stat.S_IFMT(status.st_mode), "a device")
        raise InputError(f"{path}: cannot be read ({found}, not a plain file); {kind.hint}")
    if status.st_size > kind.most_bytes:
        raise _too_large(path, kind)


def _too_large(path: Path, kind: FileKind) -> InputError:
    most = f"{kind.most_bytes // _MIB} MiB" if kind.most_bytes >= _MIB else f"{kind.most_bytes // _KIB} KiB"
    return InputError(f"{path}: too large to be {kind.what} (over {most}); {kind.hint}")


def _why(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


_STEP = re.compile(r"\.(\w+)|\[\.*\d*\.*\]")


def describe(error: msgspec.ValidationError, kind: type, docs: str, within: str = "") -> str:
    """Return one line for an invalid field: its name, what is wrong, and the values or the name that it could have.

    `docs` says what each value means. `kind` is the type that the table should have been converted to, `within` is its
    section.
    """
    roots = [inspect.type_info(kind)]
    text, _, where = str(error).partition(" - at `$")
    place = where.rstrip("`")
    field = f"{within}{place}".lstrip(".")
    here = _types_at(roots, place)
    found = re.match(r"Object (contains unknown|missing required) field `(.*)`", text)
    if found is None:
        choices = _choices(here) or _tags(_types_at(roots, place.rpartition(".")[0]), field)
        hint = f"write {_one_of(choices)}" if choices else "correct the value"
        return f"{field or 'top level'}: {text[:1].lower()}{text[1:]}; {hint}"
    section, name = f"[{field}] " if field else "", found[2]
    if found[1] == "missing required":
        choices = _tags(here, name)
        add = f"add it: {_one_of(choices)}" if choices else "add it"
        return f"{section}{name}: missing; {add} ({docs} says what it means)"
    structs = [one for one in here if isinstance(one, inspect.StructType)]
    if owners := [one for one in structs if name in _names(one)]:
        fault, hint = field_of_others(str(owners[0].tag_field), [str(one.tag) for one in owners])
        return f"{section}{name}: {fault}; {hint}"
    near = nearest(name, (known for one in structs for known in _names(one)))
    hint = f"did you mean {near}?" if near else "check the spelling or remove it"
    return f"{section}{name}: no such field; {hint} ({docs} lists every field)"


def field_of_others(choice: str, owners: Iterable[str], but: str = "") -> tuple[str, str]:
    """Return fault and hint for a field that only `owners` have, other values of `choice` than the one chosen.

    `but` says which that is, where it is known.
    """
    *others, last = (f'"{owner}"' for owner in owners)
    listed, written = (f"{', '.join(others)} or {last}", "one of those") if others else (last, last)
    return f"belongs to the {choice} {listed}{but}", f"write {choice} = {written}, or remove it"


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most like a misspelt one, or None if none is like it."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1)), None)


def _types_at(roots: Sequence[inspect.Type], place: str) -> list[inspect.Type]:
    """Return the types that may stand at a place such as `.link.kind` or `.belief.mean[...]`."""
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
    """Return the types with unions taken apart."""
    return [member for one in types for member in (one.types if isinstance(one, inspect.UnionType) else (one,))]


def _names(struct: inspect.StructType) -> list[str]:
    return [field.encode_name for field in struct.fields]


def _choices(types: Sequence[inspect.Type]) -> list[str]:
    return [str(value) for one in types if isinstance(one, inspect.LiteralType) for value in one.values]


def _tags(types: Sequence[inspect.Type], field: str) -> list[str]:
    """Return the values of the field that distinguishes the structs of a union."""
    name = field.rpartition(".")[2]
    return [str(one.tag) for one in types if isinstance(one, inspect.StructType) and one.tag_field == name]


def _one_of(choices: Sequence[str]) -> str:
    return choices[0] if len(choices) == 1 else f"one of {', '.join(choices)}"
