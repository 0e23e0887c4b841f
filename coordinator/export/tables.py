"""A run as a table in a file: CSV, or Parquet by pyarrow."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from coordinator.export.exported_run import ExportedRun, check_package
from coordinator.export.frames import instants_frame, samples_frame
from module_agent.model.files import replacing

TableFormat = Literal["csv", "parquet"]
# A part of CSV is written at a time, so that there is progress.
_ROWS = 20_000


def write_table(
    path: Path,
    run: ExportedRun,
    kind: TableFormat,
    rate_hz: float | None,
    progress: Callable[[int, int], None],
) -> int:
    """Write the run's samples, or all modules at common instants, whole or not at all; return the rows.

    Floats are written as short as they read back to the same bits.

    Raises:
        MissingPackage: pandas or pyarrow is not installed.
        UsageError: there is no such rate.
        OSError: the file cannot be written.
    """
    if kind == "parquet":
        check_package("pyarrow", "Parquet")
    frame = samples_frame(run) if rate_hz is None else instants_frame(run, rate_hz)
    # Which clock `t_s` counts on.
    frame.attrs = {"robot": run.robot, "start_ns": run.start_ns}
    with replacing(path) as temporary:
        if kind == "parquet":
            frame.to_parquet(temporary, engine="pyarrow", compression="zstd", index=False)
        else:
            for first in range(0, max(len(frame), 1), _ROWS):
                progress(first, len(frame))
                frame.iloc[first : first + _ROWS].to_csv(
                    temporary, index=False, mode="a" if first else "w", header=first == 0
                )
        progress(len(frame), len(frame))
    return len(frame)
