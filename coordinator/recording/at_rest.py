"""The mean readings of modules at rest, from which gravity's direction and the joints' positions follow."""

from collections.abc import Sequence

import numpy as np

from coordinator.kinematics.chain_observations import RestObservation
from coordinator.recording.recording import Recording
from module_agent.model.errors import DataError


def rest_observation(recording: Recording, serials: Sequence[str], min_rows: int = 1) -> RestObservation:
    """Average every IMU and encoder over its module's last rest.

    Raises:
        DataError: a module has fewer than `min_rows` rows at rest.
    """
    rows = [recording.rest_rows(serial) for serial in serials]
    for serial, resting in zip(serials, rows, strict=True):
        if len(resting) < min_rows:
            raise DataError(f"module {serial} has {len(resting)} rows at rest, {min_rows} are needed")
    accel = [resting["accel_m_s2"].astype(float) for resting in rows]
    force = np.array([one.mean(axis=0) for one in accel])
    scatter = [float(one.std(axis=0).max()) / np.sqrt(len(one)) for one in accel]
    position = np.array([float(resting["position_rad"].mean()) for resting in rows])
    return RestObservation(force, max(scatter), position)
