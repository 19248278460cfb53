"""What the tests of the study share."""

import pytest


@pytest.fixture(scope="session")
def threads():
    """The address of a Dask scheduler with two threads of this process, where no process is wanted."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield cluster.scheduler_address
