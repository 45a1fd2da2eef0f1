"""Arbitrary records of all topics."""

import typing

from hypothesis import strategies as st

from disco_hw.log.records import TOPICS

_STRATEGIES = {
    int: st.integers(0, 2**62),
    float: st.floats(),
    bool: st.booleans(),
    str: st.text(max_size=20) | st.sampled_from(["NaN", "Infinity", "-Infinity", "null", ""]),
    bytes: st.binary(max_size=8),
    tuple[float, ...]: st.lists(st.floats(), max_size=12).map(tuple),
    tuple[str, ...]: st.lists(st.text(max_size=8), max_size=3).map(tuple),
    dict[str, float]: st.dictionaries(st.text(max_size=8), st.floats(), max_size=4),
    dict[str, int]: st.dictionaries(st.text(max_size=8), st.integers(-(2**62), 2**62), max_size=4),
}


def _of(annotation):
    if typing.get_origin(annotation) is typing.Literal:
        return st.sampled_from(typing.get_args(annotation))
    return _STRATEGIES[annotation]


def of_type(record_type):
    """Any record of one type: all floats there are, NaN, infinities, -0.0 and subnormals among them."""
    return st.builds(record_type, **{name: _of(hint) for name, hint in typing.get_type_hints(record_type).items()})


ANY_RECORD = st.one_of([of_type(topic.record) for topic in TOPICS])
