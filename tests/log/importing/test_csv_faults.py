"""CSV files with faults of the kinds that are met in the field: read as far as they are whole, each loss counted."""

import math
from operator import attrgetter

import numpy as np
import pytest

from disco_hw.log.importing.csv_drive import read_csv, write_csv
from tests.log.refusals import refused

COLUMNS = (
    "t_s", "cmd_left_rad_s", "cmd_right_rad_s", "enc_left_rad_s", "enc_right_rad_s", "pose_x_m", "pose_y_m",
    "pose_yaw_rad",
)  # fmt: skip
ROWS = 100


def table(count=ROWS, columns=COLUMNS):
    """Cells of a drive at 2 and 3 rad/s: one dict of texts for each 0.05 s."""
    rows = []
    for k in range(count):
        t_s = 0.05 * k
        yaw = 0.06 / 0.31 * t_s
        pose = (0.775 * math.sin(yaw), 0.775 * (1.0 - math.cos(yaw)), math.remainder(yaw, math.tau))
        values = (t_s, 2.0, 3.0, 2.0, 3.0, *pose)
        rows.append(dict(zip(COLUMNS, (f"{value:.6f}" for value in values), strict=True)))
    return [{name: row.get(name, "") for name in columns} for row in rows]


def as_text(rows, end="\n"):
    return end.join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]) + end


def read(tmp_path, content, **settings):
    path = tmp_path / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_csv(path, **settings)


def refusal(tmp_path, content, **settings):
    with refused() as error:
        read(tmp_path, content, **settings)
    return str(error.value)


def only_note(drive):
    (note,) = drive.notes
    return note


def sizes(drive):
    return drive.commands.t_s.size, drive.wheels.t_s.size, drive.poses.t_s.size


@pytest.mark.parametrize("cell", ["nan", "NaN", "NAN", " nan ", "N/A", "null", "None", "-", ""])
def test_a_word_for_no_sample_is_an_empty_cell(tmp_path, cell):
    rows = table()
    for row in rows[::2]:
        row["enc_left_rad_s"] = row["pose_yaw_rad"] = cell
    drive = read(tmp_path, as_text(rows))
    assert sizes(drive) == (100, 50, 100)
    assert np.isnan(drive.poses.yaw_rad[::2]).all()
    assert drive.notes == ()


@pytest.mark.parametrize("text", ["inf", "1e400", "x", "1;5", "0x10", "12:30"])
@pytest.mark.parametrize(
    ("column", "signal", "expected"),
    [
        ("enc_right_rad_s", "wheel speeds", (100, 97, 100)),
        ("pose_x_m", "positions", (100, 100, 97)),
        ("cmd_left_rad_s", "commands", (97, 100, 100)),
    ],
)
def test_a_cell_that_is_no_number_costs_its_sample_and_no_other(tmp_path, text, column, signal, expected):
    rows = table()
    for k in (20, 40, 60):
        rows[k][column] = text
    drive = read(tmp_path, as_text(rows))
    assert sizes(drive) == expected
    assert f"{signal}: 3 of 100 have a cell that is not a number" in only_note(drive)
    assert f"the first in line 22: {column} is '{text}' (3.0 %)" in only_note(drive)
    assert not only_note(drive).startswith("warning: ")


def with_lost_positions(count):
    rows = table()
    for row in rows[:count]:
        row["pose_y_m"] = "lost"
    return as_text(rows)


@pytest.mark.parametrize(("count", "warns"), [(5, False), (6, True), (50, True)])
def test_over_5_percent_of_a_signal_is_a_warning_and_over_half_an_error(tmp_path, count, warns):
    assert only_note(read(tmp_path, with_lost_positions(count))).startswith("warning: ") is warns
    assert "positions: 51 of 100 have a cell that is not a number" in refusal(tmp_path, with_lost_positions(51))


