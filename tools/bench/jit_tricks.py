"""`python -m tools.bench.jit_tricks [REPEATS] [TRICK ...]`: what each trick of disco_hw/jit gains.

Each trick is undone in a process of its own, here and not in the product, which then prepares the shipped robot's
planner twice: with an empty directory of compiled kernels, and with what the first has left. Printed are the least
processor times of some repeats in turns (s), and the least and median time of a refined and of a sampled plan (us).
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

ROOT = Path(__file__).parents[2]
PLANS, REPEATS = 500, 3


@contextmanager
def _nothing(*_: object) -> Iterator[None]:
    yield


def internals() -> Any:
    """Return numba_internals.py, loaded before disco_hw.jit, which compiles with it when it is imported."""
    name = "disco_hw.jit.numba_internals"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / "disco_hw" / "jit" / "numba_internals.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


def numbas_own_libraries() -> None:
    """Each function that a kernel calls is a library of its own, optimised and made machine code, as numba does it."""
    module = internals()
    module.Callee = lambda function, targetoptions: njit(**targetoptions)(function)
    module.KernelCompiler = module.CalleeCompiler = Compiler


def undo(name: str, replacement: object = _nothing) -> Callable[[], None]:
    """Return what replaces a name of numba_internals.py, by a context that does nothing unless said."""
    return lambda: setattr(internals(), name, replacement)


def numbas_own_compile() -> None:
    """`Callee.compile` is the base class's, with its timers."""
    internals().Callee.compile = CPUDispatcher.compile


def tuned(vectors: bool = True, roots: bool = True, own: bool = True, disjoint: bool = True) -> Callable[[], None]:
    """Return what replaces `tune_loops` by a form without one of its parts."""

    def replace() -> None:
        internals()
        from disco_hw import jit  # noqa: PLC0415 only now, as what it compiles with is replaced before

        @intrinsic  # type: ignore[untyped-decorator]
        def tune_loops(_context: Any) -> Any:
            def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
                found = builder.function.attributes
                if vectors:
                    set.add(found, '"prefer-vector-width"="512"')
                if roots:
                    set.add(found, f'"reciprocal-estimates"="{jit.ROOT_ESTIMATES[platform.machine()]}"')
                if own:
                    found.add("noinline")
                for argument in builder.function.args if disjoint else ():
                    if isinstance(getattr(argument.type, "pointee", None), ir.FloatType):
                        argument.add_attribute("noalias")
                return context.get_dummy_value()

            return types.void(), generate

        jit.tune_loops = tune_loops

    return replace


def of_jit(**values: Any) -> Callable[[], None]:
    """Return what replaces names of disco_hw.jit."""

    def replace() -> None:
        internals()
        from disco_hw import jit  # noqa: PLC0415 only now, as what it compiles with is replaced before

        for name, value in values.items():
            setattr(jit, name, value)

    return replace


def exact_roots() -> None:
    """Roots and quotients are exact: no estimates at all."""
    internals()
    from disco_hw import jit  # noqa: PLC0415 only now, as what it compiles with is replaced before

    @intrinsic  # type: ignore[untyped-decorator]
    def reciprocal_root(_context: Any, value: Any) -> Any:
        def generate(_c: Any, builder: Any, _s: Any, arguments: Any) -> Any:
            kind = arguments[0].type
            root = builder.call(builder.module.declare_intrinsic("llvm.sqrt", [kind]), arguments)
            return builder.fdiv(ir.Constant(kind, 1.0), root)

        return value(value), generate

    # `_newton` was compiled with nothing yet: it takes its name from the module when it is first called.
    jit.reciprocal_root = reciprocal_root


def inlining() -> None:
    """No function is asked to be put into its callers: the optimiser decides."""
    internals()
    from disco_hw import jit  # noqa: PLC0415 only now, as what it compiles with is replaced before

    jit.INLINED["forceinline"] = False


def no_fast_math() -> None:
    """Neither fused products nor signless zeros."""
    internals()
    from disco_hw import jit  # noqa: PLC0415 only now, as what it compiles with is replaced before

    jit.FAST_MATH.clear()


