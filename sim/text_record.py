"""A text file written while the robot runs: when it cannot be written any more, that is told, and all goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TextIO


class TextRecord:
    """Writes lines to `path`, which is emptied. Raises OSError if it cannot be opened; afterwards nothing raises.

    The first error is told in one sentence and kept in `error`; what comes after it is not written.
    """

    def __init__(self, path: Path, tell: Callable[[str], object]) -> None:
        self.error: str | None = None
        self._path = path
        self._tell = tell
        self._file: TextIO = path.open("w", encoding="utf-8")

    def line(self, text: str) -> None:
        """Write one line, without its end."""
        self._try(lambda: self._file.write(text + "\n"))

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        self._try(self._file.flush)

    def close(self) -> None:
        """Write what is left and close; safe to call twice."""
        self._try(self._file.close)

    def _try(self, action: Callable[[], object]) -> None:
        if self.error is not None:
            return
        try:
            action()
        except OSError as error:
            self.error = f"{self._path}: {error.strerror}; nothing more is recorded in it"
            self._tell(self.error)
