"""How much inertia a joint moves, roughly, by its own slow motion: what the next may ask of its torque."""

from typing import NamedTuple

import numpy as np

from module_agent.dynamics.chain import Array
from module_agent.dynamics.differentiation import differentiate, settling_samples, zero_phase_low_pass

# Below what a held spring rings at; the ramps of a slow motion last 0.15 s and more.
CUTOFF_HZ = 6.0
# Whatever a joint carries, it has an output and a gear train of its own.
LEAST_KG_M2 = 2e-3


class Load(NamedTuple):
    """Inertia about the joint's axis [kg m^2] and its standard deviation."""

    inertia_kg_m2: float
    sigma_kg_m2: float

    @property
    def at_most_kg_m2(self) -> float:
        """What it hardly exceeds: two standard deviations more, and a fifth for what the fit leaves out."""
        return max(1.2 * (max(self.inertia_kg_m2, 0.0) + 2.0 * self.sigma_kg_m2), LEAST_KG_M2)


def measured_load(q_rad: Array, tau_nm: Array, rate_hz: float) -> Load:
    """Fit tau = I d2q/dt2 + c dq/dt + a q + b to one motion of one joint, the others held.

    Over a turn in one direction dry friction is part of b, and gravity is straight to first order.

    Args:
        q_rad, tau_nm: (m,) samples of the joint's position and measured torque.
        rate_hz: of the samples.

    Raises:
        ValueError: a motion that is too short for the low-pass.
    """
    q, tau = (zero_phase_low_pass(signal, rate_hz, CUTOFF_HZ) for signal in (q_rad, tau_nm))
    rate = differentiate(q, rate_hz)
    edge = settling_samples(rate_hz, CUTOFF_HZ) // 2
    kept = slice(edge, len(q) - edge)
    terms = np.column_stack([differentiate(rate, rate_hz), rate, q - q.mean(), np.ones(len(q))])[kept]
    found, *_ = np.linalg.lstsq(terms, tau[kept], rcond=None)
    residual = tau[kept] - terms @ found
    # A low-passed sample is not independent of its neighbours.
    independent = len(terms) * min(1.0, 2.0 * CUTOFF_HZ / rate_hz)
    freedom = max(independent - terms.shape[1], 1.0)
    scatter = float(residual @ residual) / len(terms) * independent / freedom
    variance = scatter * np.linalg.pinv(terms.T @ terms)[0, 0] * len(terms) / independent
    return Load(float(found[0]), float(np.sqrt(variance)))
