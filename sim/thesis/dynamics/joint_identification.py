"""The coordinator's estimator of inertial parameters, on the rows of one joint alone.

The parts are those of `coordinator.identification.inertia`: one low-pass over torque and motion, the motion
of the base by the IMU of the joint's own module, and terms of the torque reading where they are significant.
The sensor's offset is not among them: in one pose it is not to be told from gravity. The chain is by the
catalogue of modules: one joint along z, with the directions of `load_identification`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.batch_estimation.imu_prediction import body_motions
from coordinator.batch_estimation.sensor_data import NoiseFloor, measured_base_motion
from coordinator.dynamics.body_regressor import body_tracks, track_regressor
from coordinator.parameter_fit.instrumental_variables import solve_instrumental_variables
from coordinator.synchronisation.motion_windows import (
    INDEPENDENT_FRACTION,
    RATE_HZ,
    STEP_NS,
    Window,
    noise_floor,
)
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.information import compress
from module_agent.model.read_only import frozen, read_only
from module_agent.model.regressor import PER_BODY
from module_agent.signals.filtering import (
    DYNAMIC_CUTOFF_HZ,
    JointMotion,
    filtered_signals,
    resample,
    settling_samples,
)
from module_agent.signals.torque_terms import READING_TERMS, term_columns
from module_agent.wire.feedback_rows import Rows
from sim.geometry.pose import pose

# Rows that are recorded either side of a motion: those on which the low-pass settles, and one to interpolate.
MARGIN_NS = (settling_samples(RATE_HZ, DYNAMIC_CUTOFF_HZ) + 2) * STEP_NS


class JointFit(NamedTuple):
    """The load of a joint by the coordinator's estimator; arrays read-only.

    phi, sigma: (10,) parameters as identified, and their standard deviations. terms: (4,) of the reading's
    `READING_TERMS`, zero where not significant.
    """

    phi: Array
    sigma: Array
    terms: Array


class TorqueComparison(NamedTuple):
    """(m,) times by a module's clock, the torque that follows from a `JointFit`, and the one as read."""

    t_ns: NDArray[np.int64]
    calculated_nm: Array
    measured_nm: Array


class JointModel(NamedTuple):
    """What is known of a joint before it moves: its chain, and the noise of its module's IMU at rest."""

    chain: Chain
    floor: NoiseFloor


def joint_model(kind: ModuleType, serial: str, rest: Rows) -> JointModel:
    """Return the chain of one module and the noise of its IMU, from rows at rest at q = 0.

    Raises:
        DataError: too few rows for the low-pass.
    """
    imu = pose(kind.imu_xyz)
    chain = Chain(
        serials=(serial,),
        parent=(BASE,),
        reversed=(False,),
        axis=frozen([[0.0, 0.0, 1.0]]),
        point=frozen([[0.0, 0.0, kind.output_xyz[2]]]),
        imu_home=frozen([imu]),
        gravity=frozen(rest["accel_m_s2"].astype(float).mean(axis=0)),
    )
    return JointModel(chain, noise_floor(joint_window(rest), DYNAMIC_CUTOFF_HZ))


def joint_window(rows: Rows) -> Window:
    """Return a module's rows on a uniform time base, torques as they were read.

    Raises:
        DataError: a hole, or times out of order.
    """
    times = rows["t_ns"].astype(np.int64)
    imu_times, fresh = np.unique(rows["imu_t_ns"].astype(np.int64), return_index=True)
    start, end = max(times[0], imu_times[0]), min(times[-1], imu_times[-1])
    common = np.arange(start, end, STEP_NS, dtype=np.int64)
    joint = np.column_stack([rows[name].astype(float) for name in ("position_rad", "effort_nm")])
    imu = np.column_stack([rows[name][fresh].astype(float) for name in ("gyro_rad_s", "accel_m_s2")])
    q, tau = np.moveaxis(resample([times], [joint], common), 2, 0)
    readings = resample([imu_times], [imu], common)
    return Window(common, q, tau, readings[..., :3], readings[..., 3:], np.zeros(1))


def identify_joint(model: JointModel, rows: Rows) -> JointFit:
    """Identify the load of a joint from its rows during a motion, with `MARGIN_NS` of rows either side.

    Raises:
        DataError: a hole, too few rows, or motion that determines nothing.
    """
    seen = _seen(model, rows)
    information = compress(np.concatenate([seen.regressor, seen.terms], axis=2), seen.motion.tau_nm)
    solved = solve_instrumental_variables(information, np.zeros(PER_BODY), INDEPENDENT_FRACTION)
    sigma = np.sqrt(np.diagonal(solved.fit.covariance))
    return JointFit(solved.fit.phi, read_only(sigma), solved.terms.value[0])


def compare_torques(model: JointModel, fit: JointFit, rows: Rows) -> TorqueComparison:
    """Return the torque of load, base motion and terms in a motion, and the one that was read.

    rows: as of `identify_joint`, of the same motion or another one.

    Raises:
        DataError: a hole, or too few rows.
    """
    seen = _seen(model, rows)
    calculated = seen.regressor[:, 0] @ fit.phi + seen.terms[:, 0] @ fit.terms
    return TorqueComparison(seen.motion.t_ns, read_only(np.asarray(calculated)), seen.read_nm)


class _Seen(NamedTuple):
    """One motion: low-passed signals, regressor (m, 1, 10), terms (m, 1, 4), torque as read (m,)."""

    motion: JointMotion
    regressor: Array
    terms: Array
    read_nm: Array


def _seen(model: JointModel, rows: Rows) -> _Seen:
    raw = joint_window(rows)
    signals = filtered_signals(
        raw.q_rad, [raw.tau_nm, raw.gyro_rad_s, raw.accel_m_s2], RATE_HZ, DYNAMIC_CUTOFF_HZ
    )
    q, qd, qdd, tau, gyro, accel = signals.settled()
    motion = JointMotion(read_only(raw.t_ns[signals.kept].copy()), q, qd, qdd, tau)
    base = measured_base_motion(gyro[:, 0], accel[:, 0], model.floor, RATE_HZ)
    bodies = body_motions(model.chain, q, qd, qdd, base)
    terms = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ).copy()
    terms[..., READING_TERMS.index("offset")] = 0.0
    regressor = track_regressor(body_tracks(model.chain, q, bodies, {}))
    return _Seen(motion, regressor, terms, read_only(raw.tau_nm[signals.kept, 0].copy()))
