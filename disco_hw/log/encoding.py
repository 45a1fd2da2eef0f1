"""Records as JSON and their JSON schemas, such that every message obeys its schema and every float comes back.

JSON has no NaN or infinity. A field that is not finite, or holds something that is not, is left out, so that viewers
see no value; what it was is in the text field `not_finite`, as JSON with the strings "NaN", "Infinity" and "-Infinity"
(the mapping that protobuf uses). Every finite float comes back bit for bit, of NaN only that it was one. Bytes are
base64. Logs of before have those strings in the fields themselves, and are read as well.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, TypeVar, get_type_hints

import msgspec

from disco_hw.log.records import TOPICS, Plan, PlanFigures, Record, topic_of

# Integers are int64 in the schemas.
_LIMIT = 2**63
_R = TypeVar("_R")
_PLAN = topic_of(Plan)
_NOT_FINITE = "not_finite"
_NOT_FINITE_KEY = b'"not_finite":'
_NOTE = "A field that is not finite is left out, and what it was is in not_finite, as JSON; bytes are base64."

_PLAIN_KEYS = ("title", "type", "description", "contentEncoding")


def encode_json(record: Record) -> bytes:
    """One record as a JSON object, floats in the shortest form that reads back to the same bits."""
    encoded = msgspec.json.encode(record)
    if b"null" not in encoded:
        return encoded
    # No field is optional, so a null is a non-finite number (or the word in a text, which the detour leaves alone).
    fields: dict[str, Any] = msgspec.to_builtins(record)
    odd = {name: _spelled(value) for name, value in fields.items() if not _finite(value)}
    if not odd:
        return encoded
    finite = {name: value for name, value in fields.items() if name not in odd}
    return msgspec.json.encode({**finite, _NOT_FINITE: msgspec.json.encode(odd).decode()})


def _finite(value: Any) -> bool:
    if isinstance(value, list | tuple | dict):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _spelled(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_spelled(item) for item in value]
    if isinstance(value, dict):
        return {name: _spelled(item) for name, item in value.items()}
    if _finite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _restored(data: bytes) -> bytes:
    """Return a message with what it says of its fields that are not finite put back into them; raises MsgspecError."""
    fields = msgspec.json.decode(data, type=dict[str, msgspec.Raw])
    if _NOT_FINITE not in fields:
        return data
    text = msgspec.json.decode(fields.pop(_NOT_FINITE), type=str)
    fields |= msgspec.json.decode(text, type=dict[str, msgspec.Raw])
    return msgspec.json.encode(fields)


class JsonDecoder:
    """Decodes records of every topic; raises msgspec.MsgspecError on what is not such a record.

    OverflowError: it is one, with an integer that 64 bits do not hold.
    """

    def __init__(self) -> None:
        # Lax decoding is what turns the strings of the non-finite numbers back into floats.
        self._decoders = {topic.name: msgspec.json.Decoder(topic.record, strict=False) for topic in TOPICS}
        self._plan_figures = msgspec.json.Decoder(PlanFigures, strict=False)

    def decode(self, topic: str, data: bytes) -> Record:
        """Return the record of one message of `topic`."""
        return _decoded(self._decoders[topic], data)

    def decode_brief(self, topic: str, data: bytes) -> Record | PlanFigures:
        """Decode a record like `decode`, but of a plan only its scalar figures, in less than half of the time."""
        if topic != _PLAN:
            return self.decode(topic, data)
        return _decoded(self._plan_figures, data)


def _decoded(decoder: msgspec.json.Decoder[_R], data: bytes) -> _R:
    try:
        return _within_64_bits(decoder.decode(_restored(data) if _NOT_FINITE_KEY in data else data))
    except UnicodeDecodeError as error:
        raise msgspec.DecodeError(f"not UTF-8: {error.reason}") from None


_INTEGERS: dict[type, tuple[str, ...]] = {
    record: tuple(name for name, hint in get_type_hints(record).items() if hint in (int, dict[str, int]))
    for record in (PlanFigures, *(topic.record for topic in TOPICS))
}
"""Names of the fields that are integers, or map names to them."""


def _within_64_bits(record: _R) -> _R:
    """Return the record, if every integer of it has a place in an array of numpy's; raises OverflowError."""
    for name in _INTEGERS[type(record)]:
        value = getattr(record, name)
        for one in value.values() if isinstance(value, dict) else (value,):
            if not -_LIMIT <= one < _LIMIT:
                raise OverflowError(name)
    return record


@cache
def json_schema(record_type: type[Record]) -> bytes:
    """Return the JSON schema of a record type in the plain form that viewers read.

    Viewers of recorded data want an object at the root, a single `type` for each property, and no `$ref`.
    """
    schema = msgspec.json.schema(record_type)
    plain = _plain(schema, schema.get("$defs", {}))
    plain["description"] = f"{plain.get('description', '')} {_NOTE}".strip()
    fields = plain["properties"]
    plain["required"] = [name for name in fields if not _may_be_missing(fields[name])]
    if len(plain["required"]) < len(fields):
        fields[_NOT_FINITE] = {"type": "string"}
    return msgspec.json.encode(plain)


def _may_be_missing(field: dict[str, Any]) -> bool:
    """Whether a field has numbers that need not be finite."""
    # What an object's members are is left out of the plain form: they may be numbers.
    return field["type"] == "object" or "number" in (field["type"], field.get("items", {}).get("type"))


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _plain(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    plain: dict[str, Any] = {key: schema[key] for key in _PLAIN_KEYS if key in schema}
    if "enum" in schema:
        plain |= {"type": "string", "enum": schema["enum"]}
    if "items" in schema:
        plain["items"] = _plain(schema["items"], definitions)
    if "properties" in schema:
        plain["properties"] = {name: _plain(item, definitions) for name, item in schema["properties"].items()}
    return plain
