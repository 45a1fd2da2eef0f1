"""Tests of compiled kernels: what the compiling process runs is what later ones load."""

import gc
import os
import re
import subprocess
import sys

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba import config, float32, njit
from numba.core.target_extension import CPU, jit_registry

from disco_hw import jit
from disco_hw.jit import block_function, fast_norm_and_inverse, kernel_function, tune_loops

PLANS = """
from pathlib import Path

import disco_hw
from disco_hw.tasks.circle import CircleCost
from disco_hw.control import Disco, DiscoSettings, PlannerState, CommandLimits
from disco_hw.model import load_model

model = load_model(Path(disco_hw.__file__).parent / "robots" / "wombot_model.toml")
disco = Disco(model, CircleCost(), DiscoSettings(), CommandLimits(6.4))
for number in range(5):
    plan = disco.plan(number * 100_000_000, PlannerState(number * 100_000_000, 0.75, 0.02 * number, 1.5, 2.3, 4.2))
print(disco.optimiser.work.point_costs.tobytes().hex(), plan.wheel_speeds.tobytes().hex())
"""


@block_function
def double(values):
    tune_loops()
    for i in range(values.size):
        values[i] *= 2.0


def calls_double_twice(values):
    double(values)
    double(values)


def calls_double(values):
    double(values)


def test_no_other_copy_of_what_a_kernel_calls_is_ever_linked(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    kernel = kernel_function(calls_double_twice)
    values = np.ones(3)
    kernel(values)
    np.testing.assert_array_equal(values, 4.0)
    (signature,), (called,) = kernel.signatures, double.overloads.values()
    code = kernel.overloads[signature].library.get_llvm_str()
    defined = [line for line in code.splitlines() if line.startswith("define") and called.fndesc.mangled_name in line]
    assert defined
    assert all(line.startswith("define private") for line in defined)


def test_what_a_kernel_calls_can_be_called_from_elsewhere_too(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    values = np.ones(3)
    kernel_function(calls_double_twice)(values)
    njit(calls_double)(values)
    double(values)
    np.testing.assert_array_equal(values, 16.0)


def test_what_a_kernel_calls_is_lowered_and_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    collecting, jit_of_overloads = gc.isenabled(), jit_registry[CPU]
    kernel_function(calls_double_twice)(np.ones(3))
    (called,) = double.overloads.values()
    code = str(called.library._get_module_for_linking())
    assert called.fndesc.llvm_func_name in code
    assert called.fndesc.llvm_cpython_wrapper_name not in code
    assert called.fndesc.llvm_cfunc_wrapper_name not in code
    assert (gc.isenabled(), jit_registry[CPU]) == (collecting, jit_of_overloads)


@pytest.mark.long
def test_plans_are_the_same_bits_from_the_process_that_compiles_as_from_one_that_loads(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    compiled, loaded = (
        subprocess.run([sys.executable, "-c", PLANS], env=environment, check=True, capture_output=True, text=True)
        for _ in range(2)
    )
    assert compiled.stdout == loaded.stdout
    assert compiled.stdout.strip()


def inverse_lengths(x, y, found):
    tune_loops()
    for i in range(x.size):
        found[i] = fast_norm_and_inverse(x[i], y[i])[1]


def test_inverse_lengths_are_good_to_single_precision():
    x, y = np.random.default_rng(1).uniform(-5.0, 5.0, (2, 1000)).astype(np.float32)
    found = np.empty_like(x)
    block_function(inverse_lengths)(x, y, found)
    np.testing.assert_allclose(found, 1.0 / np.hypot(x.astype(float), y), rtol=3e-7)


FOUR_ROOTS = """
define <4 x float> @f(<4 x float> %x) #0 {
  %root = call <4 x float> @llvm.sqrt.v4f32(<4 x float> %x)
  %inverse = fdiv arcp <4 x float> <float 1.0, float 1.0, float 1.0, float 1.0>, %root
  ret <4 x float> %inverse
}
declare <4 x float> @llvm.sqrt.v4f32(<4 x float>)
attributes #0 = { ESTIMATES }
"""


@pytest.mark.parametrize(
    ("machine", "triple", "processor", "expected"),
    [
        ("aarch64", "aarch64-unknown-linux-gnu", "cortex-a72", ["frsqrte", "frsqrts"]),
        ("x86_64", "x86_64-unknown-linux-gnu", "x86-64-v3", ["vrsqrtps"]),
    ],
)
def test_each_processor_estimates_reciprocal_roots_in_its_own_way(monkeypatch, machine, triple, processor, expected):
    monkeypatch.setattr(jit.platform, "machine", lambda: machine)
    function = block_function(inverse_lengths)
    row = float32[::1]
    function.compile((row, row, row))
    (lowered,) = function.overloads.values()
    (estimates,) = set(re.findall(r'"reciprocal-estimates"="[^"]*"', str(lowered.library._get_module_for_linking())))
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple).create_target_machine(cpu=processor, opt=3)
    code = target.emit_assembly(llvm.parse_assembly(FOUR_ROOTS.replace("ESTIMATES", estimates)))
    assert re.findall(r"\bv?f?r?sqrt[a-z]*", code) == expected
    assert "div" not in code
