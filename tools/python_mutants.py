"""Shows which changes of a Python file its fast tests notice: one operator, number or truth value at a time.

    python -m tools.python_mutants FILE.py ... [--tests PATH ...] [--leave-out TEXT ...] [--every N [--first N]]

Each mutant is run, in a process forked for it, with those tests that ran the statement that it changes, the quickest
first, until one fails. Those that nothing can tell from the original are in python_equivalents.toml, each with its
reason. Exits 1 if any other survives.
"""

import argparse
import ast
import importlib.abc
import importlib.util
import os
import re
import resource
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

import pytest

from tools.check.mutation import FAST_TESTS, Mutant, marked

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENTS = Path(__file__).with_name("python_equivalents.toml")
PROJECT = ("disco_hw", "drivers", "firmware_protocol", "sim", "tools", "tests")
TESTS = ("tests/gap",)
# A mutant that loops for ever is ended.
CPU_S = 40
# Smaller constants only keep a quotient or a root finite.
LEAST_NUMBER = 1e-6

_COMPARED: dict[type[ast.cmpop], tuple[str, tuple[str, ...]]] = {
    ast.Lt: ("<", ("<=", ">=")), ast.LtE: ("<=", ("<", ">")), ast.Gt: (">", (">=", "<=")), ast.GtE: (">=", (">", "<")),
    ast.Eq: ("==", ("!=",)), ast.NotEq: ("!=", ("==",)), ast.Is: ("is", ("is not",)), ast.IsNot: ("is not", ("is",)),
    ast.In: ("in", ("not in",)), ast.NotIn: ("not in", ("in",)),
}  # fmt: skip
_COMPUTED: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.MatMult: ("@", "*"),
    ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.Pow: ("**", "*"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
_JOINED: dict[type[ast.boolop], tuple[str, str]] = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
_NAMED = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax",
          "argmax": "argmin", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}  # fmt: skip
# Whether sequences are as long as each other, and how a dataclass prints, changes no result.
_PASSED_OVER = ("strict", "repr", "compare")


@dataclass(frozen=True, slots=True)
class Placed:
    """A mutant, the lines of the statement that it changes, and whether that runs when the module is imported."""

    mutant: Mutant
    lines: frozenset[int]
    on_import: bool


