"""Whether a log shows an effect that the model lacks: the search of `gap`, in a process beside the inference.

Fitted alone, the parameters absorb such an effect, sharply and wrongly; no width of the posterior tells.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection

from disco_hw.errors import InputError, WorkError
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model


@dataclass(frozen=True, slots=True)
class GapCheck:
    """Names of `missing` effects, the surest first; `not_judged` says why the log could not be searched, if so."""

    missing: tuple[str, ...] = ()
    not_judged: str | None = None


def gap_check(log: DriveLog, model: Model) -> GapCheck:
    """Search a log for effects that a model lacks."""
    from disco_hw.gap.find import missing_effects  # noqa: PLC0415  (slow to import, needed only in that process)

    try:
        return GapCheck(missing_effects(log, model))
    except InputError as error:
        return GapCheck(not_judged=str(error))


@contextmanager
def gap_check_beside(log: DriveLog, model: Model) -> Iterator[Callable[[], GapCheck]]:
    """Begin the search in a process of its own; yields what waits for its result, which raises WorkError."""
    context = get_context("spawn")
    result, send = context.Pipe(duplex=False)
    process = context.Process(target=_search, args=(send, log, model), name="gap-check", daemon=True)
    process.start()
    send.close()

    def wait() -> GapCheck:
        try:
            found: GapCheck = result.recv()
        except EOFError:
            raise WorkError("the search for missing effects broke off; run `disco-hw gap` to see why") from None
        return found

    try:
        yield wait
    finally:
        process.terminate()
        process.join()
        result.close()


def _search(send: Connection, log: DriveLog, model: Model) -> None:
    # Ctrl-C is for the parent, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    send.send(gap_check(log, model))
