"""The internals of numba that kernels are compiled with are as they were; a new numba is named before it is trusted."""

import inspect

import numba
import numpy as np
import pytest
from numba.core import codegen, compiler, target_extension
from numba.core.base import BaseContext
from numba.core.registry import CPUDispatcher, cpu_target

from disco_hw.jit import numba_internals

LAST_TRIED = (0, 68)
TO_DO = (
    "disco_hw/jit/numba_internals.py relies on it: run tests/jit, tests/control/kernel and "
    "`make bench PARTS=bench_control` with this numba, adapt that file, and write what holds here; "
    "until then keep numba below it in pyproject.toml"
)
MEMBERS = {
    codegen.CodeLibrary: ("_raise_if_finalized", "_ensure_finalized"),
    codegen.JITCodeLibrary: ("finalize", "enable_object_caching", "_get_module_for_linking"),
    BaseContext: ("insert_user_function", "get_dummy_value"),
    type(cpu_target.target_context): ("codegen",),
    CPUDispatcher: ("add_overload", "compile"),
    compiler.CompileResult: ("_replace", "entry_point", "fndesc", "library"),
}
PARAMETERS = {
    compiler.Compiler.__init__: ["self", "typingctx", "targetctx", "library", "args", "return_type", "flags", "locals"],
    compiler.Compiler.compile_extra: ["self", "func"],
    CPUDispatcher.__init__: ["self", "py_func", "locals", "targetoptions", "pipeline_class"],
}


def changed(version, members, parameters):
    """What of numba is not as it was, each with what to do."""
    series = tuple(int(number) for number in version.split(".")[:2])
    found = [] if series <= LAST_TRIED else [f"numba {version} is newer than any that was tried"]
    found += [
        f"numba {version}: {owner.__name__} has no {name}"
        for owner, names in members.items()
        for name in names
        if not hasattr(owner, name)
    ]
    for function, expected in parameters.items():
        takes = list(inspect.signature(function).parameters)
        if takes != expected:
            found.append(f"numba {version}: {function.__qualname__} takes {takes}, not {expected}")
    return [f"{what}. {TO_DO}" for what in found]


def test_numba_has_all_that_kernels_are_compiled_with():
    found = changed(numba.__version__, MEMBERS, PARAMETERS)
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("version", "members", "parameters", "expected_message"),
    [
        ("0.99.0", {}, {}, "numba 0.99.0 is newer than any that was tried. disco_hw/jit/numba_internals.py"),
        ("0.61.0", {BaseContext: ("gone",)}, {}, "numba 0.61.0: BaseContext has no gone. disco_hw/jit"),
        ("0.61.0", {}, {changed: ["version"]}, "changed takes ['version', 'members', 'parameters'], not ['version']"),
    ],
)
def test_what_a_new_numba_changes_is_named_with_what_to_do(version, members, parameters, expected_message):
    (found,) = changed(version, members, parameters)
    assert expected_message in found
    assert "pyproject.toml" in found


def test_each_library_has_the_fields_that_linking_reads():
    library = numba_internals._CalleeLibrary(cpu_target.target_context.codegen(), "callee")
    for name in ("_final_module", "_finalized", "_linking_libraries", "_reload_init", "_shared_module"):
        assert hasattr(library, name), f"numba {numba.__version__}: a code library has no {name}. {TO_DO}"


def test_numba_compiles_its_own_overloads_by_what_is_registered_for_the_processor():
    dispatcher = numba.njit(lambda: np.float32(1.0))
    for name in ("_compiling_counter", "_compiler", "targetoptions", "overloads"):
        assert hasattr(dispatcher, name), f"numba {numba.__version__}: a dispatcher has no {name}. {TO_DO}"
    assert target_extension.CPU in target_extension.jit_registry, TO_DO
