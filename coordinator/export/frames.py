"""Tables of a run as pandas DataFrames: one row a sample, or one row an instant with a column a signal.

Columns carry their units. `t_s` is the time since the recording began, on which all modules agree.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coordinator.export.exported_run import ExportedRun, check_package
from coordinator.export.instants import at_instants
from coordinator.synchronisation.signals import Signals
from module_agent.wire.feedback_rows import STATE_NAMES

if TYPE_CHECKING:
    from pandas import DataFrame


def samples_frame(run: ExportedRun) -> "DataFrame":
    """Return a row for each sample of each module, in the order of time, as it was measured.

    Columns are `t_s`, `module` and those of `Signals`, vectors as `gyro_x_rad_s` and so on; states are words.

    Raises:
        MissingPackage: pandas is not installed.
    """
    check_package("pandas", "a DataFrame")
    # Imported on use, as every large package that not all commands need.
    import pandas as pd

    parts = []
    for serial, signals in run.signals.items():
        columns: dict[str, object] = {"t_s": signals.t_s, "module": np.full(len(signals.t_s), serial)}
        columns |= {name: values for name, values in _columns(signals) if name != "t_s"}
        columns["state"] = state_names(signals)
        parts.append(pd.DataFrame(columns))
    whole = pd.concat(parts, ignore_index=True).sort_values("t_s", kind="stable", ignore_index=True)
    return whole.astype({"module": "category", "state": "category"})


def instants_frame(run: ExportedRun, rate_hz: float) -> "DataFrame":
    """Return a row for each of `rate_hz` instants a second, all modules interpolated; see `at_instants`.

    Columns are `t_s` and, for example, `elbow.position_rad`.

    Raises:
        MissingPackage: pandas is not installed.
        UsageError: there is no such rate.
    """
    check_package("pandas", "a DataFrame")
    import pandas as pd

    instants = at_instants(run.signals, rate_hz)
    columns: dict[str, object] = {"t_s": instants.t_s}
    for serial, signals in instants.signals.items():
        named = [(name, values) for name, values in _columns(signals) if name not in ("t_s", "imu_t_s")]
        columns |= {f"{serial}.{name}": values for name, values in named}
        known = ~np.isnan(signals.position_rad)
        # What counts or names has no NaN; where nothing is known it is not 0.
        columns[f"{serial}.motion_id"] = pd.Series(signals.motion_id, dtype="Int64").where(known)
        columns[f"{serial}.state"] = pd.Series(state_names(signals), dtype=object).where(known)
    return pd.DataFrame(columns)


def state_names(signals: Signals) -> Sequence[str]:
    """Return the state at each sample as a word; of a number that this version does not know, the number."""
    known = dict(enumerate(STATE_NAMES))
    return [known.get(number, str(number)) for number in signals.state.tolist()]


def _columns(signals: Signals) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield names and values (m,) of all signals but the state; of vectors `gyro_x_rad_s` and so on."""
    for name, values in zip(signals._fields, signals, strict=True):
        if values.ndim == 2:
            quantity, _, unit = name.partition("_")
            yield from ((f"{quantity}_{axis}_{unit}", values[:, k]) for k, axis in enumerate("xyz"))
        elif name != "state":
            yield name, values
