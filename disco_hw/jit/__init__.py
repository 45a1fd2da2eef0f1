"""How functions are compiled: one set of options, constants of the caller's precision, a cache key of all sources.

What kernels call is put into them as it was lowered, and optimised there alone (`KernelCompiler`). Left to itself numba
makes of every function that a kernel calls a library of its own: two wrappers that unbox its arguments, an optimised
module and machine code, with all that it calls in it, which nobody ever runs. Half of a kernel's compilation went
there.
"""

from __future__ import annotations

import gc
import hashlib
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property, partial
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import jit, njit, typeof, types
from numba.core.base import BaseContext
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.event import trigger_event
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.target_extension import CPU, jit_registry
from numba.core.typing.context import Context
from numba.core.typing.templates import Signature
from numba.extending import intrinsic, overload

from drivers.kernel_cache import kept_on_disk


class _CalleeLibrary(JITCodeLibrary):
    """A lowered function that others take in. It is never optimised nor made machine code by itself."""

    def finalize(self) -> None:
        self._raise_if_finalized()  # type: ignore[no-untyped-call]
        self._finalized = True

    @cached_property
    def own_module(self) -> Any:
        """Its module without what it calls, to be linked any number of times."""
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage.name == "external":
                function.linkage = "linkonce_odr"
        return self._final_module

    def _get_module_for_linking(self) -> Any:
        """The same with all that it calls, for functions that numba's own library holds."""
        if self._shared_module is None:
            whole = self.own_module.clone()
            for library in _called_by(self):
                whole.link_in(_module_of(library), preserve=True)
            self._shared_module = whole
        return self._shared_module


def _called_by(library: CodeLibrary) -> list[CodeLibrary]:
    """Libraries of all that a function calls, each once, behind all those that call it.

    In this order, as the linker leaves out what nothing has called so far.
    """
    seen: set[CodeLibrary] = {library}
    found: list[CodeLibrary] = []

    def visit(one: Any) -> None:
        for called in one._linking_libraries:
            if called not in seen:
                seen.add(called)
                if isinstance(called, _CalleeLibrary):
                    visit(called)
                found.append(called)

    visit(library)
    return found[::-1]


def _module_of(library: Any) -> Any:
    return library.own_module if isinstance(library, _CalleeLibrary) else library._get_module_for_linking()


class _KernelLibrary(JITCodeLibrary):
    """Machine code that calls nothing but what is in it.

    A process may hold other copies of the functions that a kernel calls. They differ in how sums of products are
    rounded, and the linker takes whichever came first, unless the kernel's own have no symbol. So a kernel gives the
    same bits in the process that compiled it as in one that loads it.
    """

    def finalize(self) -> None:
        called: set[str] = set()
        for library in _called_by(self):
            self._reload_init.update(library._reload_init)
            module = _module_of(library)
            called.update(function.name for function in module.functions)
            self._final_module.link_in(module, preserve=True)
        self._linking_libraries.clear()
        for function in self._final_module.functions:
            if function.name in called and not function.is_declaration:
                function.linkage = "private"
        super().finalize()  # type: ignore[no-untyped-call]


class CalleeCompiler(Compiler):
    """Stops at the lowered function."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, return_type: Any, flags: Any, *rest: Any):
        if library is None:
            library = _CalleeLibrary(target.codegen(), "callee")  # type: ignore[no-untyped-call]
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        super().__init__(typing, target, library, args, return_type, flags, *rest)  # type: ignore[no-untyped-call]

    def compile_extra(self, func: Callable[..., Any]) -> CompileResult:
        """As of the base class, with an entry point that stands for the function in callers, and is never called."""
        result: Any = super().compile_extra(func)  # type: ignore[no-untyped-call]
        # Any built-in method that is no other function's: numba takes nothing else.
        entry = [result.fndesc].index
        self.state.targetctx.insert_user_function(entry, result.fndesc, [result.library])
        standing_for: CompileResult = result._replace(entry_point=entry)
        return standing_for


class KernelCompiler(Compiler):
    """Compiles an entry point with all that it calls in it."""

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, return_type: Any, flags: Any, *rest: Any):
        if library is None:
            library = _KernelLibrary(target.codegen(), "kernel")  # type: ignore[no-untyped-call]
            library.enable_object_caching()
        flags.no_cfunc_wrapper = True
        super().__init__(typing, target, library, args, return_type, flags, *rest)  # type: ignore[no-untyped-call]

    def compile_extra(self, func: Callable[..., Any]) -> CompileResult:
        """As of the base class, with what numba does over again for every function done once."""
        with _nothing_collected(), _registries_loaded(self.state.targetctx), _overloads_taken_in():
            result: CompileResult = super().compile_extra(func)  # type: ignore[no-untyped-call]
            return result


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """Without the garbage collector, which would go through the compiler's many live objects again and again."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def _registries_loaded(target: Any) -> Iterator[None]:
    """Load numba's own registries now, and not again for each function: sixty imports, all of modules that are there.

    What functions register themselves meanwhile is found as before.
    """
    if "load_additional_registries" in vars(target):
        yield
        return
    target.load_additional_registries()
    target.load_additional_registries = lambda: None
    try:
        yield
    finally:
        del target.load_additional_registries


