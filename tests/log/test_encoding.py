import json
import math

import msgspec
import pytest
from jsonschema import Draft202012Validator

from disco_hw.log.encoding import JsonDecoder, encode_json, json_schema
from disco_hw.log.records import TOPICS, Estimate, Event, Task, topic_of
from tests.log.any_record import ANY_RECORD
from tests.tables import examples
from tools.log_samples import bits

DECODER = JsonDecoder()
VIEWER_TYPES = {"boolean", "string", "number", "integer", "object", "array"}


VALIDATORS = {topic.name: Draft202012Validator(json.loads(json_schema(topic.record))) for topic in TOPICS}


@examples(quick=40, every=100, record=ANY_RECORD)
def test_every_record_is_strict_json_that_obeys_its_schema_and_comes_back_to_the_last_bit(record):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    topic, data = topic_of(type(record)), encode_json(record)
    assert bits(DECODER.decode(topic, data)) == bits(record)
    plain = json.loads(data, parse_constant=refuse)
    VALIDATORS[topic].validate(plain)
    assert set(plain) <= set(VALIDATORS[topic].schema["properties"])


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_a_schema_distinguishes_its_own_messages_from_others(topic):
    validator = VALIDATORS[topic.name]
    Draft202012Validator.check_schema(validator.schema)
    assert not validator.is_valid({})
    for name, field in validator.schema["properties"].items():
        if field["type"] in {"number", "integer"}:
            assert not validator.is_valid({name: "NaN"})
            assert not validator.is_valid({name: None})


def estimate(x_m=1.0, y_m=1.0, yaw_rad=1.0, covariance=()):
    return Estimate(1, x_m, y_m, yaw_rad, covariance, 1.0, 1.0, 1.0, 1.0)


def test_a_field_that_is_not_finite_is_left_out_and_comes_back():
    values = (math.nan, math.inf, -math.inf, -0.0, 5e-324, 0.1, 1.7976931348623157e308, 0.0, 1.0)
    record = estimate(math.nan, math.inf, -0.0, values)
    plain = json.loads(encode_json(record))
    assert not {"x_m", "y_m", "covariance"} & set(plain)
    assert json.loads(plain["not_finite"]) == {
        "x_m": "NaN",
        "y_m": "Infinity",
        "covariance": ["NaN", "Infinity", "-Infinity", -0.0, 5e-324, 0.1, 1.7976931348623157e308, 0.0, 1.0],
    }
    assert bits(DECODER.decode("/estimate", encode_json(record))) == bits(record)
    assert "not_finite" not in json.loads(encode_json(estimate()))


def test_a_mapping_with_a_number_that_is_not_finite_is_left_out_and_comes_back():
    record = Task(1, "circle", {"radius_m": math.nan, "speed_m_s": 0.5})
    plain = json.loads(encode_json(record))
    assert "settings" not in plain
    assert json.loads(plain["not_finite"])["settings"] == {"radius_m": "NaN", "speed_m_s": 0.5}
    assert bits(DECODER.decode("/task", encode_json(record))) == bits(record)


def test_what_older_logs_hold_in_the_field_itself_is_read():
    old = b'{"t_ns":1,"t0_ns":1,"step_s":0.1,"left_rad_s":[],"right_rad_s":["-Infinity"],"mean_cost":"NaN","x":"NaN"}'
    plan = DECODER.decode("/plan", old)
    assert math.isnan(plan.mean_cost)
    assert plan.right_rad_s == (-math.inf,)


@pytest.mark.parametrize("text", ["x", "[]", "1", '{"x_m":"far"}', '{"x_m":'])
def test_what_is_said_of_a_field_and_is_nonsense_is_refused(text):
    fields = json.loads(encode_json(estimate())) | {"not_finite": text}
    with pytest.raises(msgspec.MsgspecError):
        DECODER.decode("/estimate", json.dumps(fields, separators=(",", ":")).encode())


def test_a_text_that_looks_like_a_number_stays_a_text():
    for text in ("NaN", "null", "Infinity", "1.5", "not_finite", '"not_finite":', "null not_finite"):
        record = Event(1, "info", text, text)
        assert DECODER.decode("/event", encode_json(record)) == record


NOT_UTF8 = b'{"t_ns":1,"level":"a\xe3b","source":"s","text":"t"}'


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"t_ns":"x"}', b'{"t_ns":1}', b"\xff\xfe", NOT_UTF8])
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
    assert "not_finite" in schema["description"]
