"""The cells of a drive's CSV file: rows and columns as numbers, with everything that had to be left out counted.

A cell that is no finite number costs its sample and nothing else. Rows of one time are one row where their samples do
not contradict each other, as in a merge of several topics. A last line that was cut off is left out.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import LogError
from disco_hw.files import DRIVE_CSV, read_lines
from disco_hw.log.drive import Array, Index
from disco_hw.log.importing.losses import loss_note

COMMAND = ("cmd_left_rad_s", "cmd_right_rad_s")
SPEED = ("enc_left_rad_s", "enc_right_rad_s")
TICKS = ("enc_left_ticks", "enc_right_ticks")
POSITION = ("pose_x_m", "pose_y_m")
YAW = "pose_yaw_rad"
GYRO = ("imu_wz_rad_s",)
TIME = "t_s"
SEGMENT = "segment"
SIGNALS = {
    "commands": COMMAND, "wheel speeds": SPEED, "wheel ticks": TICKS, "positions": POSITION, "headings": (YAW,),
    "gyro": GYRO,
}  # fmt: skip
"""What columns together give a sample, by the name that messages have for it."""

LARGEST_DISORDER_S = 1.0
"""Rows whose times go back by less are sorted; by more, the clock was set or another run begins."""
_KNOWN = frozenset({TIME, SEGMENT, *(name for names in SIGNALS.values() for name in names)})
_EMPTY_TEXTS = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})
"""What programs write, in any case of letters, for a cell without a sample."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Sheet:
    """Columns of a CSV file: times (N,) from 0 on, segments (N,), and cells (N,) with NaN where there is no sample.

    `begin_s`: the first time as it stands in the file.
    """

    name: str
    begin_s: float
    t_s: Array
    segment: Index
    cells: dict[str, Array]
    notes: tuple[str, ...]

    def group(self, names: Sequence[str]) -> tuple[Array, Mask]:
        """Return columns side by side, (N, k), and where all of them have a value, (N,)."""
        empty = np.full(self.t_s.size, np.nan)
        values = np.column_stack([self.cells.get(name, empty) for name in names])
        there: Mask = np.isfinite(values).all(axis=1)
        return values, there


@dataclass(slots=True)
class _Faults:
    """Errors found while reading: the first place of each kind, and how many there are."""

    lines: int = 0
    uneven: list[int] = field(default_factory=list)
    timeless: list[int] = field(default_factory=list)
    cells: dict[str, list[tuple[int, str]]] = field(default_factory=dict)
    is_cut: bool = False


def read_sheet(path: Path) -> Sheet:
    """Read the known columns of a CSV file.

    Raises LogError with one line that names file, line, column and remedy: nothing in it, columns that are missing or
    twice there, a clock that goes back by over a second, or a signal of which over half cannot be read.
    """
    text = _Lines(read_lines(path, DRIVE_CSV))
    rows = _rows(path, text)
    header = [name.strip() for _, row in islice(rows, 1) for name in row]
    if not header:
        raise LogError(f"{path}: empty file; it needs a header row and samples")
    _check_header(path, header)
    lines, columns, faults = _columns(header, rows, text)
    notes = [*_notes_on_rows(path, header, faults), *_notes_on_cells(path, lines, columns, faults)]
    if not lines:
        raise LogError(f"{path}: has a header but no rows; nothing was recorded in it")
    ignored = dict.fromkeys(name or "one without a name" for name in header if name not in _KNOWN)
    if ignored:
        notes.append(f"{path}: ignored columns: {', '.join(ignored)}")
    return _in_order(path, lines, columns, notes)


