"""Two sessions of one robot, both fitted with the same errors of its IMUs.

An IMU's scale and axes are as they were: they change with years, not between two sessions. What a session
gets wrong of them, it gets wrong of both alike, so that it cancels in the difference of the two chains. The
same goes for whatever else the model leaves out, as far as the motions are the same. Biases drift, and are
free in each session.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.journal import Purpose
from coordinator.kinematics.imu_intrinsics import UNCALIBRATED, ImuIntrinsics
from coordinator.kinematics.refinement import Refinement, refine_chain
from coordinator.known_robot import KnownRobot
from coordinator.motion_window import RATE_HZ, Window, sensor_data, window
from coordinator.robot_refinement import CUTOFF_HZ, KEEP_EVERY, MOST_IMU_SAMPLES
from module_agent.dynamics.chain import Array, Chain
from module_agent.dynamics.differentiation import settling_samples

# Scale and axes of an IMU that has been corrected for them: for the two sessions they are the same.
TIED = UNCALIBRATED._replace(scale=1e-5, misalignment_rad=1e-5)
MOVING: tuple[Purpose, ...] = ("constant", "windowed_sine", "whole")


class TiedFits(NamedTuple):
    """One robot's chain from a former session and from a later one, under the same errors of the IMUs."""

    before: Refinement
    after: Refinement


def tied_fits(known: KnownRobot, later: KnownRobot) -> TiedFits:
    """Fit the sessions of two runs of one robot, from the known chain, with the IMUs' errors found then.

    The later chain may differ from the known one by some 0.2 rad and 0.1 m; its modules must be the same.

    Raises:
        ValueError: a hole in a recording, or too few samples.
    """
    chain, imus = known.chain, known.kinematics.refinement.intrinsics
    first, second = (_fit(chain, corrected(exploration(run, chain.serials), imus)) for run in (known, later))
    return TiedFits(first, second)


def exploration(run: KnownRobot, serials: Sequence[str]) -> list[Window]:
    """Return what all modules read during the last exploration of every joint, in the order of `serials`."""
    margin = settling_samples(RATE_HZ, CUTOFF_HZ) / RATE_HZ
    moving = run.recording.motions(*MOVING)
    # All take part in a motion of the whole robot: it is one stretch of the recording.
    last = {("" if e.purpose == "whole" else e.serial, e.purpose): e for e in moving}
    events = [*last.values(), *run.recording.motions("repeat")]
    return [window(run.recording, run.kinematics.clocks, serials, e, margin) for e in events]


def corrected(windows: Sequence[Window], imus: ImuIntrinsics) -> list[Window]:
    """Return the readings as IMUs without errors of scale and axes would have given them, biases left in."""
    gyro, accel = (
        np.asarray(np.linalg.inv(matrix), dtype=float) for matrix in (imus.gyro_matrix, imus.accel_matrix)
    )
    return [
        one._replace(gyro_rad_s=_turned(gyro, one.gyro_rad_s), accel_m_s2=_turned(accel, one.accel_m_s2))
        for one in windows
    ]


def _turned(matrices: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("nij,mnj->mni", matrices, vectors))


def _fit(chain: Chain, windows: Sequence[Window]) -> Refinement:
    samples = sum(len(one.t_ns) for one in windows) * len(chain.serials)
    keep_every = max(KEEP_EVERY, -(-samples // MOST_IMU_SAMPLES))
    return refine_chain(chain, sensor_data(windows, CUTOFF_HZ, keep_every), TIED)
