"""Logs that HEBI's programs wrote (`.hebilog`), as tables of numbers."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.model.errors import UsageError

CLOCK = "hardware_transmit_time_us"


class HebiLogError(UsageError):
    """The file is no log of HEBI's programs, or lacks what is needed; the message names it."""


def read_tables(
    path: Path, fields: Sequence[str], load: Callable[[str], Any], module: int | None = None
) -> list[NDArray[np.float64]]:
    """Read feedback of the modules of a log, each what its own clock says it sent once, in its order.

    Args:
        path: the log.
        fields: names of hebi-py's feedback; a vector takes three columns.
        load: `hebi.util.load_log`, or what stands in for it: iterates over feedback by `feedback_iterate`.
        module: the place in the group, from 1 on, of the one module that is read; None for all.

    Returns:
        For each module (m, 1 + columns): its clock [us], and the fields; NaN where a value was not set.

    Raises:
        HebiLogError: it is no log, has no such module, or fewer than two samples of a module.
    """
    try:
        log = load(str(path))
    except OSError as error:
        raise HebiLogError(f"{path}: {error}") from error
    modules = log.number_of_modules
    if module is not None and not 1 <= module <= modules:
        raise HebiLogError(f"{path}: it has {modules} modules, no module {module}")
    chosen = range(modules) if module is None else [module - 1]
    # One array a message: of all modules, and all fields side by side.
    rows = [
        np.column_stack([np.reshape(getattr(fed, name), (modules, -1)) for name in (CLOCK, *fields)])
        for fed in log.feedback_iterate
    ]
    tables = []
    for index in chosen:
        table = np.array([row[index] for row in rows], float).reshape(len(rows), -1)
        # What a message repeats of an earlier one is older than the newest.
        table = table[table[:, 0] > np.maximum.accumulate(np.r_[0.0, table[:-1, 0]])] if len(table) else table
        if len(table) < 2:
            raise HebiLogError(f"{path}: {len(table)} samples of module {index + 1}; at least 2 are needed")
        tables.append(table)
    return tables
