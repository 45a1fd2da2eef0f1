"""docs/log.md lists every topic of a log with its type."""

import re
from pathlib import Path

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from disco_hw.log.mcap_log import SCENE, VIEWS
from disco_hw.log.records import TOPICS


def test_every_topic_is_listed_with_its_type():
    text = (Path(__file__).parents[2] / "docs" / "log.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `(/\S+)` \| (\S+) \| \S", text, re.MULTILINE)
    ours = {(topic.name, topic.record.__name__) for topic in TOPICS}
    views = {(name, message.DESCRIPTOR.full_name) for name, message in (*VIEWS, (SCENE, SceneUpdate))}
    assert len(listed) == len(set(listed))
    assert set(listed) == ours | views
