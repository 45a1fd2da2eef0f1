from tools.bench.estimation import run


def test_every_figure_is_there_and_a_rewind_costs_more_than_a_tick():
    figures = run(ticks=1000)
    for name in ("tick_us", "tick_with_pose_us"):
        assert 0.0 < figures[f"estimation.{name}.p50"] <= figures[f"estimation.{name}.p99"]
        assert figures[f"estimation.{name}.p99"] <= figures[f"estimation.{name}.p99.9"]
    assert figures["estimation.tick_us.p50"] < figures["estimation.rewind_950ms_us.p50"]