@pytest.mark.parametrize(
    ("changed", "signal"),
    [
        ({"pose_yaw_rad": "lost"}, "headings"),
        ({"pose_x_m": "lost", "pose_y_m": "lost", "pose_yaw_rad": ""}, "positions"),
    ],
)
def test_samples_of_which_no_cell_can_be_read_count_among_all(tmp_path, changed, signal):
    rows = [row | (changed if k % 100 < 36 else {}) for k, row in enumerate(table(200))]
    for row in rows[100:150]:
        row.update(dict.fromkeys(changed, ""))
    assert f"{signal}: 36 of 150 have a cell that is not a number" in only_note(read(tmp_path, as_text(rows)))


def test_rows_of_another_width_or_without_a_time_are_left_out(tmp_path):
    lines = as_text(table()).splitlines()
    lines[10] += ",7"
    lines[20] = "1.0,2.0"
    drive = read(tmp_path, "\n".join(lines) + "\n")
    assert sizes(drive) == (98, 98, 98)
    assert "2 of 100 do not have the 8 cells of the header and were left out, the first in line 11" in only_note(drive)
    rows = table()
    rows[30]["t_s"], rows[31]["t_s"] = "", "x"
    drive = read(tmp_path, as_text(rows))
    assert drive.wheels.t_s.size == 98
    assert "rows: 2 of 100 have no t_s" in only_note(drive)


@pytest.mark.parametrize("left", [1, 10, 30])
def test_a_last_line_that_is_cut_is_left_out(tmp_path, left):
    content = as_text(table())
    begin = content.rstrip("\n").rfind("\n") + 1
    drive = read(tmp_path, content[: begin + left])
    assert sizes(drive) == (99, 99, 99)
    assert "the last line is cut off and was left out" in only_note(drive)


NOTED = (*COLUMNS, "note")


def with_notes(notes):
    rows = table(columns=NOTED)
    for k, note in notes.items():
        rows[k]["note"] = note
    return as_text(rows)


@pytest.mark.parametrize("notes", [{10: 'wheel of 5" "'}, {10: '"bump"', 99: '"bump, again"'}])
def test_quotes_within_a_line_are_read(tmp_path, notes):
    assert sizes(read(tmp_path, with_notes(notes))) == (100, 100, 100)


@pytest.mark.parametrize(
    ("notes", "fault"),
    [
        ({10: '"late start'}, "a cell goes on beyond the end of the line"),
        ({10: '"bump', 50: '"bump'}, "a cell goes on beyond the end of the line"),
        ({10: '"bump', 50: 'bump"'}, "a cell goes on beyond the end of the line"),
        ({10: '"two\nlines"'}, "a cell goes on beyond the end of the line"),
        ({10: '"bump', **dict.fromkeys((50, 51, 52), "x" * 60000)}, "a cell goes on beyond the end of the line"),
        ({10: '"bump" again'}, "',' expected after '\"'"),
    ],
    ids=["open", "closed 40 rows later", "quotes 40 rows", "a text of two lines", "131072 letters", "text behind"],
)
def test_a_quote_that_would_swallow_rows_is_refused_with_its_line(tmp_path, notes, fault):
    message = refusal(tmp_path, with_notes(notes))
    assert f"log.csv: line 12: {fault}" in message
    assert "write each row in one line, and quotes only around whole cells" in message


def test_a_last_line_that_is_cut_within_a_quote_is_left_out(tmp_path):
    drive = read(tmp_path, with_notes({99: '"late start'}).rstrip("\n"))
    assert sizes(drive) == (99, 99, 99)
    assert any("the last line is cut off and was left out" in note for note in drive.notes)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("cut", [False, True])
def test_line_ends_of_windows_and_a_byte_order_mark_make_no_difference(tmp_path, mark, end, cut):
    content = mark + as_text(table(), end).encode()
    drive = read(tmp_path, content[:-20] if cut else content)
    assert sizes(drive) == ((99, 99, 99) if cut else (100, 100, 100))
    assert len(drive.notes) == cut


def test_empty_rows_and_columns_of_a_spreadsheet_make_no_difference(tmp_path):
    lines = as_text(table()).splitlines()
    with_empty = [f"{line},," for line in lines] + [",,,,,,,,,"] * 20
    assert sizes(read(tmp_path, "\n".join(with_empty) + "\n")) == (100, 100, 100)
    assert only_note(read_csv(tmp_path / "log.csv")).endswith("ignored columns: one without a name")


