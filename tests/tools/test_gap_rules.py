"""Rules of the search for missing effects, switched off one at a time and counted."""

from dataclasses import replace

import pytest

from disco_hw.gap.report import judge
from disco_hw.gap.search import channel_result
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.selection import Selector, body_moves
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import LIMITS, body_channel
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
