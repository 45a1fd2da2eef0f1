"""Machine code on disk is loaded only from a directory of this user's own: a planted pickle is not run."""

import math
import multiprocessing
import os
import pickle
import runpy
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import pytest

from drivers.kernel_cache import _Index, compiled

NOBODY = 65534
KERNELS = {
    "plant": "from drivers.kernel_cache import compiled as compile_kernel",
    "model": "from disco_hw.jit import kernel_function as compile_kernel",
}
SOURCE = """
import sys
{imported}

@compile_kernel
def twice(value):
    return 2.0 * value

if __name__ == "__main__":
    print(twice(float(sys.argv[1])), dict(twice.stats.cache_hits) != {{}})
"""


class Bomb:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return open, (str(self.marker), "w")


@pytest.fixture
def script(request, tmp_path):
    path = tmp_path / "code" / "kernel.py"
    path.parent.mkdir()
    path.write_text(SOURCE.format(imported=KERNELS[getattr(request, "param", "plant")]), encoding="utf-8")
    return path


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def marker(script, cache, tmp_path):
    """The file that appears when what was planted in place of the kernel in the cache is loaded."""
    run(script, cache)
    plant(cache, tmp_path / "ran")
    return tmp_path / "ran"


# Processes forked from one that has imported what is large, as each test needs several.
FORKED = multiprocessing.get_context("forkserver")
FORKED.set_forkserver_preload(["disco_hw.jit", "drivers.kernel_cache"])


def run_script(script, out, **environment):
    """Be a process of Python with this environment, which runs the script."""
    os.environ.update(environment)
    os.environ.pop("XDG_CACHE_HOME", None)
    numba.config.reload_config()
    for name in ("stdout", "stderr"):
        setattr(sys, name, (out / name).open("w", encoding="utf-8"))
    sys.argv = [str(script), "21"]
    runpy.run_path(str(script), run_name="__main__")
    sys.stdout.flush()
    sys.stderr.flush()


def run(script, cache):
    out = script.parents[1]
    environment = {"NUMBA_CACHE_DIR": str(cache or ""), "HOME": str(out)}
    process = FORKED.Process(target=run_script, args=(script, out), kwargs=environment)
    process.start()
    process.join(120.0)
    stdout, stderr = ((out / name).read_text(encoding="utf-8") for name in ("stdout", "stderr"))
    assert process.exitcode == 0, stderr
    value, loaded = stdout.split()
    assert value == "42.0"
    return loaded == "True", stderr


def plant(cache, marker):
    (index,) = Path(cache).rglob("*twice*.nbi")
    index.write_bytes(pickle.dumps(Bomb(marker)))


def test_a_kernel_is_loaded_from_a_directory_of_ones_own(script, cache):
    assert run(script, cache) == (False, "")
    assert {path.stat().st_mode & 0o777 for path in cache.iterdir()} == {0o700}
    assert run(script, cache) == (True, "")


def test_what_another_version_kept_there_is_compiled_anew(script, cache):
    run(script, cache)
    (index,) = cache.rglob("*twice*.nbi")
    version = pickle.loads(index.read_bytes())
    assert version == numba.__version__
    # A type that has moved: what a model's coefficients are, say.
    index.write_bytes(pickle.dumps(version) + b"cdisco_hw.gone\nEffects\n.")
    assert run(script, cache) == (False, "")
    assert run(script, cache) == (True, "")


def test_a_planted_pickle_would_run_if_it_were_loaded(script, cache, marker):
    # What shows that the other tests can fail: in a directory of one's own numba loads what it finds.
    run(script, cache)
    assert marker.exists()


@pytest.mark.parametrize("script", KERNELS, indirect=True)
@pytest.mark.parametrize("opened", ["the directory named", "the directory of the module"])
def test_a_pickle_in_a_directory_that_others_can_write_to_is_not_run(script, cache, marker, opened):
    place = cache if opened == "the directory named" else next(cache.iterdir())
    place.chmod(0o777)
    loaded, reported = run(script, cache)
    assert not loaded
    assert reported == f"disco-hw: {place}: others can write to it; kernels there are not loaded but compiled again\n"
    assert not marker.exists()
    # It is kept in the next directory, which is this user's alone.
    assert run(script, cache)[0]
    assert not marker.exists()


def test_a_pickle_that_others_can_write_is_not_run_though_its_directory_is_ones_own(script, cache, marker):
    next(cache.rglob("*.nbi")).chmod(0o666)
    assert "not loaded but compiled again" in run(script, cache)[1]
    assert not marker.exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to give a directory to another user")
def test_a_pickle_of_another_user_is_not_run(script, cache, marker):
    for path in (next(cache.rglob("*.nbi")), next(cache.iterdir())):
        os.chown(path, NOBODY, NOBODY)
        loaded, reported = run(script, cache)
        assert not loaded or path.is_dir()
        assert f"{path}: belongs to nobody (65534)" in reported
        assert not marker.exists()
        os.chown(path, 0, 0)


def test_a_pickle_beside_the_source_is_not_run_either_and_where_none_is_private_nothing_is_kept(script, tmp_path):
    marker, beside = tmp_path / "ran", script.parent / "__pycache__"
    run(script, None)
    plant(beside, marker)
    beside.chmod(0o777)
    assert str(beside) in run(script, None)[1]
    (module,) = (tmp_path / ".cache" / "numba").iterdir()
    module.chmod(0o777)
    loaded, reported = run(script, None)
    assert not loaded
    assert "kernels are compiled again in each process" in reported
    assert not marker.exists()


def _hypotenuse(a, b):
    return math.sqrt(a * a + b * b)


def test_a_compiled_function_computes_what_its_source_says_and_is_compiled():
    fast = compiled(_hypotenuse)
    assert fast(3.0, 4.0) == 5.0
    assert fast.py_func is _hypotenuse
    assert len(fast.signatures) == 1


def test_forms_that_several_processes_save_at_a_time_get_a_file_each_and_none_is_forgotten(tmp_path):
    together = threading.Barrier(8)

    def save(form):
        together.wait()
        _Index(str(tmp_path), "kernel", "stamp").save(form, form * 1000)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(save, "abcdefgh"))
    assert [_Index(str(tmp_path), "kernel", "stamp").load(form) for form in "abcdefgh"] == [
        form * 1000 for form in "abcdefgh"
    ]