def test_of_columns_that_are_not_read_there_may_be_several(tmp_path):
    lines = [f"{line},{'note,note' if k == 0 else '7,8'}" for k, line in enumerate(as_text(table()).splitlines())]
    assert only_note(read(tmp_path, "\n".join(lines) + "\n")).endswith("ignored columns: note")


@pytest.mark.parametrize("separator", [";", "\t", "|", "; "])
def test_another_separator_is_named(tmp_path, separator):
    content = as_text(table()).replace(",", separator).replace(".", ",")
    message = refusal(tmp_path, content)
    assert f"columns are separated by {separator.strip(' ')!r}; separate them by commas, with decimal points" in message


def test_rows_in_slight_disorder_are_sorted(tmp_path):
    rows = table()
    rows[40], rows[45] = rows[45], rows[40]
    drive, straight = read(tmp_path, as_text(rows)), read(tmp_path, as_text(table()))
    np.testing.assert_array_equal(drive.wheels.t_s, straight.wheels.t_s)
    np.testing.assert_array_equal(drive.poses.x_m, straight.poses.x_m)
    assert "rows came after a later one and were sorted by t_s" in only_note(drive)


def split(rows, *parts):
    """Each row as several rows of one time, each with some of the columns."""
    return [
        {name: cell if name in ("t_s", *part) else "" for name, cell in row.items()} for row in rows for part in parts
    ]


MERGES = {
    "wheels and poses": (COLUMNS[1:5], COLUMNS[5:]),
    "each signal": (COLUMNS[1:3], COLUMNS[3:5], COLUMNS[5:]),
    "each column": tuple((name,) for name in COLUMNS[1:]),
    "the other order": (COLUMNS[5:], COLUMNS[1:5]),
}


@pytest.mark.parametrize("parts", MERGES.values(), ids=MERGES)
def test_rows_of_one_time_with_other_columns_are_one_row(tmp_path, parts):
    drive, reference = read(tmp_path, as_text(split(table(), *parts))), read(tmp_path, as_text(table()))
    for name in ("commands.left_rad_s", "wheels.left_angle_rad", "poses.yaw_rad", "poses.t_s"):
        np.testing.assert_array_equal(attrgetter(name)(drive), attrgetter(name)(reference))
    assert f"{(len(parts) - 1) * ROWS} rows have the time of another and were joined with it" in only_note(drive)


@pytest.mark.parametrize("each_with_the_command", [False, True])
def test_signals_in_rows_of_their_own_are_read(tmp_path, each_with_the_command):
    rows = split(table(), *MERGES["each signal"])
    for k, row in enumerate(rows):
        row["t_s"] = f"{float(row['t_s']) + 3e-5 * (k % 3):.6f}"
        if each_with_the_command:
            row.update(cmd_left_rad_s="2.0", cmd_right_rad_s="3.0")
    drive = read(tmp_path, as_text(rows))
    assert sizes(drive)[1:] == (100, 100)
    assert np.count_nonzero(np.isfinite(drive.commands.left_rad_s)) == (300 if each_with_the_command else 100)


def with_commands(every, count=ROWS):
    rows = table(count)
    for k, row in enumerate(rows):
        if k % every:
            row["cmd_left_rad_s"] = row["cmd_right_rad_s"] = ""
    return as_text(rows)


def known_commands(drive, t_s):
    return np.isfinite(drive.commands.left_rad_s[np.searchsorted(drive.commands.t_s, t_s, side="right") - 1])


def test_commands_that_are_written_on_change_count_for_half_a_second(tmp_path):
    drive = read(tmp_path, with_commands(20))
    assert drive.commands.t_s.tolist() == pytest.approx(np.arange(10) * 0.5)
    assert np.isfinite(drive.commands.left_rad_s).tolist() == [True, False] * 5
    assert only_note(drive).startswith("warning: ")
    assert "none is known for 2.5 of 5.0 s (49 %)" in only_note(drive)
    assert "write the one in force into every row" in only_note(drive)


