"""The command `disco-hw`: a file for each group of verbs, gathered in `app`; here errors become an exit code.

A stop that is written as in the documents goes past the command-line library, which takes as long to load and to list
every verb as the stop itself.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from disco_hw.errors import InputError, WorkError
from disco_hw.processes import PARENT_VARIABLE, end_with_parent

_YOUNG_OBJECTS = 50_000


def main() -> None:
    """Entry point: bad input prints one line and exits with 2, failed work with 1."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is not None:
        end_with_parent(int(parent))
    # Imports make many objects and no garbage: looking for it on the way took a fourteenth of what `estop` computes.
    gc.set_threshold(_YOUNG_OBJECTS)
    try:
        stop = plain_stop(sys.argv[1:])
        if stop is not None:
            raise SystemExit(stop_and_say(*stop))
        from disco_hw.cli.app import app

        app(prog_name="disco-hw")
    except InputError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except WorkError as error:
        print(f"disco-hw: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def plain_stop(words: Sequence[str]) -> tuple[Path, str | None, bool] | None:
    """The robot file, --link and --json of `estop`; None for another verb, and for whatever needs help or an error."""
    if not words or words[0] != "estop":
        return None
    files: list[str] = []
    link, as_json = None, False
    left = iter(words[1:])
    for word in left:
        if word == "--json":
            as_json = True
        elif word == "--link":
            link = next(left, None)
            if link is None:
                return None
        elif word.startswith("--link="):
            link = word.removeprefix("--link=")
        elif word.startswith("-"):
            return None
        else:
            files.append(word)
    return (Path(files[0]), link, as_json) if len(files) == 1 else None


def stop_and_say(robot: Path, link: str | None, as_json: bool) -> int:
    """Stop the robot, print the outcome, and return the exit code: 0 only if the robot confirmed that it is stopped."""
    from disco_hw.daemon.emergency import stop_robot
    from disco_hw.reports import as_json as json_of

    outcome = stop_robot(robot, link)
    print(json_of(outcome.as_dict()) if as_json else outcome.as_text())
    return 0 if outcome.confirmed else 1
