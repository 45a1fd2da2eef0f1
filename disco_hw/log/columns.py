"""Records as numpy columns for analysis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.records import Record

Column = NDArray[np.generic]


def to_columns(record_type: type[Record], now_ns: Sequence[int], records: Sequence[Record]) -> dict[str, Column]:
    """One array for each field of N records, and `now_ns` (N,): numbers as int64, float64 or bool, text as objects.

    Tuples of one common length k become (N, k), of several lengths an object array of arrays; a mapping becomes a
    column `field.key` for every key found, float64 with NaN where a record lacks it.
    """
    columns: dict[str, Column] = {"now_ns": np.asarray(now_ns, dtype=np.int64)}
    for name in record_type.__struct_fields__:
        values = [getattr(record, name) for record in records]
        if values and isinstance(values[0], dict):
            for key in sorted({key for value in values for key in value}):
                columns[f"{name}.{key}"] = _column([value.get(key, math.nan) for value in values])
        else:
            columns[name] = _column(values)
    return columns


def _column(values: list[Any]) -> Column:
    if not values:
        return np.empty(0)
    if isinstance(values[0], tuple):
        return _tuples(values)
    kinds = {type(value) for value in values}
    if kinds == {bool}:
        return np.asarray(values, dtype=np.bool_)
    if kinds == {int}:
        return np.asarray(values, dtype=np.int64)
    if kinds <= {int, float}:
        return np.asarray(values, dtype=np.float64)
    return _objects(values)


def _tuples(values: list[tuple[Any, ...]]) -> Column:
    lengths = {len(value) for value in values}
    numeric = all(isinstance(item, float | int) for value in values for item in value)
    if len(lengths) == 1 and numeric:
        return np.asarray(values, dtype=np.float64)
    return _objects([np.asarray(value, dtype=np.float64) for value in values] if numeric else values)


def _objects(values: list[Any]) -> Column:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
