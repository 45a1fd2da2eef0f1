"""Whether measured logs whose poses or commands are moved in time are found moved by as much, and nothing else said.

`DISCO_HW_DATA=FOLDER python -m tools.gap_shifts [NAME...]`: logs whose path holds a NAME, all without one. Poses are
moved by -0.32 to 0.32 s and the channel from wheel to body is searched, commands by 0.1 to 0.4 s and that from command
to wheel. Found: within 20 ms of the move and of what the log itself shows with the same delays in the fit, named there
or not; a name that the log itself has not is one too many. "said": not found, and the log is told not to show it.
Then commands are moved from the middle on, and whether the log is told to jump, by how much and when.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

# Each process works alone on one log: a second thread for its small matrices would only be in another one's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.data.command_timing import command_clock
from disco_hw.gap.data.gridded_drive import grid_drive, undo_sample_hold
from disco_hw.gap.data.stamp_clock import StampClock
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.channel_search import search_body, search_wheels
from disco_hw.gap.search.richest_model import LATE, LATE_COLUMNS, OLD_POSE_COLUMNS
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.log.drive import DriveLog
from tools.gap_halves import measured_logs, read, vector

# Some are no whole cells of the grid and no steps of a scan.
POSES_BY_S = (-0.32, -0.317, -0.203, -0.2, -0.1, 0.1, 0.107, 0.2, 0.213, 0.32)
COMMANDS_BY_S = (0.1, 0.107, 0.2, 0.213, 0.4)
JUMPS_BY_S = (-0.2, 0.1, 0.2, 0.4)
WITHIN_S = 0.02
POSE_TIME = tuple(column.partition(".")[0] for column in OLD_POSE_COLUMNS)


@dataclass(frozen=True)
class Shift:
    """What one search said of a log moved by `moved_s`: how far it is found moved, and names that it has besides.

    `said`: that the time of this part of the log is told not to be known.
    """

    log: str
    part: str
    moved_s: float
    found_s: float
    besides: tuple[str, ...]
    said: bool

    @property
    def found(self) -> bool:
        """Whether the move was found."""
        return abs(self.found_s - self.moved_s) <= WITHIN_S


def told(found: ChannelResult) -> set[str]:
    """Every name and form that a search of a channel came to."""
    return {*found.names, *(form_of(term.form) for term in found.unnamed)}


def form_of(text: str) -> str:
    """A term as it is written, without its coefficient."""
    target, _, rest = text.partition(" += ")
    return f"{target} += k {rest.partition(' ')[2]}"


def late_s(found: ChannelResult, columns: Sequence[str]) -> float:
    """Sum of what was found of some delays, s; what has no name is none."""
    place = found.selector.channel.layout.place
    return sum(float(found.told.vector[place[each]]) for each in columns if each.partition(".")[0] in found.names)


def shown_s(found: ChannelResult, columns: Sequence[str], names: Sequence[str]) -> float:
    """The same of a log that was not moved, with delays of these names in the fit: its own may be too short for one."""
    timed = {each.partition(".")[0] for each in columns}
    missing = (name for name in names if name in timed and name not in found.names)
    return late_s(replace(found, names=(*found.names, *missing)), columns)


def moved(log: DriveLog, part: str, by_s: float) -> DriveLog:
    """The log with the stamps of its poses or commands moved."""
    samples = getattr(log, part)
    return replace(log, **{part: replace(samples, t_s=samples.t_s + by_s)})


def compare(
    log: str, part: str, searched: Mapping[float, ChannelResult], columns: Sequence[str], names: Sequence[str]
) -> Iterator[Shift]:
    """The moves of one part of a log against the log itself, which was moved by 0.

    Commands that are late shorten the answer.
    """
    plain, sign = searched[0.0], -1.0 if part == "commands" else 1.0
    for by_s, one in searched.items():
        if by_s:
            found_s = sign * (late_s(one, columns) - shown_s(plain, columns, one.names))
            said = part == "commands" and not one.channel.drive.commands_timed
            yield Shift(log, part, by_s, found_s, tuple(sorted(told(one) - told(plain) - set(names))), said)


def shifts(path: Path) -> Iterator[Shift]:
    """Every move of a log."""
    log, nominal = read(path)
    body, wheels = vector(BODY, nominal), vector(WHEEL, nominal)
    drive = grid_drive(log)
    geometry = body[:3]
    if drive.has_poses:
        searched = {by_s: search_body(grid_drive(moved(log, "poses", by_s)), body) for by_s in (0.0, *POSES_BY_S)}
        geometry = searched[0.0].fit.vector[:3]
        yield from compare(path.stem, "poses", searched, OLD_POSE_COLUMNS, POSE_TIME)
    if drive.has_commands:
        searched = {
            by_s: search_wheels(grid_drive(moved(log, "commands", by_s)), geometry, wheels)
            for by_s in (0.0, *COMMANDS_BY_S)
        }
        yield from compare(path.stem, "commands", searched, LATE_COLUMNS, LATE)


def jumped(log: DriveLog, by_s: float) -> StampClock:
    """The clock that is seen of commands whose stamps are moved from the middle on."""
    commands, settings = log.commands, DEFAULT_SETTINGS.grid
    known_s = commands.t_s[np.isfinite(commands.left_rad_s)]
    later = commands.t_s >= 0.5 * (known_s[0] + known_s[-1])
    moved = StampClock(0.0, jump_s=-by_s, jump_at_s=float(commands.t_s[later][0])).corrected(commands)
    return command_clock(undo_sample_hold(log.wheels, settings), moved, settings)[0]


def row(of: Shift) -> str:
    """One line of the table."""
    missed = "said" if of.said else "no"
    cells = (of.log, of.part, f"{of.moved_s:+.2f}", f"{of.found_s:+.3f}", "" if of.found else missed)
    return f"| {' | '.join([*cells, ', '.join(of.besides).replace('|', chr(92) + '|')])} |"


def main(names: Sequence[str]) -> int:
    print("| log | moved | by, s | found, s | within 20 ms | named besides |")
    print("|---|---|---|---|---|---|")
    found: list[Shift] = []
    began = time.process_time()
    paths = measured_logs(names)
    for path in paths:
        for shift in shifts(path):
            found.append(shift)
            print(row(shift), flush=True)
    for part in ("poses", "commands"):
        own = [shift for shift in found if shift.part == part]
        alone = sum(not shift.besides for shift in own)
        found_here, said = sum(shift.found for shift in own), sum(shift.said and not shift.found for shift in own)
        print(f"\n{part}: found within 20 ms {found_here} of {len(own)}, said not to be known {said}, alone {alone}")
    print("\n| log | commands move from the middle on by, s | told to jump by, s | drift, s |")
    print("|---|---|---|---|")
    told_to, many = 0, 0
    for path in paths:
        log, _ = read(path)
        if not grid_drive(log).has_commands:
            continue
        for by_s in (0.0, *JUMPS_BY_S):
            clock = jumped(log, by_s)
            many += by_s != 0.0
            told_to += by_s != 0.0 and not clock.even
            print(f"| {path.stem} | {by_s:+.2f} | {clock.jump_s:+.3f} | {clock.drift_s:+.3f} |", flush=True)
    print(f"\nan uneven clock is told of in {told_to} of {many}")
    print(f"CPU {time.process_time() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
