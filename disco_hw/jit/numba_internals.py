"""Use of numba's internals to compile kernels; nothing else in this project uses them.

What kernels call is put into them as it was lowered, and optimised there alone (`KernelCompiler`). Left to itself numba
makes of every function that a kernel calls a library of its own: two wrappers that unbox its arguments, an optimised
module and machine code, with all that it calls in it, which nobody ever runs.

`tests/jit/test_numba_internals.py` names each internal that is relied on, and says what to do when a numba lacks it.
What each trick gains is in docs/results.md: of 13 s of processor time that
the shipped robot's planner takes to compile, lowering functions only saves 17 s more, the garbage collector 2.5 s,
numba's own overloads 1.4 s, its timers 1 s.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from typing import Any

from numba import jit, njit
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.event import trigger_event
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.target_extension import CPU, jit_registry


class _CalleeLibrary(JITCodeLibrary):
    """A lowered function that others take in. It is never optimised nor made machine code by itself."""

    def finalize(self) -> None:
        self._raise_if_finalized()  # type: ignore[no-untyped-call]
        self._finalized = True

    @cached_property
    def callee_module(self) -> Any:
        """Module of the function without what it calls, to be linked any number of times."""
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage.name == "external":
                function.linkage = "linkonce_odr"
        return self._final_module

    def _get_module_for_linking(self) -> Any:
        """Return the module with all that it calls, for functions that numba's own library holds."""
        if self._shared_module is None:
            linked = self.callee_module.clone()
            for library in _called_by(self):
                linked.link_in(_module_of(library), preserve=True)
            self._shared_module = linked
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
    return library.callee_module if isinstance(library, _CalleeLibrary) else library._get_module_for_linking()


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
        """Compile as the base class does, with an entry point that stands for the function and is never called."""
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
        """Compile as the base class does, without the garbage collector, and with numba's overloads lowered only."""
        with _nothing_collected(), _overloads_recorded():
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
def _overloads_recorded() -> Iterator[None]:
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
        """Call the function's compiled twin."""
        return self._twin(*arguments, **named)
