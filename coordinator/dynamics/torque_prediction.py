"""Relative errors of predicted torques, of samples that the parameters were not fitted to.

The error is |e| / |tau| with 2-norms over the samples. It is compared with the simplest prediction, the mean
torque of the motion that was fitted: a model with a larger error has learnt nothing of the dynamics.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import JointMotion


class TorqueError(NamedTuple):
    """Relative torque errors |e| / |tau|, of all joints together and per joint (n,), read-only.

    `mean_overall` and `mean_per_joint` are those of predicting the constant mean. NaN where |tau| is zero.
    `samples` (n,) is how many were compared.
    """

    overall: float
    per_joint: Array
    mean_overall: float
    mean_per_joint: Array
    samples: NDArray[np.int64]


# Offsets and noise of a module's torque sensor are of this size (0.5 % of the largest torque, 13 Nm of an
# X5-9): a percentage of a torque below it compares with noise.
FAINT_NM = 0.1


def error_in_words(error_nm: float, torque_nm: float) -> str:
    """Return an rms error of torque [Nm] for people; as a percentage too, where the torque is no noise."""
    share = f" ({100.0 * error_nm / torque_nm:.1f} %)" if torque_nm >= FAINT_NM else ""
    return f"{error_nm:.3f} Nm of {torque_nm:.3f} Nm{share}"


class HeldOut(NamedTuple):
    """A held-out motion with the torques that were measured and predicted, (m, n) [Nm], read-only."""

    motion: JointMotion
    tau_predicted_nm: Array
    error: TorqueError


def torque_error(
    tau_nm: ArrayLike,
    tau_predicted_nm: ArrayLike,
    tau_mean_nm: ArrayLike,
    mask: ArrayLike | None = None,
) -> TorqueError:
    """Compare torques (m, n) with their prediction and with a constant.

    Args:
        tau_nm, tau_predicted_nm: (m, n) of the held-out motion.
        tau_mean_nm: (n,) mean torques of the motion that was fitted (not of this one, which would favour
        them).
        mask: (m, n) or (m, 1), True where to compare; None compares all. Report both if you mask.

    Raises:
        DataError: the mask leaves nothing to compare.
        ValueError: shapes that do not fit, or values that are not finite.
    """
    tau, predicted, mean = (np.asarray(a, dtype=float) for a in (tau_nm, tau_predicted_nm, tau_mean_nm))
    if tau.ndim != 2 or predicted.shape != tau.shape or mean.shape != tau.shape[1:]:
        raise ValueError(f"torques {tau.shape}, predicted {predicted.shape} and mean {mean.shape} do not fit")
    if not all(np.isfinite(a).all() for a in (tau, predicted, mean)):
        raise DataError("a torque is not finite")
    used = np.broadcast_to(True if mask is None else np.asarray(mask, dtype=bool), tau.shape)
    if not used.any():
        raise DataError("no samples to compare: the mask lets none through")
    size = np.where(used, tau, 0.0)
    errors = [np.where(used, of - tau, 0.0) for of in (predicted, mean)]
    overall, mean_overall = (float(_ratio(_norm(e, None), _norm(size, None))) for e in errors)
    per_joint, mean_per_joint = (_ratio(_norm(e, 0), _norm(size, 0)) for e in errors)
    samples = used.sum(axis=0, dtype=np.int64)
    make_read_only((per_joint, mean_per_joint, samples))
    return TorqueError(overall, per_joint, mean_overall, mean_per_joint, samples)


def check_held_out(chain: Chain, phi: ArrayLike, motion: JointMotion, tau_mean_nm: ArrayLike) -> HeldOut:
    """Predict the torques of a held-out motion (thesis eq. 26 with the fitted `phi`) and compare.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    predicted = inverse_dynamics(chain, phi, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    return HeldOut(motion, predicted, torque_error(motion.tau_nm, predicted, tau_mean_nm))


def _norm(signal: Array, axis: int | None) -> Array:
    return np.asarray(np.sqrt(np.sum(signal**2, axis=axis)))


def _ratio(error: Array, size: Array) -> Array:
    return np.asarray(np.divide(error, size, out=np.full(np.shape(size), np.nan), where=size > 0.0))
