"""The thesis' estimator of the load of one joint (chapter 5; Atkeson, An and Hollerbach 1986).

The wrench on a load is linear in its ten parameters (eq. 25), w = A phi, with Phi by the pseudo-inverse
(eq. 29). With the joint along z of its frame and turning by q alone, s the specific force of rest in that
frame, the six rows of A in the columns m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz are

    f = m s + (alpha x + omega x omega x) m c,        n = m c x s + I alpha + omega x I omega,

and the joint measures the third moment alone:

    tau = mcx s_y - mcy s_x + Izz alpha.

Section 5.1 assumes that the frame in which torque is sensed is at rest. Then s is constant, and gravity's
torque does not change with q ("at rest"); in truth s turns by -q in the link's frame ("with the link").
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.estimate.gaussian_filter import gaussian_filter
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only, read_only
from module_agent.model.regressor import PER_BODY

Frame = Literal["at rest", "with the link"]

# Columns of the parameters that a joint along z shows.
MCX, MCY, IZZ = 1, 2, 9
_MOMENT_Z = 5


class JointSamples(NamedTuple):
    """Samples of one joint as its module measures them, (m,) each; times need not be uniform."""

    t_s: Array
    q_rad: Array
    qd_rad_s: Array
    tau_nm: Array


class LoadFit(NamedTuple):
    """The load beyond a joint; arrays read-only.

    phi: (10,) as in eq. 25. calculated_nm: (m,) A phi of the motion that was fitted. squared_error_nm2: the
        sum of the squared differences to the measured torques, the thesis' LSE.
    """

    phi: Array
    calculated_nm: Array
    squared_error_nm2: float


def accelerations(samples: JointSamples, filtered: bool = True) -> Array:
    """Return the differentiated velocities (m,) [rad/s^2], read-only, through the thesis' Gaussian filter.

    Raises:
        DataError: fewer samples than the filter needs.
    """
    raw = np.gradient(samples.qd_rad_s, samples.t_s)
    return gaussian_filter(raw) if filtered else read_only(np.asarray(raw, dtype=float))


def wrench_rows(
    q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike, force_m_s2: ArrayLike, frame: Frame
) -> Array:
    """Return the matrix A of eq. 25, (m, 6, 10), read-only: forces, then moments about the joint.

    Args:
        q_rad, qd_rad_s, qdd_rad_s2: (m,) of the joint, whose axis is z.
        force_m_s2: (3,) specific force of rest at q = 0.
        frame: whether gravity keeps its direction in the frame, or turns against the link.
    """
    q, omega, alpha = (np.asarray(signal, dtype=float) for signal in (q_rad, qd_rad_s, qdd_rad_s2))
    x, y, z = (np.full(q.shape, float(component)) for component in np.asarray(force_m_s2))
    if frame == "with the link":
        x, y = np.cos(q) * x + np.sin(q) * y, np.cos(q) * y - np.sin(q) * x
    square = omega**2
    rows = np.zeros((q.size, 6, PER_BODY))
    rows[:, :3, 0] = np.stack([x, y, z], axis=1)
    rows[:, 0, 1], rows[:, 0, 2] = -square, -alpha
    rows[:, 1, 1], rows[:, 1, 2] = alpha, -square
    rows[:, 3, 2], rows[:, 3, 3] = z, -y
    rows[:, 4, 1], rows[:, 4, 3] = -z, x
    rows[:, 5, 1], rows[:, 5, 2] = y, -x
    rows[:, 3, 6], rows[:, 3, 8] = alpha, -square
    rows[:, 4, 6], rows[:, 4, 8] = square, alpha
    rows[:, 5, 9] = alpha
    return read_only(rows)


def identify_load(
    samples: JointSamples, force_m_s2: ArrayLike, frame: Frame = "at rest", filtered: bool = True
) -> LoadFit:
    """Identify the load from the torques about the joint, as the thesis does.

    Args:
        samples: of one motion. force_m_s2: (3,) specific force of rest at q = 0, as it is measured.
        frame: see above. filtered: whether the acceleration is smoothed; the torque never is.

    Raises:
        DataError: fewer samples than the filter needs, or a value that is not finite.
    """
    rows = moment_rows(samples, force_m_s2, frame, filtered)
    _check_finite(rows, samples.tau_nm)
    return _fit(np.linalg.pinv(rows) @ samples.tau_nm, rows, samples.tau_nm)


def identify_load_by_six_rows(samples: JointSamples, force_m_s2: ArrayLike) -> LoadFit:
    """Identify the load from all six rows of eq. 25, with zero for the five that no joint measures.

    Raises:
        DataError: as `identify_load`.
    """
    motion = samples.q_rad, samples.qd_rad_s, accelerations(samples)
    rows = wrench_rows(*motion, force_m_s2, "at rest")
    _check_finite(rows, samples.tau_nm)
    wrench = np.zeros(rows.shape[:2])
    wrench[:, _MOMENT_Z] = samples.tau_nm
    phi = np.linalg.pinv(rows.reshape(-1, PER_BODY)) @ wrench.reshape(-1)
    return _fit(phi, rows[:, _MOMENT_Z], samples.tau_nm)


def moment_rows(
    samples: JointSamples, force_m_s2: ArrayLike, frame: Frame = "at rest", filtered: bool = True
) -> Array:
    """Return the rows of A about the joint's axis, (m, 10), read-only.

    Raises:
        DataError: fewer samples than the filter needs.
    """
    motion = samples.q_rad, samples.qd_rad_s, accelerations(samples, filtered)
    return read_only(wrench_rows(*motion, force_m_s2, frame)[:, _MOMENT_Z].copy())


def least_mass_kg(phi: ArrayLike) -> float:
    """Return the least mass (kg) that a body with these parameters can have: |m c|^2 across z / Izz.

    By Cauchy's inequality (sum m r)^2 <= (sum m) (sum m r^2), with equality for a point mass.
    """
    parameters = np.asarray(phi, dtype=float)
    return float((parameters[MCX] ** 2 + parameters[MCY] ** 2) / parameters[IZZ])


def _fit(phi: Array, rows: Array, tau_nm: Array) -> LoadFit:
    calculated = rows @ phi
    make_read_only((phi, calculated))
    return LoadFit(phi, calculated, float(np.sum((calculated - tau_nm) ** 2)))


def _check_finite(rows: Array, tau_nm: Array) -> None:
    if not (np.isfinite(rows).all() and np.isfinite(tau_nm).all()):
        raise DataError(f"of {len(tau_nm)} samples some are not finite")
