"""Trials on a Dask cluster: the workers of several machines, each of which has this project installed."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from module_agent.model.errors import UsageError
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trial

CONNECT_S = 10.0
# Between looks whether a trial has ended.
LOOK_S = 0.05


def run_trials_on(
    address: str, trials: Sequence[Trial], on_done: Callable[[int, Any], None] = lambda index, result: None
) -> list[Any]:
    """Run trials on the cluster of a Dask scheduler and return their results in order.

    `on_done` receives index and result of each as it ends. A trial that raises, or whose workers the cluster
    loses again and again, gives `Failed`, and so do all that are left when none has ended within the longest
    of their `limit_s`.

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
        limit_s = max((trial.limit_s for trial in trials), default=0.0)

        def end(future: Any, result: Any) -> None:
            index = place.pop(future.key)
            results[index] = result
            on_done(index, result)

        ended, last_s = as_completed(futures), time.monotonic()  # type: ignore[no-untyped-call]
        while place and time.monotonic() - last_s <= limit_s:
            if not ended.has_ready():  # type: ignore[no-untyped-call]
                time.sleep(LOOK_S)
                continue
            future, last_s = next(ended), time.monotonic()
            if future.status == "finished":
                end(future, future.result())
            else:
                end(future, Failed(f"the cluster at {address} lost it: {future.exception()}", "died"))
        for future in futures:
            if future.key in place:
                future.cancel()  # type: ignore[no-untyped-call]
                text = f"it hangs: nothing had ended for {limit_s:g} s on the cluster at {address}"
                end(future, Failed(text, "hung"))
        return results
