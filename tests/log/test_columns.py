import math

import numpy as np
import pytest

from disco_hw.log.reader import to_columns
from disco_hw.log.records import Command, Estimate, Event, FrameIn, LoopTiming, Plan
from drivers.types import WheelSample
from tools.log_samples import bits


def test_numbers_keep_their_type_and_their_bits():
    samples = [WheelSample(2**62 + 1, 2, -0.0, math.nan, 5e-324, 1.0), WheelSample(3, 4, 0.1, 0.2, 0.3, 0.4)]
    columns = to_columns(WheelSample, [7, 8], samples)
    assert columns["t_ns"].dtype == np.int64
    assert columns["t_ns"].tolist() == [2**62 + 1, 3]
    assert bits(columns["left_angle_rad"].tolist()) == bits([-0.0, 0.1])
    assert columns["now_ns"].tolist() == [7, 8]


def test_bytes_and_texts_are_objects():
    assert to_columns(FrameIn, [1], [FrameIn(1, 2, b"\x00\x00")])["data"].tolist() == [b"\x00\x00"]
    assert to_columns(Event, [1], [Event(1, "info", "a", "b")])["level"].tolist() == ["info"]


def test_tuples_of_one_length_are_a_table_and_of_several_are_not():
    plans = [Plan(1, 1, 0.1, (1.0, 2.0), (3.0, 4.0)), Plan(2, 2, 0.1, (5.0, 6.0), (7.0,))]
    columns = to_columns(Plan, [1, 2], plans)
    assert columns["left_rad_s"].tolist() == [[1.0, 2.0], [5.0, 6.0]]
    assert [row.tolist() for row in columns["right_rad_s"]] == [[3.0, 4.0], [7.0]]
    assert columns["path_x_m"].shape == (2, 0)


def test_tuples_of_text_stay_tuples_even_when_all_have_one_entry():
    commands = [Command(1, 0.0, 0.0, 0.0, 0.0, 0.1, True, limits=(name,)) for name in ("speed", "acceleration")]
    assert to_columns(Command, [1, 2], commands)["limits"].tolist() == [("speed",), ("acceleration",)]


def test_a_mapping_is_a_column_a_key():
    timings = [LoopTiming(1, 1, 1, 0, {"plan": 5}), LoopTiming(2, 2, 2, 0, {"plan": 6, "send": 7})]
    columns = to_columns(LoopTiming, [1, 2], timings)
    assert columns["stages_ns.plan"].tolist() == [5, 6]
    assert columns["stages_ns.plan"].dtype == np.int64
    assert bits(columns["stages_ns.send"].tolist()) == bits([math.nan, 7.0])
    assert "stages_ns" not in columns


@pytest.mark.parametrize("record_type", [Estimate, WheelSample, Plan])
def test_no_records_are_columns_of_length_zero(record_type):
    columns = to_columns(record_type, [], [])
    assert columns["t_ns"].size == 0
    assert all(column.shape[0] == 0 for column in columns.values())
