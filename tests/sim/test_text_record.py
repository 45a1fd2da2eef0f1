"""Recording goes on as long as it can, and says when it no longer can."""

from pathlib import Path

import pytest

from sim.text_record import TextRecord


def test_lines_are_there_after_flush_and_close(tmp_path):
    told = []
    record = TextRecord(tmp_path / "record", told.append)
    record.line("one")
    record.flush()
    assert (tmp_path / "record").read_text() == "one\n"
    record.line("two")
    record.close()
    record.close()
    assert (tmp_path / "record").read_text() == "one\ntwo\n"
    assert (told, record.error) == ([], None)


@pytest.mark.parametrize("end", ["flush", "close"])
def test_a_full_disk_is_told_once_and_nothing_raises(end):
    told = []
    record = TextRecord(Path("/dev/full"), told.append)
    record.line("one")
    getattr(record, end)()
    record.line("two" * 100_000)
    record.flush()
    record.close()
    assert told == ["/dev/full: No space left on device; nothing more is recorded in it"]
    assert record.error == told[0]


def test_an_impossible_path_raises(tmp_path):
    with pytest.raises(FileNotFoundError):
        TextRecord(tmp_path / "missing" / "record", print)
