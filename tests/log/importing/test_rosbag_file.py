"""What is no bag, or a damaged or hostile one: one line that names the file and what to do."""

import os
import random
import re
import struct
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'disco-hw[ros2]'")

from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from disco_hw.errors import InputError, LogError
from disco_hw.log.importing import format_of, import_log
from disco_hw.log.importing.rosbag import read_rosbag
from disco_hw.log.load import load_drive
from tests.inference.drives import robot_config
from tests.log.importing.bags import BEGAN_NS, Maker, bag, config, recorded
from tests.log.importing.commands import refusal_of_import
from tests.log.refusals import refused
from tests.tables import thinned


def small(path, storage="mcap", samples=range(50)):
    """A bag of wheel samples."""
    with bag(path, storage) as maker:
        for k in samples:
            maker.wheels(k)
    return path


def file_of(folder):
    return next(one for one in folder.iterdir() if one.suffix in {".mcap", ".db3"})


def small_file(folder, storage="mcap"):
    """The file of a bag of wheel samples."""
    path = small(folder / "b.bag", storage)
    return path if storage == "ros1" else file_of(path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "ros1"])
def test_bags_are_recognised_by_their_first_bytes(tmp_path, storage):
    path = small_file(tmp_path, storage)
    assert format_of(path.read_bytes()[:64]).name == "rosbag"
    assert read_rosbag(path, robot_config()).wheels.t_s.size == 50


def test_a_log_of_ours_is_no_bag():
    begin = b"\x89MCAP0\r\n\x01\x10" + bytes(7) + struct.pack("<I", 0) + b"\x08\0\0\0disco-hw"
    assert format_of(begin).name != "rosbag"


def test_what_infer_is_given_as_a_bag_is_to_be_imported_first(tmp_path):
    with pytest.raises(LogError, match=r"a rosbag; make it a log with `disco-hw import"):
        load_drive(small_file(tmp_path))


@pytest.fixture(scope="module")
def complete_bags(tmp_path_factory):
    """The content of one drive's bag by storage, and its number of wheel samples."""
    folder, contents = tmp_path_factory.mktemp("bags"), {}
    for storage in ("mcap", "sqlite3", "ros1"):
        path = folder / f"{storage}.bag"
        truth = recorded(path, storage)
        contents[storage] = (path if storage == "ros1" else file_of(path)).read_bytes()
    return contents, truth.wheels.t_s.size


ENDINGS = {"mcap": "mcap", "sqlite3": "db3", "ros1": "bag"}


@thinned("storage", ENDINGS, quick=2)
@thinned("share", [0.55, 0.7, 0.9, 0.99], quick=1)
def test_a_truncated_bag_is_read_as_far_as_it_is_whole(tmp_path, complete_bags, storage, share):
    contents, samples = complete_bags
    path = tmp_path / f"b.{ENDINGS[storage]}"
    path.write_bytes(contents[storage][: int(share * len(contents[storage]))])
    drive = read_rosbag(path, robot_config())
    assert 0.3 * share * samples < drive.wheels.t_s.size <= samples
    assert (np.diff(drive.wheels.t_s) < 0.5).all()
    warned = [note for note in drive.notes if note.startswith("warning: ")]
    assert re.search(r"damaged, or its recording did not end regularly: \d+ messages could be read", warned[0])


@pytest.mark.parametrize("storage", ENDINGS)
@pytest.mark.parametrize("size", [20, 100])
def test_a_bag_that_was_cut_before_its_first_message_is_one_line(tmp_path, complete_bags, storage, size):
    path = tmp_path / f"b.{ENDINGS[storage]}"
    path.write_bytes(complete_bags[0][storage][:size])
    with refused(r"b\.\w+: the bag cannot be read .*; record it again, or convert"):
        read_rosbag(path, robot_config())