class _Finder(ast.NodeVisitor):
    """Collects the mutants of a source."""

    def __init__(self, source: str) -> None:
        self.source, self.found = source, list[Placed]()
        lines = source.splitlines(keepends=True)
        self.begins = [0, *(sum(len(line) for line in lines[: k + 1]) for k in range(len(lines)))]
        self.statement: frozenset[int] = frozenset()
        self.depth = 0

    def at(self, line: int, byte: int) -> int:
        text = self.source[self.begins[line - 1] : self.begins[line]]
        return self.begins[line - 1] + len(text.encode()[:byte].decode())

    def start(self, node: ast.expr | ast.stmt) -> int:
        return self.at(node.lineno, node.col_offset)

    def end(self, node: ast.expr | ast.stmt) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.at(node.end_lineno, node.end_col_offset)

    def add(self, offset: int, old: str, new: str) -> None:
        self.found.append(Placed(marked(self.source, offset, old, new), self.statement, self.depth == 0))

    def between(self, left: ast.expr, right: ast.expr, old: str, new: Sequence[str]) -> None:
        offset = self.source.index(old, self.end(left), self.start(right))
        for one in new:
            self.add(offset, old, one)

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.stmt):
            first = node.lineno
            inside = [child.lineno for name in ("body",) for child in getattr(node, name, [])]
            last = min(inside) - 1 if inside else node.end_lineno or first
            self.statement = frozenset(range(first, max(last, first) + 1))
        super().visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for default in (*node.args.defaults, *(one for one in node.args.kw_defaults if one is not None)):
            self.visit(default)
        # What is compiled runs unseen.
        seen = not any(isinstance(one, ast.Name) and one.id.endswith("_function") for one in node.decorator_list)
        self.depth += seen
        for child in node.body:
            self.visit(child)
        self.depth -= seen

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for child in node.body:
            self.visit(child)

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self.visit(node.body)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Assert(self, node: ast.Assert) -> None:
        pass

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        pass

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in _PASSED_OVER:
            self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self.between(left, right, *_COMPARED[type(operator)])
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if type(node.op) in _COMPUTED:
            old, new = _COMPUTED[type(node.op)]
            self.between(node.left, node.right, old, [new])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        old, new = _COMPUTED[type(node.op)]
        self.between(node.target, node.value, f"{old}=", [f"{new}="])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = _JOINED[type(node.op)]
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, right, old, [new])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        token = {ast.Not: "not", ast.USub: "-", ast.Invert: "~"}.get(type(node.op))
        if token is not None:
            self.add(self.start(node), token, "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        start = self.start(node)
        text = self.source[start : self.end(node)]
        if isinstance(node.value, bool):
            self.add(start, text, str(not node.value))
        elif isinstance(node.value, int):
            for new in (node.value + 1, node.value - 1):
                self.add(start, text, str(new) if new >= 0 else f"({new})")
        elif isinstance(node.value, float) and node.value == 0.0:
            self.add(start, text, "0.5")
        elif isinstance(node.value, float) and node.value >= LEAST_NUMBER:
            for new_value in (node.value * 1.25, node.value * 0.8):
                self.add(start, text, repr(new_value))

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func
        if isinstance(called, ast.Name) and called.id in _NAMED:
            self.add(self.start(called), called.id, _NAMED[called.id])
        elif isinstance(called, ast.Attribute) and called.attr in _NAMED:
            self.add(self.end(called) - len(called.attr), called.attr, _NAMED[called.attr])
        self.generic_visit(node)

    def visit_Break(self, node: ast.Break) -> None:
        self.add(self.start(node), "break", "continue")

    def visit_Continue(self, node: ast.Continue) -> None:
        self.add(self.start(node), "continue", "break")

    def condition(self, test: ast.expr) -> None:
        if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp):
            text = self.source[self.start(test) : self.end(test)]
            self.add(self.start(test), text, f"(not ({text}))")

    def visit_If(self, node: ast.If) -> None:
        self.condition(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self.condition(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self.condition(test)
        self.generic_visit(node)


def mutants(source: str) -> list[Placed]:
    """Every mutant of comparisons, logic, arithmetic, numbers, truth values, extremes, conditions and jumps.

    A whole number becomes one more and one less, a fraction a quarter more and a fifth less, nothing a half. Left alone
    are annotations, decorators, assertions and what is printed.
    """
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    return finder.found


def module_name(path: Path) -> str:
    """The name by which the project imports a file."""
    parts = path.resolve().relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class Mutated(importlib.abc.MetaPathFinder):
    """Has one module come from another file."""

    def __init__(self, name: str, original: Path, file: Path) -> None:
        self.name, self.original, self.file = name, original, file

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self.name:
            return None
        inside = [str(self.original.parent)] if self.original.name == "__init__.py" else None
        return importlib.util.spec_from_file_location(fullname, self.file, submodule_search_locations=inside)


@contextmanager
def quiet() -> Iterator[None]:
    """Without what tests print."""
    sys.stdout.flush()
    kept, devnull = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    for place in (1, 2):
        os.dup2(devnull, place)
    try:
        yield
    finally:
        for place, was in zip((1, 2), kept, strict=True):
            os.dup2(was, place)


def run_tests(arguments: Sequence[str], plugins: Sequence[Any] = ()) -> int:
    """Run those of some tests that `make test` runs until one fails."""
    options = ["-x", "-n", "0", "-m", FAST_TESTS, "-p", "no:cacheprovider", "-o", "timeout=0", "-p", "no:playwright"]
    with quiet():
        return int(pytest.main([*options, *arguments], plugins=list(plugins)))


class Watched:
    """Which lines of some files each test runs, and how long it takes, and which run on import; a plugin of pytest."""

    def __init__(self, files: Sequence[Path], leave_out: Sequence[str]) -> None:
        self.files, self.leave_out = {str(file) for file in files}, leave_out
        self.lines: set[tuple[str, int]] = set()
        self.on_import: set[tuple[str, int]] = set()
        self.failed = "not one is run"
        self.tests: dict[str, tuple[float, list[tuple[str, int]]]] = {}

    def pytest_collection(self) -> None:
        sys.settrace(self.traced)

    def pytest_collection_finish(self) -> None:
        sys.settrace(None)
        self.on_import = self.lines

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = [item for item in items if not any(text in item.nodeid for text in self.leave_out)]

    def traced(self, frame: FrameType, event: str, _: Any) -> Any:
        name = frame.f_code.co_filename
        if name not in self.files:
            return None
        self.lines.add((name, frame.f_lineno))
        return self.traced

    def pytest_runtest_logstart(self) -> None:
        self.lines = set()
        self.began = time.process_time()
        sys.settrace(self.traced)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.failed = f"{report.nodeid}: {report.longrepr}"

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        sys.settrace(None)
        self.tests[nodeid] = time.process_time() - self.began, sorted(self.lines)


@cache
def imported_by(path: Path) -> frozenset[str]:
    """Names of what a file imports, each of which may be a module or something in one."""
    found = set()
    source = path.read_text("utf-8")
    for node in statements(ast.parse(source).body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    if re.search(r"\w\.iter_modules\(", source):
        # A registry imports whatever lies in its folder.
        found |= {module_name(each) for each in path.parent.glob("*.py")}
    return frozenset(found)


def statements(body: Sequence[ast.AST]) -> Iterator[ast.AST]:
    """Yield all statements, without their expressions, of which there are ten times as many."""
    for node in body:
        yield node
        for name in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, name, ()))


def touched_by(name: str) -> set[str]:
    """Names of the project's modules that are there and import this one, if only through others; all tests."""
    modules = {one: module for one, module in sys.modules.items() if one.partition(".")[0] in PROJECT}
    # The compiled core's library has no file.
    files = {one: getattr(module, "__file__", None) for one, module in modules.items()}
    tests = {one for one in files if one.startswith("tests")}
    # What is no test imports none.
    sources = {one: Path(file) for one, file in files.items() if file and file.endswith(".py") and one not in tests}
    imports = {one: imported_by(file) for one, file in sources.items()}
    touched = {name}
    while True:
        more = {one for one, others in imports.items() if others & touched} - touched
        if not more:
            return touched | tests
        touched |= more


def forget(name: str) -> None:
    """Have a module imported anew: its package keeps it, too, and hands it to `from package import module`."""
    sys.modules.pop(name, None)
    package, _, own = name.rpartition(".")
    if package in sys.modules and isinstance(getattr(sys.modules[package], own, None), ModuleType):
        delattr(sys.modules[package], own)


@dataclass(frozen=True)
class Trial:
    """Trial of mutants of one file: the modules that have to be imported again, and a folder for its text."""

    name: str
    file: Path
    touched: set[str]
    folder: Path

    def killed(self, text: str, tests: Sequence[str]) -> bool:
        """Whether one of some tests fails with the file's text replaced, in a process of its own."""
        mutated = self.folder / f"{self.name}.py"
        mutated.write_text(text, "utf-8")
        process = os.fork()
        if process == 0:
            status = 99
            try:
                resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
                for one in self.touched:
                    forget(one)
                sys.meta_path.insert(0, Mutated(self.name, self.file, mutated))
                named = dict.fromkeys(test.partition("[")[0] if " at 0x" in test else test for test in tests)
                # File by file, so that the others need not even be collected.
                files = dict.fromkeys(test.partition("::")[0] for test in named)
                status = any(run_tests([test for test in named if test.partition("::")[0] == one]) for one in files)
            finally:
                os._exit(status)
        return os.waitpid(process, 0)[1] != 0


def sweep(files: Sequence[Path], given: argparse.Namespace, folder: Path) -> Counter[tuple[str, str]]:
    """Try the mutants of these files; survivors on stdout. Raises RuntimeError if the unchanged files fail."""
    known = tomllib.loads(EQUIVALENTS.read_text("utf-8")) if EQUIVALENTS.exists() else {}
    watched = Watched(files, given.leave_out)
    if run_tests(given.tests, [watched]) != 0:
        raise RuntimeError(f"the unchanged files fail their tests: {watched.failed}")
    tests = sorted(watched.tests.items(), key=lambda one: one[1][0])
    counts: Counter[tuple[str, str]] = Counter()
    for file in files:
        source, here, name = file.read_text("utf-8"), str(file.relative_to(ROOT)), module_name(file)
        on_import = {line for of, line in watched.on_import if of == str(file)}
        trial = Trial(name, file, touched_by(name), folder)
        ran = {test: {line for of, line in lines if of == str(file)} for test, (_, lines) in tests}
        every = [test for test, lines in ran.items() if lines]
        if trial.killed(source, every):
            raise RuntimeError(f"{here}: fails its tests unchanged: every mutant would pass for noticed")
        for placed in mutants(source)[given.first :: given.every]:
            mutant = placed.mutant
            # A function may be called when its module is imported.
            imported = placed.on_import or placed.lines & on_import
            chosen = every if imported else [test for test in every if ran[test] & placed.lines]
            began = time.monotonic()
            if mutant.key in known.get(here, {}):
                outcome = "equivalent"
            elif chosen and trial.killed(mutant.apply(source), chosen):
                outcome = "killed"
            else:
                outcome = "SURVIVED"
                print(f"SURVIVED {here}:{mutant.line}: {mutant.key} ({len(chosen)} tests)", flush=True)
            counts[here, outcome] += 1
            if given.verbose:
                took_s = time.monotonic() - began
                print(f"{sum(counts.values())} {outcome} {mutant.line} {took_s:.1f} s", file=sys.stderr, flush=True)
    return counts


def main() -> int:
    """Sweep, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE.py")
    parser.add_argument("--tests", nargs="+", default=TESTS, metavar="PATH")
    parser.add_argument("--leave-out", nargs="+", default=(), metavar="TEXT", help="tests with this in their names")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only each Nth mutant of each file")
    parser.add_argument("--first", type=int, default=0, metavar="N")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    files = [file.resolve() for file in given.files]
    with tempfile.TemporaryDirectory() as folder:
        counts = sweep(files, given, Path(folder))
    outcomes = ("killed", "equivalent", "SURVIVED")
    print(f"{'file':<50}" + "".join(f"{outcome:>12}" for outcome in outcomes))
    for name in (str(file.relative_to(ROOT)) for file in files):
        print(f"{name:<50}" + "".join(f"{counts[name, outcome]:>12}" for outcome in outcomes))
    return int(any(outcome == "SURVIVED" for _, outcome in counts))


if __name__ == "__main__":
    sys.exit(main())
