"""Exceptions for what a user did wrong, and for work that failed."""

from typing import NamedTuple


class FieldFault(NamedTuple):
    """Fault in a section of robot.toml that no single value shows: the field to change, the fault, the remedy."""

    field: str
    fault: str
    hint: str


class InputError(Exception):
    """Error for wrong input; the message is one line: file, field and remedy; commands exit with 2."""


class WorkError(Exception):
    """The work itself failed: the message is one line that says what and why; commands exit with 1."""


class LogError(InputError):
    """A log cannot be made, read or mended; the message is one line: file, what is wrong, what to do."""
