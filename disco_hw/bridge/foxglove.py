"""`disco-hw view --live --foxglove`: what the daemon records, live to Foxglove, from the feed of the page.

The topics are those of a log, with the same schemas and clock, so that one layout serves both.
"""

from __future__ import annotations

import json
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import foxglove
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap_protobuf.schema import build_file_descriptor_set

from disco_hw.config import RobotConfig, load_robot_config
from disco_hw.daemon import socket_path
from disco_hw.daemon.page_feed import FeedSubscriber, feed_path
from disco_hw.daemon.process import StopSignals
from disco_hw.errors import InputError
from disco_hw.log.encoding import encode_json, json_schema
from disco_hw.log.mcap_log import SCENE, VIEWS, scene_message, views
from disco_hw.log.records import TOPICS, FrameIn, FrameOut, Record, topic_of
from disco_hw.runtime.robot_setup import scene_of

# The usual port of Foxglove's WebSocket.
DEFAULT_PORT = 8765
LAYOUT = Path(__file__).with_name("foxglove_layout.json")
# Chosen: who connects sees the scene within it.
_SCENE_S = 1.0
# Chosen: how late an end is noticed.
_WAIT_S = 0.1


def serve_foxglove(robot: Path, host: str, port: int, as_json: bool = False) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code. The daemon may come and go.

    Raises InputError for a bad file, and for a host or port that cannot be listened to.
    """
    config = load_robot_config(robot)
    with StopSignals() as signals, closing(Live(config, host, port)) as live:
        where = {"foxglove": live.url, "layout": str(LAYOUT)}
        print(json.dumps(where) if as_json else f"foxglove: {live.url}, layout {LAYOUT}", flush=True)
        while signals.received is None:
            live.step()
    return 0


class Live:
    """A Foxglove server fed like the page."""

    def __init__(self, config: RobotConfig, host: str, port: int) -> None:
        self._scene = scene_message(scene_of(config))
        self._feed = FeedSubscriber(feed_path(socket_path(config)))
        self._next_scene_s = 0.0
        # Its channels are closed when nobody holds it any more.
        self._context = context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=f"disco-hw: {config.robot.name}", host=host, port=port, context=context
            )
        except (RuntimeError, OSError, ValueError) as error:
            self._feed.close()
            raise InputError(f"--port {port}: cannot listen on {host} ({error}); choose another port") from None
        self.url = f"ws://{host}:{self._server.port}"
        shown = [topic for topic in TOPICS if topic.record not in (FrameIn, FrameOut)]
        self._channels: dict[str, Any] = {
            topic.name: foxglove.Channel(
                topic.name, schema=_schema_of_record(topic.record), message_encoding="json", context=context
            )
            for topic in shown
        }
        for name, kind in (*VIEWS, (SCENE, SceneUpdate)):
            descriptors = build_file_descriptor_set(kind).SerializeToString()
            schema = foxglove.Schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=descriptors)
            self._channels[name] = foxglove.Channel(name, schema=schema, message_encoding="protobuf", context=context)

    def step(self) -> None:
        """Wait at most a tenth of a second for records, and pass on what has come."""
        received = self._feed.receive(_WAIT_S)
        offset_ns = time.time_ns() - time.monotonic_ns()
        for _, record in received:
            self._show(record, record.t_ns + offset_ns)
        now_s = time.monotonic()
        if now_s >= self._next_scene_s:
            # Again and again, for whoever has come since.
            self._next_scene_s = now_s + _SCENE_S
            self._channels[SCENE].log(self._scene, log_time=time.time_ns())

    def close(self) -> None:
        """Stop the Foxglove server and its feed; safe to call twice."""
        self._server.stop()
        self._feed.close()

    def _show(self, record: Record, wall_ns: int) -> None:
        channel = self._channels.get(topic_of(type(record)))
        if channel is not None:
            channel.log(encode_json(record), log_time=wall_ns)
        for name, data in views(record, wall_ns):
            self._channels[name].log(data, log_time=wall_ns)


def _schema_of_record(record: type[Record]) -> foxglove.Schema:
    return foxglove.Schema(name=record.__name__, encoding="jsonschema", data=json_schema(record))
