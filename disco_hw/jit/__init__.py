"""Compilation of functions: one set of options, constants of the caller's precision, a cache key of all sources.

`numba_internals.py` says how what kernels call is put into them.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, typeof, types
from numba.core.base import BaseContext
from numba.core.typing.context import Context
from numba.core.typing.templates import Signature
from numba.extending import intrinsic, overload

from disco_hw.jit.numba_internals import Callee, CalleeCompiler, KernelCompiler
from drivers.kernel_cache import kept_on_disk

GROUP = "disco_hw.effects"


@cache
def plugin_modules() -> tuple[str, ...]:
    """Names of the modules, each with an `EFFECT` and its `term`, sorted."""
    return tuple(sorted({point.module for point in entry_points(group=GROUP)}))


def plugin_sources() -> tuple[Path, ...]:
    """Return the plug-in modules' files; raises ModuleNotFoundError for a module that is not there."""
    found = []
    for module in plugin_modules():
        spec = find_spec(module)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(f"{module}: named as an effect by an installed package, but not there")
        found.append(Path(spec.origin))
    return tuple(found)


# Without these a refined plan takes 6 % longer.
# No `nnan`, `ninf` (non-finite costs must stay visible), no `reassoc` (sums keep their order, so a run replays), no
# `arcp` (a quotient by a root is exact but where `reciprocal_root` asks for an estimate).
FAST_MATH = {"contract", "nsz"}

# Without copies in the callers a refined plan takes 3.6 times as long.
INLINED: dict[str, Any] = {"fastmath": FAST_MATH, "error_model": "numpy", "forceinline": True}


def scalar_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function into the callers that it has in kernels, each with a copy of its own."""
    return Callee(function, targetoptions=INLINED)


_intrinsic: Any = intrinsic
_typeof: Any = typeof

# How a loop takes a reciprocal root to 11 bits or more, which one Newton step makes 22: x86 estimates it so well at
# once, ARM to 8 bits and, by an instruction for the step, to 16.
ROOT_ESTIMATES = {"x86_64": "vec-sqrtf:0", "AMD64": "vec-sqrtf:0", "aarch64": "vec-sqrtf:1", "arm64": "vec-sqrtf:1"}


def block_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function with loops of its own, too large to be worth a copy in every caller of a kernel."""
    # What is not said here numba would take over from whichever function calls it first.
    return Callee(function, targetoptions={**INLINED, "forceinline": False})


# The compiler's scalar types, as casts.
int32: Any = types.int32
uint32: Any = types.uint32
float32: Any = types.float32


def specialise(function: Callable[..., Any]) -> Callable[..., Any]:
    """Register compiled forms of `function`, chosen by the types of its arguments."""
    options: Any = {**INLINED, "pipeline_class": CalleeCompiler}
    decorator: Callable[..., Any] = overload(function, jit_options=options, strict=False)
    return decorator


def compiled_only(argument: object) -> TypeError:
    """Return the error of a function that has compiled forms alone, and none for an argument of this type."""
    return TypeError(f"{type(argument).__name__}: no compiled form takes it, and Python cannot call this function")


@cache
def sources_fingerprint() -> str:
    """Hash of all Python sources that compiled code can come from."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for folder in ("jit", "effects", "model", "tasks", "control"):
        for path in sorted((package / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    for path in plugin_sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()


def parallel_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an entry point as `kernel_function` does, without the interpreter's lock while it runs: for threads."""
    kernel: Any = kernel_function(function)
    kernel.targetoptions["nogil"] = True
    compiled: Callable[..., Any] = kernel
    return compiled


def kernel_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an entry point: as `scalar_function`, but a function of its own, kept on disk between runs.

    numba's cache looks at the entry point's own file only; here it is tied to all sources, through a free variable that
    the function never reads, because free variables are part of numba's key.
    """
    assert isinstance(function, FunctionType)
    code = function.__code__.replace(co_freevars=("sources",))
    keyed = FunctionType(code, function.__globals__, function.__name__, None, (CellType(sources_fingerprint()),))
    keyed.__qualname__, keyed.__module__, keyed.__doc__ = function.__qualname__, function.__module__, function.__doc__
    options: Any = {"fastmath": FAST_MATH, "error_model": "numpy", "pipeline_class": KernelCompiler}
    compiled: Callable[..., Any] = kept_on_disk(njit(**options)(keyed))
    return compiled


def compiled_for(kernel: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return the machine code of a kernel for arguments of these types, compiled or loaded if need be.

    Calling it spares working their types out in every call: 12 us of the 190 us of a refined plan. It must only be
    called with arguments of the same types. Arrays of another kind are refused with a TypeError.
    """
    dispatcher: Any = kernel
    entry: Callable[..., Any] = dispatcher.compile(tuple(_typeof(argument) for argument in arguments))
    return entry


