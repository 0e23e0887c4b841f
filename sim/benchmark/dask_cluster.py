"""Trials on a Dask cluster: the workers of several machines, each of which has this project installed."""

from collections.abc import Callable, Sequence
from typing import Any

from module_agent.model.errors import UsageError
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trial

CONNECT_S = 10.0


def run_trials_on(
    address: str, trials: Sequence[Trial], on_done: Callable[[int, Any], None] = lambda index, result: None
) -> list[Any]:
    """Run trials on the cluster of a Dask scheduler and return their results in order.

    `on_done` receives index and result of each as it ends. A trial that raises, or whose workers the cluster
    loses again and again, gives `Failed`.

    Raises:
        UsageError: the library is not installed, or no scheduler is at the address.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise UsageError(f"--dask {address} needs Dask: pip install 'x5-self-model[dask]'") from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise UsageError(f"--dask {address}: no Dask scheduler answers there ({error})") from error
    with client, client.as_current():
        # Trials of the same arguments are run anew: nothing is kept on the cluster.
        futures = client.map(run_trial, list(trials), pure=False)
        place = {future.key: index for index, future in enumerate(futures)}
        results: list[Any] = [None] * len(trials)
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            index = place[future.key]
            if future.status == "finished":
                results[index] = future.result()
            else:
                results[index] = Failed(f"the cluster at {address} lost it: {future.exception()}")
            on_done(index, results[index])
        return results
