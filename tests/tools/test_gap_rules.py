"""Rules of the search for missing effects, switched off one at a time and counted."""

from dataclasses import replace

import pytest

from disco_hw.gap.report import judge
from disco_hw.gap.search import channel_result
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.selection import Selector, body_moves
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import LIMITS, body_channel
from tools.gap.ablation import rule_table
from tools.gap.rules import RULES, counting, without


def test_each_rule_is_there_and_is_put_back():
    before = [getattr(rule.owner, rule.attribute) for rule in RULES]
    with counting() as counts:
        assert set(counts) == {rule.name for rule in RULES}
        assert channel_result._reported_fit is not before[[rule.attribute for rule in RULES].index("_reported_fit")]
    assert [getattr(rule.owner, rule.attribute) for rule in RULES] == before
    assert len({rule.name for rule in RULES}) == len(RULES)


def test_a_rule_counts_where_its_answer_is_another_and_is_silent_without():
    channel, _ = body_channel(turn_slip=0.08)
    parameter, wide = judge.REGISTRY["motor_lag"].parameters[0], ParameterEstimate(0.2, 0.0, 0.4)
    with counting() as counts:
        assert judge.is_weakly_known(parameter, wide, DEFAULT_SETTINGS.report)
        assert not judge.is_weakly_known(parameter, replace(wide, low=0.19, high=0.21), DEFAULT_SETTINGS.report)
        assert Selector(channel, body_moves(channel), LIMITS).select() == ("turn_slip",)
    assert counts["a value that is hardly known"] == [2, 1]
    assert counts["an effect moves predictions"][0] > 0
    assert counts["an effect moves predictions"][1] == 0
    with without("a value that is hardly known"):
        assert not judge.is_weakly_known(parameter, wide, DEFAULT_SETTINGS.report)
    with pytest.raises(KeyError), without("no such rule"):
        pass


def test_the_table_has_each_rule_and_compares_where_it_decides():
    name = RULES[0].name
    usual = {
        "kind": "single", "hidden": ["motor_lag"], "seed": 31, "named": ["motor_lag"], "unnamed": [], "residue": 0,
        "blind": [], "refitted_mm": 20.0, "amended_mm": 5.0, "floor_mm": 4.0, "errors": [], "covered": [], "cpu_s": 1.0,
        "timed_mm": 10.0,
    }  # fmt: skip
    never, once = ({rule.name: [3, int(decides and rule.name == name)] for rule in RULES} for decides in (False, True))
    other = {**usual, "named": [], "amended_mm": 10.0}
    lines = [*rule_table({"a": ({"usual": usual}, never), "b": ({"usual": usual, name: other}, once)})]
    assert len(lines) == 2 + len(RULES)
    assert lines[2] == f"| {name} | 1 of 2 | 0 | 1 | 1.000 | 0.500 | 1 |"
    assert lines[3] == f"| {RULES[1].name} | 0 of 2 | | | | | |"