@contextmanager
def _overloads_taken_in() -> Iterator[None]:
    """Compile numba's own overloads, such as `min`, as what kernels call."""
    usual = jit_registry.pop(CPU)
    jit_registry[CPU] = partial(jit, pipeline_class=CalleeCompiler)
    try:
        yield
    finally:
        del jit_registry[CPU]
        jit_registry[CPU] = usual


class Callee(CPUDispatcher):
    """A function for kernels to call. From Python a twin of it is called, an entry point of its own."""

    _compiler: Any

    def __init__(self, py_func: Callable[..., Any], local_types: Any = None, targetoptions: Any = None) -> None:
        options = {"nopython": True, "boundscheck": None, **(targetoptions or {})}
        super().__init__(py_func, local_types, options, CalleeCompiler)

    def compile(self, sig: Any) -> Any:
        """Lower the function for these types, if that has not been done.

        As of the base class without its timers: each hears of everything that is compiled below it.
        """
        args, return_type = normalize_signature(sig)  # type: ignore[no-untyped-call]
        with global_compiler_lock, self._compiling_counter:
            found: Any = self.overloads.get(args)
            if found is None:
                details = {"dispatcher": self, "args": args, "return_type": return_type}
                with trigger_event("numba:compile", data=details):
                    found = self._compiler.compile(args, return_type)
                self.add_overload(found)
            return found.entry_point

    @cached_property
    def _twin(self) -> Callable[..., Any]:
        twin: Any = njit(pipeline_class=KernelCompiler)(self.py_func)
        twin.targetoptions.update(self.targetoptions)
        compiled: Callable[..., Any] = twin
        return compiled

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the twin."""
        return self._twin(*arguments, **named)


GROUP = "disco_hw.effects"


@cache
def plugin_modules() -> tuple[str, ...]:
    """Names of the modules, each with an `EFFECT` and its `term`, sorted."""
    return tuple(sorted({point.module for point in entry_points(group=GROUP)}))


def plugin_sources() -> tuple[Path, ...]:
    """Their files, for whoever keeps compiled code; raises ModuleNotFoundError for a module that is not there."""
    found = []
    for module in plugin_modules():
        spec = find_spec(module)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(f"{module}: named as an effect by an installed package, but not there")
        found.append(Path(spec.origin))
    return tuple(found)


# No `nnan`, `ninf` (non-finite costs must stay visible), no `reassoc` (sums keep their order, so a run replays), no
# `arcp` (a quotient by a root is exact but where `reciprocal_root` asks for an estimate).
FAST_MATH = {"contract", "nsz"}

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
    """The machine code of a kernel for arguments of these types, compiled or loaded if need be.

    Calling it spares working their types out in every call, which takes 10 us for nested tuples; it must only be called
    with arguments of the same types. Arrays of another kind are refused with a TypeError.
    """
    dispatcher: Any = kernel
    entry: Callable[..., Any] = dispatcher.compile(tuple(_typeof(argument) for argument in arguments))
    return entry


@_intrinsic
def tune_loops(_context: Context) -> tuple[Any, Callable[..., Any]]:
    """Let the loops of the calling function use the processor's widest vectors and its estimates of reciprocal roots.

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


@_intrinsic
def float_from_bits(_context: Context, _bits: types.Type) -> tuple[Any, Callable[..., Any]]:
    """Reinterpret int32 bits as a float32."""

    def generate(_c: BaseContext, builder: ir.IRBuilder, _s: Signature, arguments: list[ir.Value]) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@_intrinsic
def bits_of_float(_context: Context, _value: types.Type) -> tuple[Any, Callable[..., Any]]:
    """Reinterpret a float32 as its int32 bits."""

    def generate(_c: BaseContext, builder: ir.IRBuilder, _s: Signature, arguments: list[ir.Value]) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


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
def quick_norm_and_inverse(x: float, y: float) -> tuple[float, float]:
    """Length of a vector and its reciprocal, by Newton's step from an estimate, to 2e-7; of zero, 1e-15 and 1e15."""
    square = x * x + (y * y + cast_like(1e-30, x))
    estimate, norm, step = _newton(square)
    return norm * step, estimate * step


@scalar_function
def quick_length(x: float, y: float, z: float) -> float:
    """Length of a vector of three, as of `quick_norm_and_inverse`."""
    square = x * x + (y * y + (z * z + cast_like(1e-30, x)))
    norm: float
    step: float
    _, norm, step = _newton(square)
    return norm * step


@scalar_function
def quick_norm(x: float, y: float) -> float:
    """Length of a vector, as of `quick_norm_and_inverse`."""
    norm: float
    norm, _ = quick_norm_and_inverse(x, y)
    return norm