@pytest.mark.thorough
def test_wherever_an_mcap_is_cut_it_is_a_drive_with_a_warning_or_one_line(tmp_path, complete_bags):
    content, rng, path = complete_bags[0]["mcap"], random.Random(7), tmp_path / "b.mcap"
    for _ in range(10):
        path.write_bytes(content[: rng.randrange(len(content))])
        try:
            message = read_rosbag(path, robot_config()).notes[0]
            assert message.startswith("warning: ")
        except LogError as error:
            message = str(error)
        assert "\n" not in message
        assert str(path) in message


@pytest.mark.parametrize("kind", ["mcap", "bz2", "lz4"])
def test_a_damaged_chunk_costs_its_messages_only(tmp_path, kind):
    path, chunks = in_chunks(tmp_path, kind)
    assert len(chunks) > 5
    spoilt = bytearray(path.read_bytes())
    for at in range(chunks[3] + 20, chunks[3] + 80):
        spoilt[at] ^= 0x55
    path.write_bytes(spoilt)
    drive = read_rosbag(path, robot_config())
    assert 200 < drive.wheels.t_s.size < 400
    assert drive.wheels.left_angle_rad[-1] == pytest.approx(0.1 * 399)
    assert "1 damaged chunks were left out" in drive.notes[0]


def in_chunks(folder, kind):
    """A bag of 400 wheel samples in small packed chunks, and where the bytes of each chunk begin."""
    if kind == "mcap":
        small(folder / "b", samples=range(400))
        path = folder / "chunks.mcap"
        with file_of(folder / "b").open("rb") as source, path.open("wb") as sink:
            writer = McapWriter(sink, chunk_size=10_000)
            writer.start(profile="ros2")
            topic = None
            for schema, channel, message in make_reader(source).iter_messages():
                if topic is None:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    topic = writer.register_channel(channel.topic, channel.message_encoding, number)
                writer.add_message(topic, message.log_time, message.data, message.publish_time)
            writer.finish()
        with path.open("rb") as source:
            found = make_reader(source).get_summary().chunk_indexes
        return path, [one.chunk_start_offset + one.chunk_length - one.compressed_size for one in found]
    path = folder / "chunks.bag"
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat[kind.upper()])
    vars(writer).update(chunk_threshold=10_000)
    with writer:
        maker = Maker(writer, get_typestore(Stores.ROS1_NOETIC), True)
        for k in range(400):
            maker.wheels(k)
    return path, [one.end() for one in re.finditer(b"size=....(?=....(BZh|\x04\x22M))", path.read_bytes(), re.DOTALL)]


@thinned(("storage", "count"), [("mcap", 15), ("mcap", 60), ("sqlite3", 60), ("ros1", 60)], quick=1)
def test_a_mutated_bag_is_a_drive_or_one_line(tmp_path, storage, count):
    source = small_file(tmp_path, storage)
    content, rng = source.read_bytes(), random.Random(3)
    for _ in range(count):
        spoilt = bytearray(content)
        for _ in range(rng.choice((1, 3, 20))):
            spoilt[rng.randrange(len(spoilt))] = rng.choice((0, 1, 0x7F, 0xFF, rng.randrange(256)))
        source.write_bytes(spoilt)
        message = str(source)
        try:
            read_rosbag(source, robot_config())
        except InputError as error:
            message = str(error)
        assert "\n" not in message
        assert str(source) in message


@pytest.mark.parametrize("size", [2**31, 2**40, 2**62, 2**64 - 1])
def test_a_chunk_that_claims_any_size_is_read_as_one_that_was_cut(tmp_path, size):
    path = small_file(tmp_path)
    spoilt = bytearray(path.read_bytes())
    # The first record after the header: its opcode, then its length.
    header = struct.unpack_from("<Q", spoilt, 9)[0]
    struct.pack_into("<Q", spoilt, 17 + header + 1, size)
    # Without the index at the end the file is read through.
    struct.pack_into("<Q", spoilt, len(spoilt) - 28, 0)
    path.write_bytes(spoilt)
    drive = read_rosbag(path, robot_config())
    assert drive.wheels.t_s.size == 50
    assert drive.notes[0].startswith("warning: ")