TRICKS: dict[str, Callable[[], None]] = {
    "nothing": lambda: None,
    "functions lowered only": numbas_own_libraries,
    "private copies in a kernel": undo("_KernelLibrary", JITCodeLibrary),
    "overloads lowered only": undo("_overloads_recorded"),
    "no garbage collection": undo("_nothing_collected"),
    "no timers": numbas_own_compile,
    "forced inlining": inlining,
    "fast-math flags": no_fast_math,
    "vectors of 512 bits": tuned(vectors=False),
    "estimates of roots": tuned(roots=False),
    "estimates and Newton's step": exact_roots,
    "loops in functions of their own": tuned(own=False),
    "arrays that do not overlap": tuned(disjoint=False),
    "types known at the call": of_jit(compiled_for=lambda kernel, *arguments: kernel),
}


def measure(trick: str) -> dict[str, float]:
    """Processor time to prepare the planner (s), and times of plans (us), in this process without one trick."""
    TRICKS[trick]()
    from disco_hw.config import SHIPPED_ROBOT  # noqa: PLC0415 after the trick is undone
    from disco_hw.control import PlannerState  # noqa: PLC0415 after the trick is undone
    from disco_hw.runtime.assembly import create_planner  # noqa: PLC0415 after the trick is undone
    from disco_hw.runtime.robot_setup import load_setup  # noqa: PLC0415 after the trick is undone

    setup = load_setup(SHIPPED_ROBOT)
    before_s = time.process_time()
    planner = create_planner(setup.config, setup.model)
    figures = {"ready_s": time.process_time() - before_s}
    control = msgspec.structs.replace(setup.config.control, mode="sampled")
    sampled = create_planner(msgspec.structs.replace(setup.config, control=control), setup.model)
    for name, each in (("refined", planner), ("sampled", sampled)):
        durations_us = np.empty(PLANS)
        for number in range(PLANS):
            state = PlannerState(number * 20_000_000, 0.75, 0.02 * (number % 5), 1.5, 2.3, 4.2)
            before = time.perf_counter()
            each.plan(state.t_ns, state)
            durations_us[number] = 1e6 * (time.perf_counter() - before)
        figures[f"{name}_least_us"], figures[f"{name}_p50_us"] = np.percentile(durations_us, (0.0, 50.0)).tolist()
    return figures


def run(repeats: int = REPEATS, names: tuple[str, ...] = tuple(TRICKS)) -> dict[str, float]:
    """The figures of every trick, the least of some repeats in turns."""
    figures: dict[str, float] = {}
    for _ in range(repeats):
        for name in names:
            with TemporaryDirectory() as kernels:
                for start in ("cold", "warm"):
                    for key, value in in_a_process(name, kernels).items():
                        if start == "warm" or key == "ready_s":
                            named = f"jit.{name}.{start if key == 'ready_s' else 'warm'}_{key}"
                            figures[named] = min(value, figures.get(named, value))
    return figures


def in_a_process(name: str, kernels: str) -> dict[str, float]:
    """Figures of `measure` in a new process that keeps its kernels in a directory."""
    command = [sys.executable, "-m", "tools.bench.jit_tricks", "--measure", name]
    environment = {**os.environ, "NUMBA_CACHE_DIR": kernels}
    result = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, env=environment)
    found: dict[str, float] = json.loads(result.stdout.splitlines()[-1])
    return found


def main(arguments: list[str]) -> None:
    """Print the figures of all tricks, or of those that are named."""
    if arguments[:1] == ["--measure"]:
        print(json.dumps(measure(arguments[1])))
        return
    names = tuple(arguments[1:]) or tuple(TRICKS)
    figures = run(int(arguments[0]) if arguments else REPEATS, names)
    print("| undone | cold, s | warm, s | refined plan, us | sampled plan, us |\n|---|---|---|---|---|")
    for name in names:
        cold, warm, *plans = (
            figures[f"jit.{name}.{key}"]
            for key in (
                "cold_ready_s", "warm_ready_s", "warm_refined_least_us", "warm_refined_p50_us",
                "warm_sampled_least_us", "warm_sampled_p50_us",
            )
        )  # fmt: skip
        least, median, sampled_least, sampled_median = (f"{plan:.0f}" for plan in plans)
        print(f"| {name} | {cold:.2f} | {warm:.2f} | {least} / {median} | {sampled_least} / {sampled_median} |")


if __name__ == "__main__":
    main(sys.argv[1:])
