"""Settings of the whole suite; `--robot ROBOT.toml` runs the protocol's conformance suite on a robot instead of it."""

import fcntl
import gc
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis.internal.conjecture import providers
from xdist.scheduler import LoadScopeScheduling

# The machine's load is not a property of the code: no example fails for being slow. A change is judged on the same
# examples every time; `make fuzz` looks for new ones.
settings.register_profile("project", deadline=None, print_blob=True, derandomize=True)
settings.register_profile("search", deadline=None, print_blob=True)
settings.load_profile("project")

# Nothing that is imported or collected is garbage: to look for it meanwhile takes a fifth of that time.
gc.disable()

ROBOT_TESTS = Path(__file__).parent / "robot"
REAL_TIME = ("tests/hil/", "tests/firmware_protocol/emulated/")
# What does not drive may run beside what does.
STANDING = tuple(f"tests/hil/test_{name}.py" for name in ("check", "held_up", "path", "waiting"))
TESTS = Path(__file__).parent
# With `--dist each` a worker reads and runs only its own folders, as reading all tests takes as long as a tenth of them
# does to run. The first has the stacks in real time; all take about equally long.
PARTS = (
    ("hil", "firmware_protocol/emulated"),
    ("gap",),
    ("log",),
    ("drivers", "effects"),
    ("runtime", "adaptation"),
    ("control", "estimation", "tasks"),
    ("inference", "viewer"),
    ("daemon", "model", "sim"),
    ("cli", "drive", "experiments", "first_use"),
)
# These run while the kernels that the others share are being compiled.
WITHOUT_KERNELS = (
    *("bridge", "cli", "config", "daemon", "drivers", "estimation", "fence", "files", "firmware_protocol", "jit"),
    *("log", "processes", "reports", "viewer", "test_architecture.py", "test_docs.py", "test_public.py"),
)
# Files of these folders that need kernels after all, as running each folder with an empty cache of them shows.
WITH_KERNELS = (
    *("daemon/test_warm_up.py", "drivers/pose/test_nmea.py", "log/importing/test_candump.py"),
    *("viewer/test_replay_state.py", "viewer/test_uncertainty.py"),
)


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    if config.getvalue("dist") == "each":
        if len(config.getvalue("tx")) != len(PARTS) + 1:
            raise pytest.UsageError(f"--dist each: the tests have {len(PARTS) + 1} parts; give -n {len(PARTS) + 1}")
        config.pluginmanager.register(PartsOfTests())
    if lock := getattr(config, "workerinput", {}).get("kernels_lock"):
        config.pluginmanager.register(KernelsFirst(lock))
    if settings().derandomize:
        # Examples take constants from what a process has imported so far, which is chance on several workers.
        assert callable(providers._get_local_constants)
        providers._get_local_constants = lambda: providers._local_constants


class PartsOfTests:
    """Gives each worker its part, has the kernels compiled, and says how many tests were left out of all parts."""

    def __init__(self):
        self.collected = self.left_out = 0
        self.session = None
        # The compiler inherits the lock, and gives it back by ending.
        lock, self.kernels_lock = tempfile.mkstemp(prefix="kernels")
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = [sys.executable, "-m", "tools.compile_kernels"]
        self.compiler = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, pass_fds=[lock])
        os.close(lock)

    def pytest_sessionstart(self, session):
        self.session = session

    def pytest_sessionfinish(self):
        os.unlink(self.kernels_lock)
        _, errors = self.compiler.communicate()
        if self.compiler.returncode != 0:
            pytest.exit(f"tools.compile_kernels failed: {errors}", self.compiler.returncode)

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node):
        node.workerinput["part"] = int(node.workerinput["workerid"].removeprefix("gw"))
        node.workerinput["kernels_lock"] = self.kernels_lock

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node, ids):
        self.collected += len(ids)

    def pytest_runtest_logstart(self):
        # xdist takes the last worker's for all.
        self.session.testscollected = self.collected

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        self.left_out += getattr(node, "workeroutput", {}).get("left_out", 0)

    def pytest_terminal_summary(self, terminalreporter):
        what = "more cases of the same rules, closed loops, studies, clusters and the page in a browser"
        terminalreporter.write_line(f"make test-all also runs {self.left_out} tests: {what}.")


class KernelsFirst:
    """Holds up the first test that may need a kernel until all are compiled, as each worker would compile its own."""

    def __init__(self, lock):
        self.lock = lock

    @pytest.hookimpl(hookwrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item):
        # Around the time limits of tests, in which nothing is waited for.
        if self.lock and not is_without_kernels(item.path):
            with open(self.lock) as lock:
                fcntl.flock(lock, fcntl.LOCK_SH)
            self.lock = None
        yield


class FilesToWorkers(LoadScopeScheduling):
    """Gives each worker whole files, for what their tests share, and one worker all stacks with real-time priority.

    Side by side these would take the processors from each other. (`--dist loadgroup` does nothing with pytest 9.2.)
    """

    def _split_scope(self, nodeid: str) -> str:
        drives = nodeid.startswith(REAL_TIME) and not nodeid.startswith(STANDING)
        return REAL_TIME[0] if drives else nodeid.split("::", 1)[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    return FilesToWorkers(config, log) if config.getvalue("dist") == "loadscope" else None


def is_within(path, places):
    """Whether a path is one of some files and folders of the tests, or in one of them."""
    return any(path.is_relative_to(TESTS / place) for place in places)


def is_in_part(path, part):
    """Whether a file or folder belongs to a part of the tests, or has what does."""
    if not path.is_relative_to(TESTS) or path == TESTS:
        return True
    within = [at for at, folders in enumerate(PARTS) if is_within(path, folders)]
    has = [at for at, folders in enumerate(PARTS) if any((TESTS / folder).is_relative_to(path) for folder in folders)]
    return part in within if within else part in (*has, len(PARTS))


def is_without_kernels(path):
    return is_within(path, WITHOUT_KERNELS) and not is_within(path, WITH_KERNELS)


def pytest_ignore_collect(collection_path, config):
    """With a robot only its tests are run, without one all others; a worker with a part has no other."""
    part = getattr(config, "workerinput", {}).get("part")
    if part is not None and not is_in_part(collection_path, part):
        return True
    of_robot = collection_path == ROBOT_TESTS or ROBOT_TESTS in collection_path.parents
    on_the_way = collection_path in ROBOT_TESTS.parents
    if of_robot or not on_the_way:
        return of_robot != bool(config.getoption("--robot")) or None
    return None


def pytest_collection_finish():
    # What has been imported stays: no collection of garbage has to look through it again.
    gc.freeze()
    # What tests leave is little: looking for it seldom costs no memory that counts.
    gc.set_threshold(50_000, 10, 10)
    gc.enable()


def pytest_deselected(items):
    output = getattr(items[0].config, "workeroutput", {}) if items else {}
    output["left_out"] = output.get("left_out", 0) + len(items)


def pytest_collection_modifyitems(config, items):
    # The stacks in real time take longest, so they begin first.
    items.sort(key=lambda item: (not item.nodeid.startswith(REAL_TIME), not is_without_kernels(item.path)))
    if not config.getoption("--robot"):
        return
    skip_motion = pytest.mark.skip(reason="turns the wheels; lift them off the ground and give --allow-motion")
    skip_restart = pytest.mark.skip(reason="restarts the controller; give --allow-restart or --allow-restart=COMMAND")
    for item in items:
        if item.get_closest_marker("motion") and not config.getoption("--allow-motion"):
            item.add_marker(skip_motion)
        if item.get_closest_marker("restart") and config.getoption("--allow-restart") is None:
            item.add_marker(skip_restart)
