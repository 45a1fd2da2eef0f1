import json
import math

import msgspec
import pytest
from hypothesis import given

from disco_hw.log.encoding import JsonDecoder, encode_json, json_schema
from disco_hw.log.records import TOPICS, Estimate, Event, topic_of
from tools.log_samples import ANY_RECORD, bits

DECODER = JsonDecoder()
VIEWER_TYPES = {"boolean", "string", "number", "integer", "object", "array"}


@given(ANY_RECORD)
def test_every_record_comes_back_to_the_last_bit(record):
    back = DECODER.decode(topic_of(type(record)), encode_json(record))
    assert bits(back) == bits(record)


@given(ANY_RECORD)
def test_every_record_is_strict_json_with_the_properties_of_its_schema(record):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    plain = json.loads(encode_json(record), parse_constant=refuse)
    assert set(plain) == set(json.loads(json_schema(type(record)))["properties"])


def test_non_finite_numbers_are_spelled_as_protobuf_spells_them_in_json():
    values = (math.nan, math.inf, -math.inf, -0.0, 5e-324, 0.1, 1.7976931348623157e308, 0.0, 1.0)
    record = Estimate(1, math.nan, math.inf, -0.0, values, 1.0, 1.0, 1.0, 1.0)
    plain = json.loads(encode_json(record))
    assert plain["x_m"] == "NaN"
    assert plain["y_m"] == "Infinity"
    assert plain["covariance"] == ["NaN", "Infinity", "-Infinity", -0.0, 5e-324, 0.1, 1.7976931348623157e308, 0.0, 1.0]


def test_a_text_that_looks_like_a_number_stays_a_text():
    for text in ("NaN", "null", "Infinity", "1.5"):
        record = Event(1, "info", text, text)
        assert DECODER.decode("/event", encode_json(record)) == record


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"t_ns":"x"}', b'{"t_ns":1}', b"\xff\xfe"])
def test_what_is_no_record_is_refused(data):
    with pytest.raises(msgspec.MsgspecError):
        DECODER.decode("/event", data)


def viewer_reads(schema):
    """The rules of the JSON schema readers of Foxglove and Lichtblick."""
    assert schema["type"] == "object"
    assert "$ref" not in schema
    for name, field in schema.get("properties", {}).items():
        assert field["type"] in VIEWER_TYPES, name
        assert field.get("contentEncoding", "base64") == "base64"
        assert not {"anyOf", "oneOf", "$ref", "prefixItems"} & set(field), name
        if field["type"] == "object":
            viewer_reads(field)
        if field["type"] == "array":
            assert field["items"]["type"] in VIEWER_TYPES - {"array"}, name
            assert "contentEncoding" not in field["items"]


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_schema_is_one_that_viewers_read(topic):
    schema = json.loads(json_schema(topic.record))
    viewer_reads(schema)
    assert schema["title"] == topic.record.__name__
    assert "NaN" in schema["description"]