def test_a_joysticks_ramp_that_is_written_on_change_does_not_lose_the_command_without_a_word(tmp_path):
    """Few commands, each other than the one before, and the last of each ramp held for 2 s."""
    header = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s"
    speeds = [min(k % 100, 10) + k // 100 for k in range(400)]
    cells = [f"{v},{v}" if v != before else "," for v, before in zip(speeds, [None, *speeds], strict=False)]
    lines = [f"{0.02 * k:.2f},{cell},{v},{v}" for k, (v, cell) in enumerate(zip(speeds, cells, strict=True))]
    drive = read(tmp_path, "\n".join([header, *lines]))
    (note,) = drive.notes
    assert note.startswith("warning: ")
    assert "commands: none is known for 7.1 of 8.0 s in which the wheels turn" in note
    # A robot that stands while nothing is commanded has lost nothing.
    lines = [f"{0.02 * k:.2f},{'2,2,2,2' if k < 100 else ',,0,0'}" for k in range(400)]
    assert read(tmp_path, "\n".join([header, *lines])).notes == ()


def test_commands_on_change_are_known_throughout_if_they_change_often(tmp_path):
    drive = read(tmp_path, with_commands(10))
    assert drive.commands.t_s.tolist() == pytest.approx(np.arange(10) * 0.5)
    assert drive.notes == ()


@pytest.mark.parametrize("every", [1, 10, 20, 60])
def test_an_export_has_the_same_commands_at_every_time(tmp_path, every):
    drive = read(tmp_path, with_commands(every, 200))
    write_csv(drive, tmp_path / "export.csv", None)
    back = read_csv(tmp_path / "export.csv")
    between_s = drive.wheels.t_s + 0.025
    np.testing.assert_array_equal(known_commands(back, between_s), known_commands(drive, between_s))


@pytest.mark.parametrize("period_s", [1.0, 1.25, 2.0])
def test_positions_of_a_slow_receiver_are_in_seconds_where_they_are_all_that_was_measured(tmp_path, period_s):
    rows = ["t_s,cmd_left_rad_s,cmd_right_rad_s,pose_x_m,pose_y_m"]
    for k in range(400):
        is_fix = k % round(20 * period_s) == 0
        # Half a millisecond of jitter, in turn ahead and behind.
        rows.append(f"{0.05 * k + 5e-4 * (k % 3)},2,3,{f'{0.01 * k},0' if is_fix else ','}")
    path = tmp_path / "gps.csv"
    path.write_text("\n".join(rows))
    assert read_csv(path).poses.t_s.size == len(range(0, 400, round(20 * period_s)))


@pytest.mark.parametrize("period_ms", [2, 50])
def test_milliseconds_are_refused(tmp_path, period_ms):
    rows = [row | {"t_s": str(period_ms * k)} for k, row in enumerate(table())]
    message = f"t_s: {period_ms} from sample to sample, which does not look like seconds; write seconds"
    assert message in refusal(tmp_path, as_text(rows))


def test_a_row_that_is_there_twice_costs_nothing(tmp_path):
    rows = table()
    drive = read(tmp_path, as_text([row for row in rows for _ in range(2)]))
    assert sizes(drive) == (100, 100, 100)
    assert "100 rows have the time of another" in only_note(drive)


def test_rows_of_one_time_that_contradict_each_other_are_counted_by_signal(tmp_path):
    def contradicting(count):
        rows = table()
        return as_text([*rows[:50], *(row | {"t_s": rows[49]["t_s"]} for row in rows[50 : 50 + count]), *rows[90:]])

    drive = read(tmp_path, contradicting(10))
    assert sizes(drive) == (60, 60, 60)
    # The speeds are the same in all rows: nothing of these is lost.
    assert drive.notes[0].startswith("warning: ")
    assert "positions: 10 of 70 samples have the time of another sample and were left out (14 %)" in drive.notes[0]
    assert not any("wheel speeds" in note for note in drive.notes)
    standing = [row | {"t_s": f"{0.05 * (k // 4):.2f}"} for k, row in enumerate(table())]
    assert "the clock does not advance" in refusal(tmp_path, as_text(standing))


def test_positions_without_a_yaw_column_are_read(tmp_path):
    drive = read(tmp_path, as_text(table(columns=COLUMNS[:-1])))
    assert drive.poses.x_m.size == 100
    assert np.isnan(drive.poses.yaw_rad).all()


TICKS = (*COLUMNS[:3], "enc_left_ticks", "enc_right_ticks", *COLUMNS[5:])
TICKS_PER_REV = 2048


def with_ticks(left=lambda ticks: ticks, right=lambda ticks: ticks, count=400, columns=TICKS):
    """The drive with counts of an encoder of 2048 ticks, as `left` and `right` change them."""
    rows = table(count, columns)
    for k, row in enumerate(rows):
        row["enc_left_ticks"] = str(left(round(2.0 * 0.05 * k * TICKS_PER_REV / (2.0 * math.pi))))
        row["enc_right_ticks"] = str(right(round(3.0 * 0.05 * k * TICKS_PER_REV / (2.0 * math.pi))))
    return rows


def read_ticks(tmp_path, rows):
    return read(tmp_path, as_text(rows), ticks_per_rev=TICKS_PER_REV)


@pytest.mark.parametrize("span", [256, 1024, 2048, 3000, 4096])
@pytest.mark.parametrize("both", [True, False])
def test_ticks_that_wrap_are_made_continuous_wheel_by_wheel(tmp_path, span, both):
    reference = read_ticks(tmp_path, with_ticks())
    wrapped = with_ticks(lambda ticks: ticks % span, (lambda ticks: ticks % span) if both else (lambda ticks: ticks))
    drive = read_ticks(tmp_path, wrapped)
    np.testing.assert_allclose(drive.wheels.left_angle_rad, reference.wheels.left_angle_rad, atol=1e-9)
    np.testing.assert_allclose(drive.wheels.right_angle_rad, reference.wheels.right_angle_rad, atol=1e-9)
    assert drive.segments == 1
    assert len(drive.notes) == 1 + both
    assert f"enc_left_ticks wraps at {span} counts: made continuous at" in drive.notes[0]


@pytest.mark.parametrize(("begin_s", "reset_s"), [(1000, "1007.7"), (1_700_000_000, "1700000007.7")])
def test_a_reset_is_reported_with_the_time_of_the_file(tmp_path, begin_s, reset_s):
    rows = with_ticks(lambda ticks: ticks if ticks < 5000 else ticks - 5000)
    later = [row | {"t_s": f"{begin_s + float(row['t_s']):.6f}"} for row in rows]
    assert f"an encoder was reset 1 times, first at t_s {reset_s}; new" in only_note(read_ticks(tmp_path, later))
    back = as_text([*later, later[0]])
    assert f"(t_s {begin_s + 19.95:.15g}, then {begin_s}); give each run" in refusal(tmp_path, back)
    jumping = [row | {"enc_left_ticks": str((k * 7919) % 1_000_003)} for k, row in enumerate(later)]
    message = refusal(tmp_path, as_text(jumping), ticks_per_rev=200)
    assert f"first at t_s {begin_s}.05, further than a wheel turns" in message


def test_an_encoder_that_is_set_anew_begins_a_new_segment(tmp_path):
    drive = read_ticks(tmp_path, with_ticks(lambda ticks: ticks if ticks < 5000 else ticks - 5000))
    assert drive.segments == 2
    assert "an encoder was reset 1 times, first at t_s 7.7; new segments begin there" in only_note(drive)
    assert np.abs(drive.wheels.left_speed_rad_s).max() < 2.1
    assert drive.poses.segment[-1] == drive.commands.segment[-1] == 1


def test_speeds_that_are_rare_beside_ticks_do_not_thin_them_out(tmp_path):
    rows = with_ticks(columns=(*TICKS, "enc_left_rad_s", "enc_right_rad_s"))
    for row in rows[1::2] + rows[::4]:
        row["enc_left_rad_s"] = row["enc_right_rad_s"] = ""
    drive = read_ticks(tmp_path, rows)
    assert drive.wheels.t_s.size == 400
    assert drive.wheels.angle_measured
    assert not drive.wheels.speed_measured
    assert "400 of 400 speeds were taken from the ticks" in only_note(drive)
