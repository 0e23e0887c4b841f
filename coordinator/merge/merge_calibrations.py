"""Merge what several runs tell of the same modules' IMUs (`batch_estimation.imu_calibration`)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_calibration import (
    CalibrationInformation,
    ImuCalibration,
    measured_before,
)
from coordinator.merge.calibration_file import each_once
from module_agent.model.imu_prior import IMU_PRIORS

# A parameter to which the other runs add less variance than this share says nothing about their agreement.
MIN_ADDED = 1e-3


class MergedCalibration(NamedTuple):
    """The IMUs of all modules of some runs, and how far each run by itself is from it.

    inconsistency_sigma: of every run, the largest difference of a place by the run alone from the merged one,
    in standard deviations of that difference; None of a run that tells nothing of them.
    """

    calibration: ImuCalibration
    inconsistency_sigma: tuple[float | None, ...]


def merge_calibrations(runs: Sequence[Sequence[CalibrationInformation]]) -> MergedCalibration:
    """Merge the recordings of some runs, the own one of each first; those that runs share count once.

    The prior is that of uncalibrated IMUs if one run was made with it. A run may have no recordings.
    """
    recordings = each_once(one for run in runs for one in run)
    kinds = {one.imu for one in recordings}
    prior = IMU_PRIORS["uncalibrated" if "uncalibrated" in kinds else "calibrated"]
    serials = tuple(sorted({serial for one in recordings for serial in one.serials}))
    merged = measured_before(serials, prior, recordings)
    apart: list[float | None] = []
    for run in runs:
        if not run:
            apart.append(None)
            continue
        own = run[0]
        alone = measured_before(own.serials, prior, [own])
        places = [serials.index(serial) for serial in own.serials]
        variance = alone.placement_sigma**2
        added = variance - merged.placement_sigma[places] ** 2
        told = added > MIN_ADDED * variance
        difference = np.abs(alone.placement - merged.placement[places])[told] / np.sqrt(added[told])
        apart.append(float(difference.max(initial=0.0)))
    return MergedCalibration(merged, tuple(apart))
