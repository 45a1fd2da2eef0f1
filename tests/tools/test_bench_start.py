import pytest

from tools.bench.start import CASES, run


@pytest.mark.long
def test_every_case_has_its_seconds_and_its_ratio():
    figures = run(runs=1)
    assert len(figures) == 1 + 2 * len(CASES)
    assert all(value > 0.0 for value in figures.values())
    assert figures["start.import_run.cpu_s"] > figures["start.run_no_robot.cpu_s"]
