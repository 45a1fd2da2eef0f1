import re

import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.errors import InputError
from disco_hw.files import MODEL_TOML, ROBOT_TOML
from disco_hw.log import ENCODE_ERRORS, BatchDecoder, Frames, attachment, batch_encoder, frame, version
from disco_hw.log.records import TOPICS, Estimate, Event, Plan
from tests.log.any_record import ANY_RECORD
from tests.tables import examples
from tools.log_samples import bits

ENCODE = batch_encoder()
DECODER = BatchDecoder()


def decoded(message):
    return [DECODER.record(index, data) for index, data in DECODER.batch(message).records]


@examples(
    quick=40,
    every=100,
    records=st.lists(ANY_RECORD, max_size=6),
    sequence=st.integers(1, 2**40),
    now_ns=st.integers(0, 2**62),
)
def test_a_batch_comes_back_to_the_last_bit(records, sequence, now_ns):
    message = ENCODE(sequence, now_ns, records)
    batch = DECODER.batch(message)
    assert (batch.sequence, batch.now_ns) == (sequence, now_ns)
    assert bits(decoded(message)) == bits(records)


def test_numpy_numbers_and_arrays_are_taken_row_major():
    covariance = np.arange(9.0).reshape(3, 3)
    record = Estimate(
        np.int64(7), np.float64(0.1), np.float32(0.5), 0.0, covariance, 0.0, 0.0, 0.0, 0.0, np.bool_(False)
    )
    (back,) = decoded(ENCODE(1, 2, [record]))
    assert back.t_ns == 7
    assert back.covariance == tuple(range(9))
    assert (back.x_m, back.y_m) == (0.1, 0.5)
    assert back.wheels_healthy is False
    table = np.arange(6.0).reshape(3, 2)
    (plan,) = decoded(ENCODE(1, 2, [Plan(1, 1, 0.1, table[:, 0], table[:, 1])]))
    assert (plan.left_rad_s, plan.right_rad_s) == ((0.0, 2.0, 4.0), (1.0, 3.0, 5.0))


@pytest.mark.parametrize("record", [object(), Event(1, "info", "x", object()), Event(2**70, "info", "x", "y"), 3])
def test_what_cannot_be_recorded_raises_one_of_the_named_errors(record):
    with pytest.raises(ENCODE_ERRORS):
        ENCODE(1, 1, [record])


@pytest.mark.parametrize("message", [b"\x00", b"abc", msgspec.msgpack.encode((1, 2)), msgspec.msgpack.encode({"a": 1})])
def test_what_is_no_batch_is_refused(message):
    with pytest.raises(msgspec.MsgspecError):
        DECODER.batch(message)


@pytest.mark.parametrize("index", [-1, len(TOPICS)])
def test_a_topic_that_does_not_exist_is_refused(index):
    batch = DECODER.batch(msgspec.msgpack.encode((1, 2, [(index, {"t_ns": 1})])))
    with pytest.raises(msgspec.MsgspecError):
        DECODER.record(*batch.records[0])


FRAMES = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)))


@examples(quick=40, every=100, frames=FRAMES, length=st.integers(1, 30))
def test_a_stream_cut_anywhere_gives_the_same_frames(frames, length):
    stream = b"".join(frame(kind, payload) for kind, payload in frames)
    decoder, got = Frames(), []
    for start in range(0, len(stream), length):
        decoder.add(stream[start : start + length])
        got += list(decoder)
    assert got == frames


def test_the_version_names_the_package_and_in_a_checkout_the_commit():
    assert re.fullmatch(r"\d+\.\d+\.\d+(\+g[0-9a-f]{7,}(-dirty)?)?", version())


def test_a_file_is_kept_as_it_is_and_one_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "model.toml"
    path.write_bytes(b"\xff\x00")
    kept = attachment(path, "model.toml", MODEL_TOML)
    assert (kept.name, kept.media_type, kept.data) == ("model.toml", "application/toml", b"\xff\x00")
    assert attachment(path, "robot.toml", ROBOT_TOML).name == "robot.toml"
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        attachment(tmp_path / "none.toml", "none.toml", ROBOT_TOML)
