"""The sum of a row of BLOCK samples, in vectors: written out, as a compiler may not change the order of a sum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from disco_hw.control.kernel.layout import BLOCK

# Any, here and below: numba's compiler and its code generator have no types.
_intrinsic: Any = intrinsic
_LANES = 16
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, _LANES)
_BYTES = 4


@_intrinsic
def row_sum(_context: Any, row: Any, first: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of the BLOCK numbers of a flat float32 array from index `first` on, always in the same order."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data

        def part(number: int) -> Any:
            at = builder.add(arguments[1], ir.Constant(arguments[1].type, number * _LANES))
            pointer = builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer())
            return builder.load(pointer, align=_BYTES)

        total = part(0)
        for number in range(1, int(BLOCK) // _LANES):
            total = builder.fadd(total, part(number))
        width = _LANES
        while width > 1:
            width //= 2
            lanes = ir.VectorType(ir.IntType(32), width)
            low, high = (ir.Constant(lanes, list(range(begin, begin + width))) for begin in (0, width))
            total = builder.fadd(builder.shuffle_vector(total, total, low), builder.shuffle_vector(total, total, high))
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return types.float32(row, types.uintp), generate