@pytest.mark.parametrize("size", [2**31, 2**40, 2**62, 2**64 - 1])
def test_a_first_record_that_claims_any_size_is_one_line(tmp_path, size):
    path = small_file(tmp_path)
    spoilt = bytearray(path.read_bytes())
    struct.pack_into("<Q", spoilt, 9, size)
    path.write_bytes(spoilt)
    with refused():
        read_rosbag(path, robot_config())


def test_a_message_that_claims_a_list_of_any_size_is_one_line(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for size in (2**31 - 1, 2**32 - 1):
            raw = b"\0\1\0\0" + struct.pack("<iII", 1, 0, 1) + b"\0\0\0\0" + struct.pack("<I", size)
            writer.write(connection, BEGAN_NS, raw)
    with refused(r"/joint_states .*none of its messages can be decoded|needs over"):
        read_rosbag(tmp_path / "b", robot_config())


@pytest.mark.thorough
def test_a_chunk_that_unpacks_to_more_than_memory_is_one_line(tmp_path, robot):
    """3 GiB of zeros in 100 kB: in a process of its own, as what it takes must not stay."""
    import zstandard

    compressor = zstandard.ZstdCompressor(level=1).compressobj(size=3 * 2**30)
    packed = b"".join(compressor.compress(bytes(2**24)) for _ in range(192)) + compressor.flush()
    chunk = struct.pack("<QQQI", 0, 2**62, 3 * 2**30, 0) + struct.pack("<I", 4) + b"zstd"
    chunk += struct.pack("<Q", len(packed)) + packed
    magic, profile = b"\x89MCAP0\r\n", struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    records = [(1, profile), (6, chunk), (2, bytes(20))]
    bomb = tmp_path / "bomb.mcap"
    bomb.write_bytes(magic + b"".join(struct.pack("<BQ", op, len(data)) + data for op, data in records) + magic)
    assert "bomb.mcap" in refusal_of_import(bomb, robot, timeout=200)


def test_a_bag_without_a_usable_topic_says_what_it_has(tmp_path):
    with bag(tmp_path / "b") as maker:
        maker.write("/twist_of_fate", maker.twist(0.0, 0.0), BEGAN_NS)
    message = r"/b: no topic with commands, wheels or poses; it has /twist_of_fate \(geometry"
    with pytest.raises(LogError, match=message):
        read_rosbag(tmp_path / "b", robot_config())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"wheel_topic": "/joints"}, r"wheels: no topic /joints; it has /joint_states"),
        (
            {"pose_topic": "/joint_states"},
            r"poses: /joint_states is of type sensor_msgs/msg/JointState, which holds no",
        ),
        ({"pose_topic": "tf"}, r"no transforms lead from map or .*; set ros2.map_frame"),
    ],
)
def test_a_topic_that_is_not_there_is_named(tmp_path, settings, message):
    with refused(message):
        read_rosbag(small(tmp_path / "b"), config(**settings))


def custom(path, storage):
    """A bag with a message type that ROS itself has not."""
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "my_msgs/msg/Drive"
    store.register(get_types_from_msg("float32[2] drivers", kind))
    raw = store.serialize_cdr(store.types[kind](np.array([2.0, 5.0], dtype=np.float32)), kind)
    with Writer(path, version=8, storage_plugin=storage) as writer:
        connection = writer.add_connection("/cmd_drive", kind, typestore=store)
        for k in range(20):
            writer.write(connection, BEGAN_NS + k * 20_000_000, raw)
    return path


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_type_that_the_bag_defines_is_read(tmp_path, storage):
    drive = read_rosbag(custom(tmp_path / "b", storage), robot_config())
    assert (drive.commands.left_rad_s[0], drive.commands.right_rad_s[0]) == (2.0, 5.0)


