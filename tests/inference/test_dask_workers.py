import os
import re

import numpy as np
import pytest

from disco_hw.errors import InputError, WorkError
from disco_hw.inference import simulate as module
from disco_hw.inference.infer import InferOptions, infer
from disco_hw.inference.simulate import dask_workers
from tests.inference.drives import logged, robot_config

pytestmark = pytest.mark.long

distributed = pytest.importorskip("distributed")


def cluster_of(workers):
    return distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    )


@pytest.fixture(scope="module")
def address():
    with cluster_of(2) as cluster:
        cluster.wait_for_workers(2)
        yield cluster.scheduler_address


# Each process imports torch, which takes minutes on a machine that has much else to do.
@pytest.mark.timeout(600)
def test_a_cluster_of_two_processes_gives_what_one_process_gives(address):
    options = InferOptions(simulations=200, seed=3)
    with dask_workers(address) as workers:
        assert len(set(workers.map(lambda shared, item: os.getpid(), None, range(16))) - {os.getpid()}) == 2
        far = infer(logged("poor"), robot_config(), options, workers=workers)
    here = infer(logged("poor"), robot_config(), options)
    assert np.array_equal(far.draws, here.draws)
    assert np.array_equal(far.predictive.deviations, here.predictive.deviations)
    assert np.array_equal(far.calibration.ranks, here.calibration.ranks)


def test_workers_without_this_package_are_told_of(address):
    def lacking(shared, item):
        raise ModuleNotFoundError("No module named 'disco_hw'", name="disco_hw")

    with (
        pytest.raises(WorkError, match=r"--dask tcp://127\.0\.0\.1:\d+: a worker lacks disco_hw"),
        dask_workers(address) as workers,
    ):
        list(workers.map(lacking, None, range(2)))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_where_nothing_answers_one_line_says_so(monkeypatch, address):
    monkeypatch.setattr(module, "_CONNECT_TIMEOUT_S", 0.5)
    expected_error = f"^--dask {re.escape(address)}: no scheduler answers there .*8786$"
    with pytest.raises(InputError, match=expected_error), dask_workers(address):
        pass


def test_a_cluster_without_workers_is_refused():
    with (
        cluster_of(0) as cluster,
        pytest.raises(InputError, match="has no workers; start some with"),
        dask_workers(cluster.scheduler_address),
    ):
        pass


def test_without_dask_the_remedy_is_named(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(module, "import_module", absent)
    with (
        pytest.raises(InputError, match=r"dask is not installed; pip install 'disco-hw\[dask\]'"),
        dask_workers("tcp://127.0.0.1:8786"),
    ):
        pass