class _Lines:
    """The lines of a file, with whether the last one that was taken ends where a line ends."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines, self.is_complete = lines, True

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self.is_complete = line.endswith(("\n", "\r"))
        return line


def _rows(path: Path, text: _Lines) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows with their line numbers; of a last line that was cut within a quote that quote alone.

    Raises LogError for a cell that does not end in its line: a stray quote would take the rows that follow for text.
    """
    reader = csv.reader(text, strict=True)
    while True:
        line, fault = reader.line_num + 1, ""
        try:
            row = next(reader, None)
        except csv.Error as error:
            row, fault = ['"'], str(error)
        if row is None:
            return
        if reader.line_num > line:
            fault = "a cell goes on beyond the end of the line"
        elif not text.is_complete:
            fault = ""
        if fault:
            raise LogError(
                f"{path}: line {line}: {fault}; write each row in one line, and quotes only around whole cells"
            )
        yield line, row


def _columns(
    header: Sequence[str], rows: Iterator[tuple[int, list[str]]], text: _Lines
) -> tuple[Sequence[int], dict[str, Array], _Faults]:
    """Return the lines of the rows, and their known columns: NaN where a cell is empty, segments numbered from 0."""
    lines, faults = array("q"), _Faults()
    columns = {name: array("d") for name in header if name in _KNOWN}
    places = [(header.index(name), name, column) for name, column in columns.items() if name not in (SEGMENT, TIME)]
    time_at, segments = header.index(TIME), columns.get(SEGMENT)
    label_at, label, number = header.index(SEGMENT) if SEGMENT in header else 0, "", 0
    for line, row in rows:
        if not any(row):
            # Spreadsheets write commas for the rows and columns that they hold empty.
            continue
        faults.lines += 1
        if len(row) != len(header):
            if text.is_complete:
                faults.uneven.append(line)
            else:
                faults.is_cut = True
            continue
        t_s, _ = _number(row[time_at])
        if math.isnan(t_s):
            faults.timeless.append(line)
            continue
        lines.append(line)
        columns[TIME].append(t_s)
        for place, name, column in places:
            value, is_bad = _number(row[place])
            column.append(value)
            if is_bad:
                faults.cells.setdefault(name, []).append((line, row[place]))
        if segments is not None:
            # An empty cell continues the segment.
            given = row[label_at].strip()
            if given and given != label:
                number += bool(label)
                label = given
            segments.append(number)
    return lines, {name: np.array(column) for name, column in columns.items()}, faults


def _number(text: str) -> tuple[float, bool]:
    """Return the finite number in a cell, else NaN; and whether a cell that is not empty holds none."""
    if not text:
        # Half the cells are empty, and an exception costs as much as ten of them.
        return math.nan, False
    try:
        value = float(text)
    except ValueError:
        return math.nan, text.strip().lower() not in _EMPTY_TEXTS
    return (value, False) if math.isfinite(value) else (math.nan, not math.isnan(value))


def _check_header(path: Path, header: Sequence[str]) -> None:
    doubled = sorted(name for name in _KNOWN if header.count(name) > 1)
    if doubled:
        raise LogError(f"{path}: column {doubled[0]} appears twice; keep one")
    separator = next((each for each in ";\t|" if TIME in map(str.strip, header[0].split(each))), None)
    if len(header) == 1 and separator is not None:
        raise LogError(f"{path}: columns are separated by {separator!r}; separate them by commas, with decimal points")
    missing = [name for name in (TIME, *COMMAND) if name not in header]
    for group in (SPEED, TICKS, POSITION):
        if any(name in header for name in (*group, *((YAW,) if group == POSITION else ()))):
            missing += [name for name in group if name not in header]
    if missing:
        raise LogError(
            f"{path}: no column {', '.join(missing)}; the header must name t_s, {', '.join(COMMAND)} and pairs"
        )
    if not any(name in header for name in (*SPEED, *TICKS, *POSITION)):
        raise LogError(
            f"{path}: neither encoder nor pose columns; add {', '.join(SPEED)} or {', '.join(POSITION)}, {YAW}"
        )


