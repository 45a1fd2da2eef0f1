"""What a path may name instead of a file, what a file may hold to keep a parser busy, and that nothing goes past it."""

from __future__ import annotations

import ast
import gc
import os
import re
import socket
import string
import tomllib
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.errors import InputError
from disco_hw.files import (
    DRIVE_CSV,
    KEY,
    LONGEST_LINE,
    ROBOT_TOML,
    begin_of,
    open_file,
    parse_toml,
    read_bytes,
    read_lines,
    read_toml,
)
from tests.tables import examples

ROOT = Path(__file__).resolve().parents[2]


def _socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(path.name)
    finally:
        os.chdir(here)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 34)


NO_FILES = {
    "absent": (lambda path: None, "No such file"),
    "directory": (Path.mkdir, "a directory, not a plain file"),
    "pipe": (os.mkfifo, "a pipe, not a plain file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "a device, not a plain file"),
    "terminal": (lambda path: path.symlink_to("/dev/ptmx"), "a device, not a plain file"),
    "socket": (_socket, "No such device or address"),
    "loop": (lambda path: path.symlink_to(path.name), "Too many levels"),
    "large": (_sparse, "too large to be"),
}


def leaves_as_open(*refused):
    """Whether as many files are open after each refusal, in a fork: no thread or garbage of other tests closes any."""
    child = os.fork()
    if child == 0:
        gc.disable()
        count = len(os.listdir("/proc/self/fd"))
        seen = []
        try:
            for one in refused:
                try:
                    one()
                except InputError:
                    seen.append(len(os.listdir("/proc/self/fd")))
        finally:
            os._exit(0 if seen == [count] * len(refused) else 1)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == 0


READERS = [open_file, read_bytes, lambda path, kind: list(read_lines(path, kind)), read_toml]


@pytest.mark.parametrize(("create", "message"), NO_FILES.values(), ids=NO_FILES)
def test_what_is_no_plain_file_of_its_size_is_refused(tmp_path, create, message):
    path = tmp_path / "robot.toml"
    create(path)
    for read in READERS:
        with pytest.raises(InputError, match=message) as refused:
            read(path, ROBOT_TOML)
        assert "\n" not in str(refused.value)
        assert str(refused.value).startswith(f"{path}: ")
    assert leaves_as_open(*(partial(read, path, ROBOT_TOML) for read in READERS))


def test_a_file_whose_size_says_nothing_is_read_no_further_than_its_kind_goes():
    # Those of /proc say that they are empty.
    assert Path("/proc/self/smaps").stat().st_size == 0
    assert len(Path("/proc/self/smaps").read_bytes()) > KEY.most_bytes
    with pytest.raises(InputError, match=r"too large to be a key \(over 1 KiB\)"):
        read_bytes(Path("/proc/self/smaps"), KEY)
    with pytest.raises(InputError, match="too large to be a key"):
        list(read_lines(Path("/proc/self/smaps"), KEY))


def test_what_is_in_a_file_comes_out(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa = 1\r\nb = 'x'\n")
    assert read_bytes(path, KEY)[0] == path.read_bytes()
    assert read_bytes(path, KEY)[1].st_ino == path.stat().st_ino
    assert begin_of(path, KEY, 4) == b"\xef\xbb\xbfa"
    assert list(read_lines(path, KEY)) == ["a = 1\r\n", "b = 'x'\n"]
    for mark in (b"", b"\xef\xbb\xbf"):
        path.write_bytes(mark + b"[a]\r\nb = [1, 2.5]\r\n")
        assert read_toml(path, ROBOT_TOML) == {"a": {"b": [1, 2.5]}}


@pytest.mark.parametrize("content", [b"," * (LONGEST_LINE + 1), b"a\n" + b"x" * 200_000 + b"\n"])
def test_a_line_without_an_end_is_refused(tmp_path, content):
    (tmp_path / "drive.csv").write_bytes(content)
    with pytest.raises(InputError, match=rf"drive\.csv: line {1 + content.count(b'a')}: over 65536 characters long"):
        list(read_lines(tmp_path / "drive.csv", DRIVE_CSV))


HOSTILE = {
    "arrays": ("a = " + "[" * 100_000, "line 1: brackets nested more than 16 deep"),
    "closed arrays": ("\n\na = " + "[" * 20 + "]" * 20, "line 3: brackets nested more than 16 deep"),
    "tables": ("a = " + "{a = " * 40_000, "brackets nested more than 16 deep"),
    "number": ("a = " + "1" * 5000, "a number or key of more than 64 characters"),
    "hexadecimal": ("a = 0x" + "f" * 5000, "a number or key of more than 64 characters"),
    "fraction": ("a = 0." + "1" * 5000, "a number or key of more than 64 characters"),
    "key": ("a" * 5000 + " = 1", "a number or key of more than 64 characters"),
    "dotted key": (".".join("a" * 100_000) + " = 1", "a key of more than 8 parts"),
    "spaced key": (" . ".join("a" * 50_000) + " = 1", "a key of more than 8 parts"),
    "quoted key": (".".join(['"a"'] * 50_000) + " = 1", "a key of more than 8 parts"),
    "table's name": ("[" + ".".join("a" * 100_000) + "]", "a key of more than 8 parts"),
    "list's name": ("[[" + ".".join("a" * 100_000) + "]]", "a key of more than 8 parts"),
    "key in a table": ("a = {" + ".".join("a" * 100_000) + " = 1}", "a key of more than 8 parts"),
    "string": ('a = "' + "x" * 5000 + '"', "a string of more than 4096 characters"),
    "open string": ('a = """' + '\\"""' * 50_000, "a string of more than 4096 characters"),
    "open string with a stroke": ('a = """' + '\\"""' * 50_000 + "\\", "a string of more than 4096 characters"),
    "open literal": ("a = '''" + "''x" * 50_000, "a string of more than 4096 characters"),
}


@pytest.mark.parametrize(("text", "message"), HOSTILE.values(), ids=HOSTILE)
def test_what_would_keep_a_parser_busy_is_refused_with_its_line(text, message):
    with pytest.raises(InputError, match=message) as refused:
        parse_toml(text.encode(), "robot.toml")
    assert "\n" not in str(refused.value)


def test_what_is_long_or_bracketed_in_strings_and_comments_counts_for_nothing():
    text = f"""
# {"[" * 100} {"9" * 100} {"a." * 100}
a = "{"[" * 100} {"a." * 50} \\" # ["   # a " in a comment
b = '{"{" * 100} \\'
c = \"\"\"{"[" * 20}
a "quoted" ]{"[" * 30} \\\"\"\" end\"\"\"\"
d = '''{"[" * 20}
it's'''
"e.f" = [0.1, 2.3, 4.5, 6.7, 8.9, 1.1, 1.2, 1.3, 1.4, 1.5, 1979-05-27T07:32:00.999999-07:00]
"""
    assert parse_toml(text.encode(), "x") == tomllib.loads(text)


values = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=6,
)


def _written(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            import json

            return json.dumps(value).replace("\x7f", "\\u007f")
        case list():
            return "[" + ", ".join(map(_written, value)) + "]"
    return repr(value)


KEYS = st.text(alphabet=f"{string.ascii_letters}{string.digits}_-", min_size=1, max_size=20)
TABLE = st.dictionaries(KEYS, values, max_size=5)


@examples(quick=40, every=100, table=TABLE)
def test_any_file_of_a_sensible_shape_is_read_as_the_parser_reads_it(table):
    text = "".join(f"{key} = {_written(value)}\n" for key, value in table.items())
    try:
        expected = tomllib.loads(text)
    except ValueError:
        return
    assert parse_toml(text.encode(), "x") == expected


@given(st.text(alphabet="\"'\\#[]{}=.,a1_- \n", max_size=200))
def test_any_text_is_read_or_refused_in_one_line(text):
    message = ""
    try:
        parse_toml(text.encode(), "x")
    except InputError as error:
        message = str(error)
    assert "\n" not in message


# Files that no user names: of the package, of the kernel, of this program's own processes, or written and not read.
ALLOWED_CALLS = {
    "disco_hw/files/__init__.py": {"os.open", "tomllib.loads"},
    "disco_hw/daemon/control_socket.py": {"os.open"},
    "disco_hw/processes/__init__.py": {"read_text"},
    "disco_hw/experiments/adapt.py": {"np.genfromtxt", "open"},
    "disco_hw/experiments/circle_report.py": {"open"},
    "disco_hw/experiments/demo.py": {"read_text"},
    "disco_hw/experiments/__init__.py": {"open", "read_text"},
    "disco_hw/jit/__init__.py": {"read_bytes"},
    # This process's own memory.
    "disco_hw/log/importing/rosbag_file.py": {"read_text"},
    "disco_hw/log/writer.py": {"os.open"},
    "disco_hw/viewer/operator_controls.py": {"read_text"},
    "disco_hw/viewer/server.py": {"read_bytes"},
    # A directory, to lock it.
    "drivers/kernel_cache.py": {"os.open"},
    # A serial port, to lock it.
    "drivers/transport/can.py": {"read_text", "os.open"},
    "sim/fault_schedule.py": {"tomllib.loads"},
    "sim/serial_line.py": {"os.open"},
}
READING = {
    "os.open",
    "tomllib.load",
    "tomllib.loads",
    "json.load",
    "np.load",
    "np.loadtxt",
    "np.genfromtxt",
    "np.fromfile",
}
METHODS = {"read_text", "read_bytes"}
# Without one of these calls a module reads no file, and need not be parsed.
SUSPECT = re.compile(rf"\b(open|{'|'.join({name.rpartition('.')[2] for name in READING | METHODS})})\s*\(")


def reads(source: str) -> set[str]:
    """What of a module's text reads files, by the name that it is called by."""
    found = set()
    for node in ast.walk(ast.parse(source)) if SUSPECT.search(source) else ():
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        method = name.rpartition(".")[2]
        if name in READING:
            found.add(name)
        elif method in METHODS and isinstance(node.func, ast.Attribute):
            found.add(method)
        elif name == "open" or (method == "open" and "." in name):
            mode = _mode(node, 1 if name in {"open", "io.open"} else 0)
            # Whatever else has a method of that name (a transport, a shutter) takes no mode for reading.
            if (name == "open" or node.args or node.keywords) and not set(mode) & set("wxa"):
                found.add("open")
    return found


def _mode(call: ast.Call, place: int) -> str:
    given = [keyword.value for keyword in call.keywords if keyword.arg == "mode"] + call.args[place : place + 1]
    return str(given[0].value) if given and isinstance(given[0], ast.Constant) else "r"


def test_nothing_else_reads_the_files_of_users():
    found = {
        str(path.relative_to(ROOT)): reads(path.read_text("utf-8"))
        for package in ("disco_hw", "drivers", "sim")
        for path in sorted((ROOT / package).rglob("*.py"))
    }
    assert {
        name: calls - ALLOWED_CALLS.get(name, set())
        for name, calls in found.items()
        if calls - ALLOWED_CALLS.get(name, set())
    } == {}


@pytest.mark.parametrize(
    ("source", "call"),
    [
        ("open(path)", "open"),
        ("with path.open('rb') as file: pass", "open"),
        ("path.open(encoding='utf-8')", "open"),
        ("io.open(path, 'r')", "open"),
        ("tomllib.load(file)", "tomllib.load"),
        ("os.open(path, 0)", "os.open"),
        ("path.read_text('utf-8')", "read_text"),
        ("Path(name).read_bytes()", "read_bytes"),
        ("np.loadtxt(path)", "np.loadtxt"),
    ],
)
def test_what_would_be_found(source, call):
    assert reads(source) == {call}


@pytest.mark.parametrize(
    "source", ["transport.open()", "path.open('wb')", "path.open('x', newline='')", "open(p, 'a')"]
)
def test_what_is_let_be(source):
    assert not reads(source)


def test_a_file_that_stays_open_or_is_closed_for_others_is_noticed():
    def leaks():
        os.open("/dev/null", os.O_RDONLY)
        raise InputError("left open")

    def closes():
        os.close(0)
        raise InputError("not its own")

    assert not leaves_as_open(leaks)
    assert not leaves_as_open(closes)
