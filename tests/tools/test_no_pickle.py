"""Nothing that this project reads can run code: no pickle is loaded anywhere, by whatever name.

But for the machine code of kernels, which numba keeps in pickles: tests/drivers/test_kernel_cache.py.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("disco_hw", "drivers", "firmware_protocol", "sim", "tools")
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
COMPILERS = {"njit", "jit", "vectorize", "guvectorize", "cfunc", "stencil"}
# Without one of these words a module has no offence, and need not be parsed.
SUSPECT = re.compile(r"pickle|dill|joblib|shelve|marshal|cache\s*=|caching|__import__|load\b")
CALLS = {"torch.load", "torch.jit.load", "pandas.read_pickle", "pd.read_pickle", "yaml.load"}


def offences(source):
    """What of a module's text loads, or could load, objects instead of data."""
    found = []
    for node in ast.walk(ast.parse(source)) if SUSPECT.search(source) else ():
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        found += [name for name in names if name.split(".")[0] in MODULES]
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if any(keyword.arg == "cache" for keyword in node.keywords) and called.split(".")[-1] in COMPILERS:
                found.append(f"{called}(cache=...), which drivers.kernel_cache does not look at")
            if called in CALLS or called == "__import__" or called.endswith(".enable_caching"):
                found.append(called)
            found += [
                f"{called}({keyword.arg}=...)"
                for keyword in node.keywords
                if keyword.arg == "allow_pickle" and not (
                    isinstance(keyword.value, ast.Constant) and keyword.value.value is False
                )
            ]  # fmt: skip
            if called in {"np.load", "numpy.load"} and not any(
                keyword.arg == "allow_pickle" for keyword in node.keywords
            ):
                found.append(f"{called} without allow_pickle=False")
    return found


def test_no_module_loads_objects():
    found = {str(path.relative_to(ROOT)): offences(path.read_text("utf-8")) for path in FILES}
    assert {path: what for path, what in found.items() if what} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import torch\ntorch.load('x')",
        "np.load('x')",
        "np.load('x', allow_pickle=True)",
        "np.load('x', allow_pickle=flag)",
        "def f():\n    import joblib.numpy_pickle",
        "@njit(cache=True)\ndef f(): pass",
        "numba.njit(nogil=True, cache=flag)(f)",
        "njit(f).enable_caching()",
    ],
)
def test_what_would_be_found(source):
    assert offences(source)


def test_what_is_data_is_let_be():
    assert not offences("import numpy as np\nnp.load('x', allow_pickle=False)\njson.loads('1')\ntree.eval()")
