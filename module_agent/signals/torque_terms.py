"""What a joint's torque reading holds beside the torque of the bodies that the joint carries.

A spring is read by its deflection y. What rubber or grease in it damps does not show there: it transmits
k (y + T y'), and the reading k y is as late as T. With that, an offset, and the friction of the bearings
beyond the spring, what the joint does to its bodies and what is read are related by

    reading = tau - T reading' + offset + Fv qd + Fc s(qd),

one parameter a term and joint (viscous and Coulomb friction: Khalil and Dombre 2002, Modeling, identification
and control of robots, section 9.6; a spring with a damper beside it is a Kelvin-Voigt element).
"""

from typing import Literal, get_args

import numpy as np

from module_agent.model.chain import Array
from module_agent.signals.filtering import JointMotion, differentiate, zero_phase_low_pass

TorqueTerm = Literal["lag", "offset", "viscous", "coulomb"]
TERMS: tuple[TorqueTerm, ...] = get_args(TorqueTerm)
UNITS: dict[TorqueTerm, str] = {"lag": "s", "offset": "Nm", "viscous": "Nm s/rad", "coulomb": "Nm"}

# Below this speed the sign of Coulomb friction fades: ten times what an encoder of 14 bits, low-passed, makes
# of a joint at rest.
SLOW_RAD_S = 0.01


def term_columns(motion: JointMotion, rate_hz: float, cutoff_hz: float) -> Array:
    """Return the columns of `TERMS`, (m, n, 4), read-only: reading = tau + columns @ parameters.

    Args:
        motion: of one stretch of time without a gap, its signals low-passed at `cutoff_hz`.
        rate_hz: of its samples.
        cutoff_hz: the sign of a speed is no linear function of it, and is low-passed as all else was.
    """
    sign = zero_phase_low_pass(np.tanh(motion.qd_rad_s / SLOW_RAD_S), rate_hz, cutoff_hz)
    found = np.stack(
        [-differentiate(motion.tau_nm, rate_hz), np.ones_like(motion.tau_nm), motion.qd_rad_s, sign], axis=2
    )
    found.flags.writeable = False
    return found
