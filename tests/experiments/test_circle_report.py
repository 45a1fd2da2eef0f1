"""The report of a circle, from a log that its recorder could not end."""

from __future__ import annotations

import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments.circle_report import load_circle_report
from disco_hw.tasks.circle import CircleTask
from tools.log_samples import drive_ticks, write_log


def test_a_log_that_is_continued_by_another_file_is_not_taken_for_the_whole_drive(tmp_path):
    log = tmp_path / "demo.mcap"
    write_log(log, drive_ticks(50))
    with pytest.raises(WorkError, match=r"demo\.mcap: ends before the drive did, .* drive again"):
        load_circle_report(log, tmp_path / "truth.csv", CircleTask(), 0.5, stopped=True)