def _notes_on_rows(path: Path, header: Sequence[str], faults: _Faults) -> Iterator[str]:
    if faults.is_cut:
        yield f"{path}: the last line is cut off and was left out; the recording did not end regularly"
    for bad, what in (
        (faults.uneven, f"do not have the {len(header)} cells of the header"),
        (faults.timeless, f"have no {TIME}"),
    ):
        if bad:
            yield loss_note(
                str(path), "rows", len(bad), faults.lines, f"{what} and were left out, the first in line {bad[0]}",
                f"correct them, beginning with line {bad[0]}",
            )  # fmt: skip


def _notes_on_cells(path: Path, lines: Sequence[int], columns: dict[str, Array], faults: _Faults) -> Iterator[str]:
    """Sentences on cells that hold no finite number, by signal."""
    for signal, names in SIGNALS.items():
        bad = sorted({line: (line, name, text) for name in names for line, text in faults.cells.get(name, ())}.values())
        if bad:
            line, name, text = bad[0]
            filled = np.isfinite(np.column_stack([columns[each] for each in names if each in columns])).any(axis=1)
            total = int(np.count_nonzero(filled | np.isin(lines, [each for each, _, _ in bad])))
            yield loss_note(
                str(path), signal, len(bad), total,
                f"have a cell that is not a number and were left out, the first in line {line}: {name} is {text!r}",
                "leave a cell without sample empty",
            )  # fmt: skip


def _in_order(path: Path, lines: Sequence[int], columns: dict[str, Array], notes: list[str]) -> Sheet:
    """Put rows in order of time, and make one row of those with one time."""
    t_s = columns.pop(TIME)
    backwards = np.flatnonzero(np.diff(t_s) < 0.0)
    if backwards.size:
        far = backwards[np.maximum.accumulate(t_s)[backwards] - t_s[backwards + 1] > LARGEST_DISORDER_S]
        if far.size:
            at = int(far[0])
            before_s, after_s = t_s[at : at + 2]
            raise LogError(
                f"{path}: line {lines[at + 1]}: the clock goes backwards (t_s {before_s:.15g}, then {after_s:.15g}); "
                "give each run as a file of its own"
            )
        notes.append(f"{path}: {backwards.size} rows came after a later one and were sorted by {TIME}")
    order = np.argsort(t_s, kind="stable")
    t_s, columns = t_s[order], {name: column[order] for name, column in columns.items()}
    segment = columns.pop(SEGMENT, np.zeros(t_s.size)).astype(np.int64)
    first = np.concatenate([[True], np.diff(t_s) > 0.0])
    if not first.all():
        columns = _merged(path, np.cumsum(first) - 1, columns, int(np.count_nonzero(~first)), notes)
        t_s, segment = t_s[first], segment[first]
    return Sheet(str(path), float(t_s[0]), t_s - t_s[0], segment, columns, tuple(notes))


def _merged(path: Path, place: Index, columns: dict[str, Array], several: int, notes: list[str]) -> dict[str, Array]:
    """One row for each time, from rows (N,) that belong to the times `place` (N,): the first value of each column."""
    found: dict[str, Array] = {}
    for name, column in columns.items():
        values = np.full(int(place[-1]) + 1, np.nan)
        given = np.flatnonzero(np.isfinite(column))[::-1]
        # Of several rows the first that has a value is written last.
        values[place[given]] = column[given]
        found[name] = values
    notes.append(f"{path}: {several} rows have the time of another and were joined with it")
    for signal, names in SIGNALS.items():
        there = [name for name in names if name in columns]
        if not there:
            continue
        before = np.column_stack([columns[name] for name in there])
        kept = np.column_stack([found[name] for name in there])[place]
        conflicts = int(np.count_nonzero((np.isfinite(before) & (before != kept)).any(axis=1)))
        total = int(np.count_nonzero(np.isfinite(before).any(axis=1)))
        if conflicts:
            notes.append(
                loss_note(
                    str(path), signal, conflicts, total, "samples have the time of another sample and were left out",
                    f"the clock does not advance; give each sample the {TIME} at which it was true",
                )
            )  # fmt: skip
    return found
