import typing

import msgspec
import pytest

from disco_hw.log.records import TOPIC_BY_NAME, TOPIC_INDEX, TOPICS, Command, topic_of
from drivers.types import WheelSample


def test_every_topic_has_a_name_and_a_type_of_its_own():
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)
    assert len({topic.record for topic in TOPICS}) == len(TOPICS)
    assert all(TOPICS[TOPIC_INDEX[topic.record]] is topic for topic in TOPICS)
    assert all(TOPIC_BY_NAME[topic.name] is topic for topic in TOPICS)


def test_the_topic_of_a_type():
    assert topic_of(WheelSample) == "/wheels"
    with pytest.raises(KeyError):
        topic_of(int)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_record_is_frozen_and_starts_with_its_time(topic):
    hints = typing.get_type_hints(topic.record)
    assert next(iter(hints)) == "t_ns"
    assert hints["t_ns"] is int
    assert topic.record.__struct_config__.frozen


def test_a_record_of_an_older_version_still_reads():
    old = b'{"t_ns":1,"requested_left_rad_s":1.0,"requested_right_rad_s":1.0,"left_rad_s":1.0,"right_rad_s":1.0,"valid_for_s":0.1,"in_force":true,"gone":3}'  # noqa: E501
    assert msgspec.json.decode(old, type=Command).plan_age_ns == -1
