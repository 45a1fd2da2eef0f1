import pytest

from tools.bench.loop import run


@pytest.mark.thorough
def test_every_figure_is_there_for_both_ways_of_running():
    figures = run(seconds=0.3)
    for mode in ("plain", "realtime"):
        assert figures[f"loop.{mode}.ticks"] + figures[f"loop.{mode}.skipped_periods"] >= 14
        assert figures[f"loop.{mode}.lateness_p99_us"] <= figures[f"loop.{mode}.lateness_max_us"]
        assert figures[f"loop.{mode}.supervisor_p50_us"] > 0.0
    assert figures["loop.plain.allowed"] == 1.0
