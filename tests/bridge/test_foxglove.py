"""Foxglove live: a client of its protocol gets the topics and what the feed has; the layout names them."""

import asyncio
import json
import re
import struct
import threading
import types
import typing

import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: make venv")
from foxglove import layouts
from typer.testing import CliRunner
from websockets.asyncio.client import connect

from disco_hw.bridge.foxglove import LAYOUT, Live
from disco_hw.cli import app
from disco_hw.config import load_robot_config
from disco_hw.daemon import run, socket_path
from disco_hw.daemon.page_feed import ViewerFeed, feed_path
from disco_hw.errors import InputError
from disco_hw.log.mcap_log import SCENE, VIEWS
from disco_hw.log.records import TOPIC_BY_NAME, DaemonState, Estimate, Event
from disco_hw.runtime.robot_setup import load_setup, scene_of
from tools.stack import write_robot_file

ESTIMATE = Estimate(7, 1.0, 2.0, 0.5, (0.0,) * 9, 0.25, 0.0, 0.0, 0.0)
REQUIRED_TOPICS = {"/estimate", "/view/transform", SCENE}


@pytest.fixture
def live(tmp_path):
    config = load_robot_config(write_robot_file(tmp_path))
    feed = ViewerFeed(feed_path(socket_path(config)), period_s=0.0)
    served = Live(config, "127.0.0.1", 0)
    ended = threading.Event()

    def serve():
        now_ns = 0
        # Without a pause it would take the processor from the client.
        while not ended.wait(0.001):
            now_ns += 1
            feed.put(now_ns, [ESTIMATE, Event(now_ns, "info", "a", "b"), DaemonState(now_ns, "READY", "READY")])
            served.step()

    thread = threading.Thread(target=serve)
    thread.start()
    yield served
    ended.set()
    thread.join()
    served.close()
    feed.close()


async def receive(url):
    """The advertised channels by topic, and the first message of each wanted one."""
    async with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:
        channels, messages = {}, {}
        while REQUIRED_TOPICS - set(messages):
            message = await asyncio.wait_for(client.recv(), 30.0)
            if isinstance(message, str):
                for channel in json.loads(message).get("channels", []):
                    channels[channel["topic"]] = channel
                channel_ids = [one["id"] for one in channels.values() if one["topic"] in REQUIRED_TOPICS]
                subscriptions = [{"id": number, "channelId": number} for number in channel_ids]
                await client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
            elif message[0] == 1:
                number, _ = struct.unpack("<IQ", message[1:13])
                topic = next(one["topic"] for one in channels.values() if one["id"] == number)
                messages.setdefault(topic, message[13:])
        return channels, messages


def test_a_client_gets_all_topics_and_what_the_daemon_records(live):
    channels, messages = asyncio.run(receive(live.url))
    assert {name for name, _ in VIEWS} | (set(TOPIC_BY_NAME) - {"/can/rx", "/can/tx"}) | {SCENE} == set(channels)
    assert channels["/estimate"]["encoding"] == "json"
    assert channels["/view/transform"]["schemaName"] == "foxglove.FrameTransform"
    estimate = json.loads(messages["/estimate"])
    assert (estimate["x_m"], estimate["y_m"], estimate["speed_m_s"]) == (1.0, 2.0, 0.25)
    scene = SceneUpdate()
    scene.ParseFromString(messages[SCENE])
    task, robot = scene.entities
    assert (task.frame_id, robot.frame_id) == ("world", "robot")
    assert max(point.x for point in task.lines[0].points) == pytest.approx(0.75, abs=0.01)


def test_the_daemon_has_its_recorder_write_the_scene(tmp_path, monkeypatch):
    setup = load_setup(write_robot_file(tmp_path))
    monkeypatch.setattr(run, "ProcessRecorder", lambda settings: settings)
    assert run._create_recorder(setup, tmp_path / "log.mcap").scene == scene_of(setup.config)


def test_a_port_that_is_taken_is_refused_in_one_line(live, tmp_path):
    config = load_robot_config(write_robot_file(tmp_path))
    with pytest.raises(InputError, match=r"--port \d+: cannot listen on .*; choose another port"):
        Live(config, "127.0.0.1", int(live.url.rpartition(":")[2]))


@pytest.mark.parametrize("arguments", [["run.mcap"], ["--live"], ["--live", "--robot", "r.toml", "--host", "0.0.0.0"]])
def test_what_it_is_not_for_is_refused(arguments):
    with pytest.raises(InputError):
        CliRunner().invoke(app(), ["view", "--foxglove", *arguments], catch_exceptions=False)


def test_the_layout_names_topics_and_fields_that_there_are():
    text = LAYOUT.read_text(encoding="utf-8")
    panels = json.loads(text)["configById"]
    views = {name for name, _ in VIEWS} | {SCENE}
    assert set(panels["3D!scene"]["topics"]) <= views
    assert panels["RosOut!log"]["topicToRender"] in views
    for topic, field in re.findall(r'"value": "(/[a-z/]+)\.(\w+)"', text):
        assert field in TOPIC_BY_NAME[topic].record.__struct_fields__, (topic, field)
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', text)
    assert sorted(placed) == sorted(panels)


KINDS = {"3D": "ThreeDee", "Plot": "Plot", "StateTransitions": "StateTransitions", "RosOut": "Log"}


def faults(value, kind, where):
    """Return what contradicts Foxglove's own description of its panels: unknown fields, values of the wrong kind."""
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        each = [faults(value, one, where) for one in typing.get_args(kind)]
        return min(each, key=len)
    if origin is typing.Literal:
        return [] if value in typing.get_args(kind) else [f"{where}: {value!r} is none of {typing.get_args(kind)}"]
    if origin in (list, tuple):
        inner = typing.get_args(kind)
        return [fault for one, of in zip(value, inner * len(value), strict=False) for fault in faults(one, of, where)]
    if origin is dict:
        return [
            fault for name, one in value.items() for fault in faults(one, typing.get_args(kind)[1], f"{where}.{name}")
        ]
    if hasattr(kind, "_to_dict") and isinstance(value, dict):
        hints = {
            re.sub(r"_(\w)", lambda m: m[1].upper(), name): hint
            for name, hint in typing.get_type_hints(kind, vars(layouts)).items()
        }
        return [
            fault
            for name, one in value.items()
            for fault in (faults(one, hints[name], f"{where}.{name}") if name in hints else [f"{where}: no {name}"])
        ]
    if kind is float:
        return [] if isinstance(value, int | float) else [f"{where}: {value!r} is no number"]
    return (
        [] if not isinstance(kind, type) or isinstance(value, kind) else [f"{where}: {value!r} is no {kind.__name__}"]
    )


def test_the_layout_is_one_by_foxgloves_own_description_of_its_panels():
    for name, panel in json.loads(LAYOUT.read_text(encoding="utf-8"))["configById"].items():
        config = getattr(layouts, KINDS.get(name.split("!")[0], "RawMessages") + "Config")
        panel.pop("foxglovePanelTitle", None)
        assert not faults(panel, config, name)
        broken = {**panel, "wibble": 1}
        assert faults(broken, config, name) == [f"{name}: no wibble"]
        if name.startswith("Plot"):
            assert faults({**panel, "legendDisplay": "nowhere"}, config, name)
            assert faults({**panel, "isSynced": "yes"}, config, name)
