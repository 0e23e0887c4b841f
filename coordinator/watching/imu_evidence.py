"""What IMUs say of a link that has changed: rates and specific forces against those of the joints' motion.

A payload changes nothing in them, as encoders sit beyond the springs. A link that is displaced moves every
module beyond it by the same twist, linear in the readings as long as it is small (`inertial_slopes`).
Biases and delays are each stretch's own: they drift, and clocks are mapped anew every day.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.kinematics.forward import ancestors
from coordinator.kinematics.imu_intrinsics import DELAY, SIZE, ImuIntrinsics, ImuPrior, mixing, read, slopes
from coordinator.kinematics.inertial_prediction import body_motions, readings_on
from coordinator.kinematics.inertial_slopes import imu_slopes
from coordinator.watching.evidence import Evidence, compressed
from coordinator.watching.stretch import Stretch
from module_agent.dynamics.chain import Array, Chain

# The low-pass leaves about as many independent samples as one in five.
KEEP_EVERY = 5
# Of an IMU's errors: those that are the stretch's own, and those that stay.
_OWN = [*range(18, 24), DELAY]
_LASTING = [k for k in range(SIZE) if k not in _OWN]
_PER_TWIST = 6
# How far the known links may be off, in radians and metres; gravity, in m/s^2; own biases against those of
# the known run, and delays against those of no filter at all.
_LINK_SIGMA, _GRAVITY_SIGMA = 0.02, 0.05
_OWN_SIGMA = np.array([3e-3] * 3 + [0.05] * 3 + [5e-3])
# Of a change: 0.1 rad, 0.1 m.
LARGE = 0.1


class ImuModel(NamedTuple):
    """What IMUs should read, and how well: the chain, the IMUs' errors, and scatters (n, 6) per sample."""

    chain: Chain
    intrinsics: ImuIntrinsics
    prior: ImuPrior
    sigma: Array

    @property
    def own_sigma(self) -> Array:
        """How far a stretch's own parameters may be from the known, (7 n,)."""
        return np.tile(_OWN_SIGMA, len(self.chain.serials))

    @property
    def prior_sigma(self) -> Array:
        """The same of those that stay: twists of all links (6 n), gravity (3), IMUs' errors (27 n)."""
        count = len(self.chain.serials)
        errors = np.maximum(self.prior.sigmas[_LASTING], 1e-5)
        return np.concatenate(
            [np.full(_PER_TWIST * count, _LINK_SIGMA), np.full(3, _GRAVITY_SIGMA), np.tile(errors, count)]
        )


def without_delay(intrinsics: ImuIntrinsics) -> ImuIntrinsics:
    """Return the errors without delays, which are each stretch's own."""
    errors = intrinsics.errors.copy()
    errors[:, DELAY] = 0.0
    return ImuIntrinsics(errors)


def imu_residual(model: ImuModel, stretch: Stretch) -> Array:
    """Return what the model leaves of the readings, (m, n, 6): rates, then specific forces."""
    at = _thinned(stretch)
    bodies = body_motions(model.chain, at.q_rad, at.qd_rad_s, at.qdd_rad_s2)
    ideal = readings_on(model.chain, bodies)
    gyro, accel = read(model.intrinsics, ideal.gyro_rad_s, ideal.accel_m_s2, None)
    return np.concatenate([at.gyro_rad_s - gyro, at.accel_m_s2 - accel], axis=2)


def lasting_residual(model: ImuModel, stretches: Sequence[Stretch]) -> list[Array]:
    """Return what the model leaves of the readings but for biases and delays that are the same in all.

    Per stretch (m, 6 n).
    """
    left = [imu_residual(model, one) for one in stretches]
    rates = [-one.imu_rates[::KEEP_EVERY] for one in stretches]
    whole, late = np.concatenate(left), np.concatenate(rates)
    whole, late = whole - whole.mean(axis=0), late - late.mean(axis=0)
    # One delay for all six axes of an IMU, weighed by what each scatters.
    weight = 1.0 / np.maximum(whole.var(axis=0), 1e-12)
    delay = (weight * late * whole).sum(axis=(0, 2)) / np.maximum((weight * late**2).sum(axis=(0, 2)), 1e-12)
    settled = whole - delay[:, None] * late
    ends = np.cumsum([len(one) for one in left])[:-1]
    return [part.reshape(len(part), -1) for part in np.split(settled, ends)]


