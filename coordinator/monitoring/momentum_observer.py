"""What acts on a robot from outside, by its momentum: no accelerations are needed.

The generalised momentum p = M(q) qd changes by p' = tau + C^T qd - g + tau_ext, so that

    r = K ( p - integral of ( tau + C^T qd - g + r ) )

is the outside's torque through a low-pass of K / 2 pi Hz (De Luca and Mattone 2003; Haddadin, De Luca and
Albu-Schaeffer, Robot Collisions: A Survey, IEEE T-RO 2017, eqs 30-33). C^T qd - g is
M' qd - ( C qd + g ), and all of these are products with the identified parameters: what these are unsure of
in the mass matrix is unsure in r alike.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import leaky_sum

# Of 8 Hz: two thirds of a blow's torque are there after 20 ms.
GAIN_HZ = 50.0
_STEP_S = 1.0 / RATE_HZ
# Over which M' is a difference [s].
_AHEAD_S = 1e-3


class _State(NamedTuple):
    momentum: Array
    drive: Array
    outside: Array


class MomentumObserver:
    """Turns joint motion and torque, sample by sample, into the torques (m, n) [Nm] from outside."""

    def __init__(self, chain: Chain, phi: ArrayLike):
        self._chain = chain
        self._weightless = chain._replace(gravity=np.zeros(3))
        self._phi = np.asarray(phi, dtype=float)
        self._state: _State | None = None

    def reset(self) -> None:
        """Begin anew: the samples that come next do not follow on those before."""
        self._state = None

    def advance(self, q_rad: Array, qd_rad_s: Array, tau_nm: Array) -> Array:
        """Return what acts from outside at the next samples, (m, n) each, read-only."""
        momentum = inverse_dynamics(self._weightless, self._phi, q_rad, np.zeros_like(q_rad), qd_rad_s)
        drive = tau_nm + self._carried(q_rad, qd_rad_s)
        begins = self._state is None
        if self._state is None:
            self._state = _State(momentum[0], drive[0], np.zeros(q_rad.shape[1]))
        before = self._state
        moved = np.diff(np.vstack([before.momentum, momentum]), axis=0)
        drives = np.vstack([before.drive, drive])
        pushed = moved - 0.5 * _STEP_S * (drives[1:] + drives[:-1])
        if begins:
            pushed[0] = 0.0
        outside = leaky_sum(GAIN_HZ * pushed, 1.0 - GAIN_HZ * _STEP_S, before.outside)
        self._state = _State(momentum[-1], drive[-1], outside[-1])
        return outside

    def _carried(self, q: Array, qd: Array) -> Array:
        """Return C^T qd - g."""
        still = np.zeros_like(q)
        ahead, behind = (
            inverse_dynamics(self._weightless, self._phi, q + side * _AHEAD_S * qd, still, qd)
            for side in (1.0, -1.0)
        )
        held = inverse_dynamics(self._chain, self._phi, q, qd, still)
        return np.asarray((ahead - behind) / (2.0 * _AHEAD_S) - held)
