"""Records as JSON and their JSON schemas, such that every float comes back bit for bit.

JSON has no NaN or infinity; they are written as the strings "NaN", "Infinity" and "-Infinity" (the mapping that
protobuf uses for JSON). Their sign survives, the payload bits of a NaN do not. Bytes are base64.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from disco_hw.log.records import TOPICS, Plan, PlanFigures, Record, topic_of

_PLAN = topic_of(Plan)
_NOTE = 'Non-finite numbers are written as the strings "NaN", "Infinity" and "-Infinity"; bytes as base64.'

_PLAIN_KEYS = ("title", "type", "description", "contentEncoding", "required")


def encode_json(record: Record) -> bytes:
    """One record as a JSON object, floats in the shortest form that reads back to the same bits."""
    encoded = msgspec.json.encode(record)
    if b"null" not in encoded:
        return encoded
    # No field is optional, so a null is a non-finite number (or the word in a text, which the detour leaves alone).
    return msgspec.json.encode(_spell_non_finite(msgspec.to_builtins(record)))


def _spell_non_finite(value: Any) -> Any:
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        if math.isnan(value):
            return "NaN"
        return "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, dict):
        return {key: _spell_non_finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_spell_non_finite(item) for item in value]
    return value


class JsonDecoder:
    """Decodes records of every topic; raises msgspec.MsgspecError on what is not such a record."""

    def __init__(self) -> None:
        # Lax decoding is what turns the strings of the non-finite numbers back into floats.
        self._decoders = {topic.name: msgspec.json.Decoder(topic.record, strict=False) for topic in TOPICS}
        self._plan_figures = msgspec.json.Decoder(PlanFigures, strict=False)

    def decode(self, topic: str, data: bytes) -> Record:
        """The record of one message of `topic`."""
        return self._decoders[topic].decode(data)

    def decode_brief(self, topic: str, data: bytes) -> Record | PlanFigures:
        """The same, but of a plan the figures alone, which takes less than half of the time."""
        return self._plan_figures.decode(data) if topic == _PLAN else self._decoders[topic].decode(data)


def json_schema(record_type: type[Record]) -> bytes:
    """The JSON schema of a record type in the plain form that viewers read.

    Viewers of recorded data want an object at the root, a single `type` for each property, and no `$ref`.
    """
    schema = msgspec.json.schema(record_type)
    plain = _plain(schema, schema.get("$defs", {}))
    plain["description"] = f"{plain.get('description', '')} {_NOTE}".strip()
    return msgspec.json.encode(plain)


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
