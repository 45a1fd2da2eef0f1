"""The file as others see it: read with the plain mcap library and its protobuf decoder."""

import io
import json
import math

import msgspec
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from disco_hw.log import TaskScene, batch_encoder
from disco_hw.log.log_command import recover_log
from disco_hw.log.mcap_log import CHUNK_BYTES, FORMAT, METADATA, SCENE, McapLog, Metadata, from_text
from disco_hw.log.reader import open_log
from disco_hw.log.records import TOPIC_INDEX, TOPICS, Event, FrameIn
from tools.log_samples import ATTACHMENTS, PERIOD_NS, WALL_OFFSET_NS, drive_ticks, log_bytes, start, tick

ENCODE = batch_encoder()


def foreign(data):
    return make_reader(io.BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])


@pytest.fixture(scope="module")
def driven():
    return log_bytes(drive_ticks(200))


def test_another_reader_finds_index_statistics_and_every_message(driven):
    reader = foreign(driven)
    summary = reader.get_summary()
    messages = list(reader.iter_messages())
    assert summary.statistics.message_count == len(messages)
    counts = {
        channel.topic: summary.statistics.channel_message_counts.get(id_, 0)
        for id_, channel in summary.channels.items()
    }
    assert counts["/wheels"] == counts["/estimate"] == counts["/view/estimate"] == counts["/view/transform"] == 200
    assert counts["/pose"] == counts["/view/measured_pose"] == 40
    assert counts["/event"] == counts["/view/log"] == 4
    assert set(counts) >= {topic.name for topic in TOPICS}


def test_the_scene_is_there_once_with_the_first_tick_and_disturbs_no_count(driven, tmp_path):
    seen = TaskScene(((0.0, 0.0), (3.0, 1.0)), 0.4, 0.1)
    (tmp_path / "log.mcap").write_bytes(log_bytes(drive_ticks(200), scene=seen))
    (tmp_path / "plain.mcap").write_bytes(driven)
    with open_log(tmp_path / "log.mcap") as log, open_log(tmp_path / "plain.mcap") as plain:
        assert log.summary().topics == plain.summary().topics
        assert (log.summary().ticks, log.summary().missing_ticks, log.gaps()) == (200, 0, ())
    recover_log(tmp_path / "log.mcap", tmp_path / "mended.mcap")
    for name in ("log.mcap", "mended.mcap"):
        (found,) = foreign((tmp_path / name).read_bytes()).iter_decoded_messages(topics=[SCENE])
        assert (found.message.sequence, found.message.log_time) == (1, PERIOD_NS + WALL_OFFSET_NS)
        task, robot = found.decoded_message.entities
        assert [(point.x, point.y) for point in task.lines[0].points] == [(0.0, 0.0), (3.0, 1.0)]
        assert (robot.frame_id, robot.frame_locked, task.frame_id) == ("robot", True, "world")
    assert SCENE not in {channel.topic for channel in foreign(driven).get_summary().channels.values()}


def test_another_reader_decodes_our_json_and_foxgloves_protobuf(driven):
    reader = foreign(driven)
    views = 0
    for schema, channel, message in reader.iter_messages():
        if channel.message_encoding == "json":
            assert schema.encoding == "jsonschema"
            plain = json.loads(message.data)
            assert set(plain) <= set(json.loads(schema.data)["properties"])
    for decoded in foreign(driven).iter_decoded_messages(topics=["/view/estimate", "/view/log", "/view/plan"]):
        assert decoded.schema.encoding == "protobuf"
        assert decoded.schema.name.startswith("foxglove.")
        if decoded.channel.topic == "/view/estimate":
            k = decoded.message.sequence
            assert decoded.decoded_message.pose.position.x == 0.002 * k
            assert 2.0 * math.asin(decoded.decoded_message.pose.orientation.z) == pytest.approx(0.01 * k)
        views += 1
    assert views == 200 + 200 + 4


def test_times_are_wall_times_that_never_decrease_and_sequences_count_ticks(driven):
    last = 0
    for _, channel, message in foreign(driven).iter_messages(log_time_order=False):
        assert message.log_time == message.sequence * PERIOD_NS + WALL_OFFSET_NS
        assert message.log_time >= last
        last = message.log_time
        if channel.message_encoding == "json":
            assert message.publish_time == json.loads(message.data)["t_ns"] + WALL_OFFSET_NS


def test_metadata_and_attachments_are_there(driven):
    reader = foreign(driven)
    (metadata,) = reader.iter_metadata()
    assert metadata.name == METADATA
    assert from_text(metadata.metadata, Metadata) == Metadata(
        format=FORMAT, robot="wombot", version="1.2.3", part=1, start_ns=5, wall_offset_ns=WALL_OFFSET_NS
    )
    assert [(kept.name, kept.data) for kept in reader.iter_attachments()] == [(a.name, a.data) for a in ATTACHMENTS]


def test_one_schema_for_each_type_and_no_more(driven):
    names = [schema.name for schema in foreign(driven).get_summary().schemas.values()]
    assert len(names) == len(set(names))
    assert "foxglove.PoseInFrame" in names


def test_a_tick_is_never_split_between_chunks():
    data = log_bytes(drive_ticks(600))
    chunks = foreign(data).get_summary().chunk_indexes
    assert len(chunks) > 5
    # The first chunk has the schemas as well.
    schemas = sum(len(schema.data) for schema in foreign(data).get_summary().schemas.values())
    assert max(chunk.uncompressed_size for chunk in chunks) < CHUNK_BYTES + schemas + 5_000
    starts = [chunk.message_start_time for chunk in chunks]
    ends = [chunk.message_end_time for chunk in chunks]
    assert all(end < following for end, following in zip(ends, starts[1:], strict=False))


def test_what_is_no_record_is_refused_and_the_rest_is_kept():
    sink = io.BytesIO()
    log = McapLog(sink, start())
    event = Event(1, "info", "a", "b")
    broken = {"t_ns": 1, "level": "loud", "code": "a", "text": "b"}
    index = TOPIC_INDEX[Event]
    log.write(b"\x81 no batch")
    log.write(msgspec.msgpack.encode((1, 10, [(index, broken), (99, event), (index, event)])))
    log.write(ENCODE(2, -(2**63), [event]))
    log.write(ENCODE(3, 20, [event]))
    assert (log.records, log.refused) == (2, 4)
    assert "impossible time" in log.last_refusal
    log.finish()
    reader = foreign(sink.getvalue())
    assert [message.sequence for _, channel, message in reader.iter_messages() if channel.topic == "/event"] == [1, 3]


def test_a_record_with_an_impossible_time_of_its_own_is_kept():
    data = log_bytes([(1, [FrameIn(-(2**63), 1, b""), FrameIn(2**64 - 1, 1, b""), Event(-(2**63), "info", "a", "b")])])
    times = [
        message.publish_time for _, channel, message in foreign(data).iter_messages() if channel.topic == "/can/rx"
    ]
    assert times == [0, 2**64 - 1]


class FullSink(io.BytesIO):
    def write(self, data):
        if self.tell() + len(data) > 40_000:
            raise OSError(28, "No space left on device")
        return super().write(data)


def test_a_sink_that_fails_is_not_hidden():
    log = McapLog(FullSink(), start())

    def fill():
        for k in range(2000):
            log.write(ENCODE(k, k, tick(k)))

    with pytest.raises(OSError, match="No space"):
        fill()