@_intrinsic
def tune_loops(_context: Context) -> tuple[Any, Callable[..., Any]]:
    """Let the loops of the calling function use the processor's widest vectors and its estimates of reciprocal roots.

    Without estimates a sampled plan takes 15 % longer, with the loops in their callers 13 %, with checks for overlap
    4 %; without wide vectors as long, on an AMD processor (docs/results.md).

    LLVM holds back to 256 bits on processors whose early kinds slowed down for 512; here every loop is long enough to
    gain. ARM's have one width, which is used anyway. The arrays that the function is handed must not overlap: no loop
    checks for it, and sums stay in registers.
    """

    def generate(context: BaseContext, builder: ir.IRBuilder, _signature: Signature, _arguments: list[ir.Value]) -> Any:
        # llvmlite knows no attributes with values; the set takes them all the same.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        estimate = ROOT_ESTIMATES.get(platform.machine())
        if estimate is not None:
            set.add(builder.function.attributes, f'"reciprocal-estimates"="{estimate}"')
        # A copy in the caller would be compiled with the caller's attributes.
        builder.function.attributes.add("noinline")
        for argument in builder.function.args:
            if isinstance(getattr(argument.type, "pointee", None), ir.FloatType):
                argument.add_attribute("noalias")
        return context.get_dummy_value()  # type: ignore[no-untyped-call]

    return types.void(), generate


@_intrinsic
def reciprocal_root(_context: Context, value: types.Type) -> tuple[Any, Callable[..., Any]]:
    """Reciprocal of a square root: to 11 bits or more in a loop with `tune_loops` that is float32, else exact."""

    def generate(_c: BaseContext, builder: ir.IRBuilder, signature: Signature, arguments: list[ir.Value]) -> Any:
        kind = arguments[0].type
        root = builder.module.declare_intrinsic("llvm.sqrt", [kind])
        one = ir.Constant(kind, 1.0)
        return builder.fdiv(one, builder.call(root, arguments), flags=("arcp",))

    return value(value), generate


@scalar_function
def float_from_bits(bits: Any) -> Any:
    """Reinterpret int32 bits as a float32."""
    return np.int32(bits).view(np.float32)


@scalar_function
def bits_of_float(value: Any) -> Any:
    """Reinterpret a float32 as its int32 bits."""
    return np.float32(value).view(np.int32)


def cast_like(value: float, like: float) -> float:
    """Return `value` in the floating-point type of `like`; in compiled code it costs nothing.

    A literal is float64 to the compiler and would pull single-precision arithmetic up with it.
    """
    cast: float = np.asarray(like).dtype.type(value)
    return cast


@specialise(cast_like)
def _cast_like(value: types.Type, like: types.Type) -> Callable[..., Any]:
    target = like if isinstance(like, types.Float) else float32
    return lambda value, like: target(value)


@scalar_function
def _newton(square: float) -> tuple[float, float, float]:
    """Estimates of the reciprocal root and of the root of a number, and the factor that refines both."""
    estimate = reciprocal_root(square)
    root = square * estimate
    return estimate, root, cast_like(1.5, square) + root * (cast_like(-0.5, square) * estimate)


@scalar_function
def fast_norm_and_inverse(x: float, y: float) -> tuple[float, float]:
    """Length of a vector and its reciprocal, by Newton's step from an estimate, to 2e-7; of zero, 1e-15 and 1e15."""
    square = x * x + (y * y + cast_like(1e-30, x))
    estimate, norm, step = _newton(square)
    return norm * step, estimate * step


@scalar_function
def fast_length(x: float, y: float, z: float) -> float:
    """Length of a vector of three, as of `fast_norm_and_inverse`."""
    square = x * x + (y * y + (z * z + cast_like(1e-30, x)))
    norm: float
    step: float
    _, norm, step = _newton(square)
    return norm * step


@scalar_function
def fast_norm(x: float, y: float) -> float:
    """Length of a vector, as of `fast_norm_and_inverse`."""
    norm: float
    norm, _ = fast_norm_and_inverse(x, y)
    return norm