def imu_evidence(model: ImuModel, stretch: Stretch) -> Evidence:
    """Return the evidence (k, p): own parameters (`own_sigma`), then those that stay (`prior_sigma`)."""
    at, count = _thinned(stretch), len(model.chain.serials)
    bodies = body_motions(model.chain, at.q_rad, at.qd_rad_s, at.qdd_rad_s2)
    ideal = readings_on(model.chain, bodies)
    residual = imu_residual(model, stretch)
    samples, own = len(at.q_rad), len(_OWN) * count
    rows = np.zeros((count, samples, 6, own + len(model.prior_sigma)))
    free = np.ones(SIZE, dtype=bool)
    for k in range(count):
        moved = imu_slopes(model.chain, bodies, at.q_rad, at.qd_rad_s, k)
        mixed = mixing(model.intrinsics, k)
        poses = np.einsum("ij,cjm->mic", mixed, moved.poses)
        for place, module in enumerate(moved.modules):
            to = own + _PER_TWIST * module
            rows[k, :, :, to : to + _PER_TWIST] = poses[..., _PER_TWIST * place : _PER_TWIST * (place + 1)]
        tilt = own + _PER_TWIST * count
        rows[k, :, :, tilt : tilt + 3] = np.einsum("ij,cjm->mic", mixed, moved.gravity)
        by_error = slopes(ideal.gyro_rad_s[:, k], ideal.accel_m_s2[:, k], at.imu_rates[:, k], free)
        by_error = np.moveaxis(by_error, 2, 0).swapaxes(1, 2)
        rows[k, :, :, len(_OWN) * k : len(_OWN) * (k + 1)] = by_error[..., _OWN]
        to = tilt + 3 + len(_LASTING) * k
        rows[k, :, :, to : to + len(_LASTING)] = by_error[..., _LASTING]
    weighted = rows / model.sigma[:, None, :, None]
    target = np.swapaxes(residual, 0, 1) / model.sigma[:, None, :]
    return compressed(weighted.reshape(-1, rows.shape[-1]), target.reshape(-1))


def link_changes(chain: Chain) -> tuple[Array, ...]:
    """Return the hypotheses, one for every module but those on the base: all beyond its link is displaced."""
    count = len(chain.serials)
    total = _PER_TWIST * count + 3 + len(_LASTING) * count
    found = []
    for child in linked(chain):
        change = np.zeros((total, _PER_TWIST))
        for module in range(count):
            if child in ancestors(chain, module):
                change[_PER_TWIST * module : _PER_TWIST * (module + 1)] = LARGE * np.eye(_PER_TWIST)
        found.append(change)
    return tuple(found)


def linked(chain: Chain) -> tuple[int, ...]:
    """Return the modules whose link to another module is tested."""
    return tuple(k for k, parent in enumerate(chain.parent) if parent >= 0)


def displacement(chain: Chain, child: int, size: Array) -> tuple[Array, Array]:
    """Return the turn (3,) [rad] and the displacement (3,) [m] of a module's IMU, in the root frame at q = 0.

    size: (6,) of `Change`.
    """
    turn, shift = LARGE * size[:3], LARGE * size[3:]
    return turn, shift + np.cross(turn, chain.imu_home[child, :3, 3])


def _thinned(stretch: Stretch) -> Stretch:
    kept = slice(None, None, KEEP_EVERY)
    return stretch._replace(
        q_rad=stretch.q_rad[kept],
        qd_rad_s=stretch.qd_rad_s[kept],
        qdd_rad_s2=stretch.qdd_rad_s2[kept],
        gyro_rad_s=stretch.gyro_rad_s[kept],
        accel_m_s2=stretch.accel_m_s2[kept],
        imu_rates=stretch.imu_rates[kept],
    )
