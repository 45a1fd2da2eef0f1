"""Mutants of C source: one token changed at a time. Pure text; what does not compile is for the caller to find out."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

# The tests that must notice a mutant: those that `make test` runs.
FAST_TESTS = "not long and not thorough"

# Comments, character and string constants are passed over; numbers, words and the longest operators are tokens.
_TOKEN = re.compile(
    r"""(?P<skip>/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|\#\s*include[^\n]*|\#\s*if[^\n]*|\#\s*endif)
      |(?P<number>\b(?:0[xX][0-9a-fA-F]+|\d+\.\d*(?:[eE][+-]?\d+)?|\d+)[uUlLfF]*)
      |(?P<word>[A-Za-z_]\w*)
      |(?P<operator>->|\+\+|--|<<=|>>=|<<|>>|<=|>=|==|!=|&&|\|\||[-+*/%&|^]=|[-+*/%&|^<>!~])""",
    re.DOTALL | re.VERBOSE,
)
_REPLACED_BY = {
    "<": ("<=", ">="), "<=": ("<", ">"), ">": (">=", "<="), ">=": (">", "<"), "==": ("!=",), "!=": ("==",),
    "&&": ("||",), "||": ("&&",), "!": ("",), "~": ("",),
    "&": ("|",), "|": ("&",), "^": ("|",), "<<": (">>",), ">>": ("<<",),
    "+": ("-",), "-": ("+",), "*": ("/",), "/": ("*",), "%": ("*",), "++": ("--",), "--": ("++",),
    "+=": ("-=",), "-=": ("+=",), "*=": ("/=",), "/=": ("*=",), "%=": ("*=",),
    "&=": ("|=",), "|=": ("&=",), "^=": ("|=",), "true": ("false",), "false": ("true",),
}  # fmt: skip
_TABLE_ROW = 8


@dataclass(frozen=True, slots=True)
class Mutant:
    """`source` with the token `old` at `offset` replaced by `new`; `line` counts from 1."""

    offset: int
    line: int
    old: str
    new: str
    context: str

    @property
    def key(self) -> str:
        """Key that names the mutant as long as its line stays as it is: the line with the change marked in it."""
        return f"{self.context} [{self.old} -> {self.new or 'nothing'}]"

    def apply(self, source: str) -> str:
        """Return the mutated source."""
        return source[: self.offset] + self.new + source[self.offset + len(self.old) :]


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every mutant of comparisons, logic, masks, arithmetic, truth values and constants.

    A constant becomes one more and one less (a fraction: 2 % more and less); in a row of a table only one more.
    """
    for found in _TOKEN.finditer(source):
        token = found.group()
        if found.lastgroup == "number":
            start = source.rfind("\n", 0, found.start()) + 1
            row = source[start : source.find("\n", found.end())]
            replacements = _numbers(token)[: 1 if len(re.findall(r"0x\w+", row)) > _TABLE_ROW else 2]
        else:
            replacements = _REPLACED_BY.get(token, ()) if found.lastgroup != "skip" else ()
        for new in replacements:
            yield marked(source, found.start(), token, new)


def marked(source: str, offset: int, old: str, new: str) -> Mutant:
    """The mutant with `old` at `offset` replaced, which must lie in one line."""
    start = source.rfind("\n", 0, offset) + 1
    end = source.find("\n", offset)
    end = len(source) if end < 0 else end
    marked = f"{source[start:offset]}«{old}»{source[offset + len(old) : end]}"
    return Mutant(offset, source.count("\n", 0, offset) + 1, old, new, " ".join(marked.split()))


def _numbers(token: str) -> tuple[str, ...]:
    digits = token.rstrip("uUlL") if token[:2].lower() == "0x" else token.rstrip("uUlLfF")
    suffix = token[len(digits) :]
    if "." in digits:
        value = float(digits)
        return tuple(f"{other!r}{suffix}" for other in ((value * 1.02, value * 0.98) if value else (0.5,)))
    value = int(digits, 0)
    return tuple(f"{other}{suffix}" for other in (value + 1, value - 1) if other >= 0)
