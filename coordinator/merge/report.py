"""`merged.json`: the base parameters of module parts that several runs determine together."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from coordinator.merge.merge_calibrations import MergedCalibration
from coordinator.merge.merge_runs import MergedInformation, RunShare
from coordinator.parameter_fit.identifiability import WEAK_ABOVE
from coordinator.parameter_fit.report_parts import (
    BaseParameterPart,
    ImuPlacePart,
    Part,
    base_parameter_parts,
    imu_place_parts,
)

SCHEMA = 2
MERGED = "merged.json"


class RunPart(Part):
    """One run by itself, and the same base parameters by all runs together.

    identified: how many of its base parameters have a relative standard deviation below a tenth, by itself
    and merged. gain: median of sigma merged over sigma alone. inconsistency_sigma: the difference of the
    merged values from its own, in its own standard deviations, root mean square.
    imu_inconsistency_sigma: largest difference of an IMU's merged place from its own, in standard deviations;
    None of a run without `imu_calibration.npz`.
    """

    run: str
    serials: list[str]
    rank: int
    identified_alone: int
    identified_merged: int
    gain: float
    inconsistency_sigma: float
    imu_inconsistency_sigma: float | None


class MergeReport(Part):
    """All runs together. gain: as of a run, over all of them. suspicions: why runs are not to be believed.

    Schema 2 names `base_parameters` with their `sigma`, and `summary` (in schema 1 `sums` and `words`).
    """

    schema_version: int = SCHEMA
    parts: list[str]
    parameters: int
    rank: int
    gain: float
    runs: list[RunPart]
    base_parameters: list[BaseParameterPart]
    imu_places: list[ImuPlacePart]
    suspicions: list[str] = Field(default_factory=list)


def merge_report(
    merged: MergedInformation, imus: MergedCalibration, suspicions: Sequence[str] = ()
) -> MergeReport:
    """Return the report of merged runs."""
    base = merged.base
    return MergeReport(
        parts=[part.name for part in merged.parts],
        parameters=len(base.columns.names),
        rank=base.rank,
        gain=merged.gain,
        runs=[_run(*run) for run in zip(merged.runs, imus.inconsistency_sigma, strict=True)],
        base_parameters=base_parameter_parts(base),
        imu_places=imu_place_parts(imus.calibration),
        suspicions=list(suspicions),
    )


def _run(run: RunShare, imu_sigma: float | None) -> RunPart:
    size = np.abs(run.base.value) * WEAK_ABOVE
    return RunPart.of(
        run,
        run=run.name,
        imu_inconsistency_sigma=imu_sigma,
        rank=run.base.rank,
        identified_alone=int(np.sum(run.sigma_alone < size)),
        identified_merged=int(np.sum(run.sigma_merged < size)),
    )
