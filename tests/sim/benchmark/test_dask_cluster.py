"""A Dask cluster returns what worker processes return."""

import math
import os
import socket
import time
from collections.abc import Iterator

import pytest

from module_agent.model.errors import UsageError
from sim.benchmark.case import Failed, Trial
from sim.benchmark.dask_cluster import run_trials_on

dask, distributed = (pytest.importorskip(name) for name in ("dask", "distributed"))


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with one worker, in threads of this process, on loopback."""
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(host="127.0.0.1", protocol="tcp", **options) as cluster:
        yield cluster.scheduler_address


def test_results_come_in_the_order_of_the_trials_and_what_raises_is_named(address: str) -> None:
    done: dict[int, object] = {}
    trials = [Trial(math.factorial, (n,)) for n in range(5)] + [Trial(math.sqrt, (-1.0,))]
    results = run_trials_on(address, trials, done.__setitem__)
    assert results[:5] == [math.factorial(n) for n in range(5)]
    assert isinstance(results[5], Failed)
    assert "ValueError" in results[5].text
    assert done == dict(enumerate(results))


def test_what_is_left_is_given_up_when_nothing_ends_any_more(address: str) -> None:
    done: dict[int, object] = {}
    trials = [Trial(math.sqrt, (4.0,), limit_s=0.5), Trial(time.sleep, (3.0,), limit_s=0.5)]
    results = run_trials_on(address, trials, done.__setitem__)
    text = f"it hangs: nothing had ended for 0.5 s on the cluster at {address}"
    assert results == [2.0, Failed(text, "hung")]
    assert done == dict(enumerate(results))


def test_a_trial_whose_worker_dies_has_died() -> None:
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(host="127.0.0.1", protocol="tcp", **options) as cluster,
    ):
        # os._exit ends a process as a crash does: nothing is said.
        (result,) = run_trials_on(cluster.scheduler_address, [Trial(os._exit, (7,))])
    assert isinstance(result, Failed)
    assert result.how == "died"


def test_an_address_without_a_scheduler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.benchmark.dask_cluster.CONNECT_S", 0.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        with pytest.raises(UsageError, match=f"{port}: no Dask scheduler answers there"):
            run_trials_on(f"tcp://127.0.0.1:{port}", [Trial(math.sqrt, (4.0,))])
    with pytest.raises(UsageError, match="no Dask scheduler"):
        run_trials_on("nonsense", [])