def test_a_type_that_nobody_knows_is_named(tmp_path):
    import apsw

    folder = custom(tmp_path / "b", StoragePlugin.SQLITE3)
    with apsw.Connection(str(file_of(folder))) as database:
        database.execute("DELETE FROM message_definitions")
    with pytest.raises(LogError, match=r"/cmd_drive: its type my_msgs/msg/Drive is not of ROS and the bag does not"):
        read_rosbag(folder, config(command_topic="/cmd_drive"))


@thinned(
    "metadata",
    [None, "rosbag2_bagfile_information:\n  version: 5\n", "rosbag2_bagfile_information: [", "", "\0\0"],
    quick=2,
    ids=["none", "no files", "not YAML", "empty", "zeros"],
)
def test_a_folder_whose_metadata_is_missing_or_wrong_is_read_by_its_files(tmp_path, robot, metadata):
    folder = small(tmp_path / "b")
    (folder / "metadata.yaml").unlink()
    if metadata is not None:
        (folder / "metadata.yaml").write_text(metadata)
    drive = read_rosbag(folder, robot_config())
    assert drive.wheels.t_s.size == 50
    assert "b: read by its files (b.mcap), as " in drive.notes[0]
    assert import_log(folder, robot, tmp_path / "log.mcap").duration_s == pytest.approx(0.98, abs=0.01)


def test_a_file_of_the_metadata_that_is_not_there_is_a_warning(tmp_path):
    folder = small(tmp_path / "b")
    metadata = folder / "metadata.yaml"
    file = file_of(folder).name
    metadata.write_text(metadata.read_text().replace(f"- {file}\n", f"- {file}\n  - gone.mcap\n", 1))
    drive = read_rosbag(folder, robot_config())
    assert drive.wheels.t_s.size == 50
    assert drive.notes[0].startswith("warning: ")
    assert "gone.mcap" in drive.notes[0]


def test_an_empty_storage_identifier_is_read_by_the_files(tmp_path):
    folder = small(tmp_path / "b")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("storage_identifier: mcap", "storage_identifier: ''"))
    drive = read_rosbag(folder, robot_config())
    assert drive.wheels.t_s.size == 50
    assert "read by its files" in drive.notes[0]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_files_of_a_bag_that_was_split_are_read_in_order_of_time(tmp_path, storage):
    folder = tmp_path / "log"
    folder.mkdir()
    for number in (8, 9, 10):
        samples = range(50 * (number - 8), 50 * (number - 7))
        part = small(tmp_path / f"part{number}", storage, samples)
        file_of(part).rename(folder / f"log_{number}.{ENDINGS[storage]}")
    drive = read_rosbag(folder, robot_config())
    names = ", ".join(f"log_{number}.{ENDINGS[storage]}" for number in (8, 9, 10))
    assert f"read by its files ({names}), as it has no metadata.yaml" in drive.notes[0]
    assert not drive.notes[0].startswith("warning: ")
    np.testing.assert_allclose(drive.wheels.left_angle_rad, 0.1 * np.arange(150))
    np.testing.assert_allclose(np.diff(drive.wheels.t_s), 0.02, atol=1e-9)
    assert drive.segments == 1


def test_a_pipe_in_a_bags_folder_holds_nobody_up(tmp_path):
    folder = small(tmp_path / "b")
    path = file_of(folder)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match="a pipe, not a plain file"):
        read_rosbag(folder, robot_config())


@pytest.mark.thorough
def test_a_command_on_what_is_no_bag_exits_with_two(tmp_path, robot):
    for name, content in (("a.db3", b"SQLite format 3\0rubbish"), ("a.mcap", b"\x89MCAP0\r\n\x01"), ("d", None)):
        path = tmp_path / name
        path.mkdir() if content is None else path.write_bytes(content)
        assert str(path) in refusal_of_import(path, robot).replace("\n", "")


def test_the_library_is_loaded_only_when_a_bag_is_read():
    code = "import sys, disco_hw.log.importing as w; w.log_formats(); print('rosbags' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
