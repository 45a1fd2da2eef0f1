"""Message definitions that a bag brings along: parsed only for topics that are used, and within bounded time.

A definition is foreign text in the hands of a recursive grammar with regular expressions: 900 bytes of it can keep the
parser busy for minutes. ROS's own types need no definition.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any

PARSE_LIMIT_S = 0.5
"""CPU time for all definitions of a bag together; a usual one takes some milliseconds."""
# Chosen: a line or two; a parser's error may quote the whole definition.
_LONGEST_TEXT = 200


class Definitions:
    """The types of a bag: those of `store` (rosbags), and those that the bag defines, once they are asked for."""

    def __init__(self, store: Any) -> None:  # Any: the library's class.
        self._store = store
        self._faults: dict[str, str] = {}
        self._left_s = PARSE_LIMIT_S

    def fault(self, connection: Any) -> str:  # Any: a connection of the library.
        """Return why messages of this connection cannot be read; empty if they can."""
        encoding = getattr(connection.ext, "serialization_format", "cdr")
        if encoding != "cdr":
            return f"it is encoded as {encoding}, not as CDR"
        kind = connection.msgtype
        if kind in self._store.fielddefs:
            return ""
        if kind not in self._faults:
            self._faults[kind] = self._define(kind, connection.msgdef)
        return self._faults[kind]

    def _define(self, kind: str, definition: Any) -> str:
        """Add a type to the store; returns why that is not possible, or an empty text."""
        from rosbags.interfaces import MessageDefinitionFormat  # noqa: PLC0415
        from rosbags.typesys import get_types_from_idl, get_types_from_msg  # noqa: PLC0415

        if definition.format == MessageDefinitionFormat.NONE:
            return f"its type {kind} is not of ROS and the bag does not define it"

        def register() -> None:
            """Parse the definition and make what reads its messages."""
            is_msg = definition.format == MessageDefinitionFormat.MSG
            found = get_types_from_msg(definition.data, kind) if is_msg else get_types_from_idl(definition.data)
            self._store.register({name: fields for name, fields in found.items() if name not in self._store.fielddefs})
            if kind in self._store.fielddefs:
                self._store.get_msgdef(kind)

        # A regular expression that is at work hears no signal: it is tried where it can be ended.
        used_s = _cpu_time_s(register, self._left_s) if self._left_s > 0.0 else None
        if used_s is None:
            self._left_s = 0.0
            return f"the bag's definition of {kind} takes over {PARSE_LIMIT_S:g} s to parse"
        self._left_s -= used_s
        try:
            register()
        except Exception as error:
            # A type that cannot be read must not spoil the bag.
            reason = " ".join(str(error).split())[:_LONGEST_TEXT].rstrip(".") or type(error).__name__
            return f"the bag's definition of {kind} cannot be read ({reason})"
        return "" if kind in self._store.fielddefs else f"the bag does not define its type {kind}"


def _cpu_time_s(work: Callable[[], None], limit_s: float) -> float | None:
    """CPU time that `work` takes in a fork of this process; None if it exceeds the limit or crashes."""
    child = os.fork()
    if child == 0:
        try:
            signal.signal(signal.SIGPROF, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_PROF, limit_s)
            work()
        finally:
            # An exception too: this process's own attempt reports it.
            os._exit(0)
    _, how, usage = os.wait4(child, 0)
    return None if os.WIFSIGNALED(how) else usage.ru_utime + usage.ru_stime
