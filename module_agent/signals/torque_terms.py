"""The registry of torque terms: the parts of a joint's torque other than that of the bodies.

Every term is a column, linear in one parameter per joint (Khalil and Dombre 2002, Modeling, identification
and control of robots, section 9.6). A drive adds the torque of its rotor, friction and an offset:

    tau = bodies + Ia qdd + Fv qd + Fc s(qd) + Fr s(qd) sqrt|qd| + offset
          + Fl |bodies| s(qd) + Fs s(qd) exp(-(qd / 10 slow)^2) + Fa |s(qd)|,    s(v) = tanh(v / slow).

Fl is the friction of gears and bearings that grows with their load (Khalil and Dombre, section 9.6; Hamon,
Gautier and Garrec 2010, Dynamic identification of robots with a dry friction model depending on load and
velocity), Fs what slow motion adds to Coulomb friction (Stribeck), and Fa half of the difference of Coulomb
friction between the directions.

A spring is read by its deflection y, and what rubber or grease in it damps does not show there: it transmits
k (y + T y'), so the reading k y lags by T (a spring with a damper in parallel is a Kelvin-Voigt element). The
friction that it shows is that of the bearings beyond the spring:

    reading = bodies - T reading' + offset + Fv qd + Fc s(qd).
"""

from typing import Literal, NamedTuple

import numpy as np

from module_agent.model.chain import Array
from module_agent.model.read_only import read_only
from module_agent.signals.filtering import JointMotion, differentiate, zero_phase_low_pass

Term = Literal["inertia", "viscous", "coulomb", "curved", "offset", "load", "stribeck", "asymmetry", "lag"]


class TermKind(NamedTuple):
    """The symbol and the unit of a term's parameter, and whether its column is linear in the motion.

    A low-pass does to a linear column what it does to the motion; a nonlinear one has to be filtered itself.
    """

    symbol: str
    unit: str
    linear: bool


TERM_KINDS: dict[Term, TermKind] = {
    "inertia": TermKind("Ia", "kg m^2", True),
    "viscous": TermKind("Fv", "Nm s/rad", True),
    "coulomb": TermKind("Fc", "Nm", False),
    "curved": TermKind("Fr", "Nm (s/rad)^0.5", False),
    "offset": TermKind("offset", "Nm", True),
    "load": TermKind("Fl", "Nm/Nm", False),
    "stribeck": TermKind("Fs", "Nm", False),
    "asymmetry": TermKind("Fa", "Nm", False),
    "lag": TermKind("T", "s", True),
}

# What the torque of a drive may hold; a motor's current has no lag.
DRIVE_TERMS: tuple[Term, ...] = (
    *("inertia", "viscous", "coulomb", "offset"),
    *("load", "curved", "stribeck", "asymmetry"),
)
# What the reading of a spring may hold; the rotor is on its other side.
READING_TERMS: tuple[Term, ...] = ("lag", "offset", "viscous", "coulomb")

# Below this speed the sign of a reading's Coulomb friction fades: ten times what an encoder of 14 bits,
# low-passed, reads of a joint at rest.
SLOW_RAD_S = 0.01
# Of `slow`: the speed at which what Stribeck friction adds has faded to 1/e.
_STRIBECK = 10.0


def term_signal(term: Term, qd_rad_s: Array, qdd_rad_s2: Array, slow_rad_s: float) -> Array:
    """Return the column of a term of the motion, of the shape of the speeds.

    Args:
        term: any but `lag`, whose column is the derivative of the reading.
        qd_rad_s, qdd_rad_s2: of one shape.
        slow_rad_s: speed below which the sign of friction fades. The sign itself would make full friction of
            the noise of a joint at rest.

    Raises:
        ValueError: the term is `lag`.
    """
    match term:
        case "inertia":
            return qdd_rad_s2
        case "viscous":
            return qd_rad_s
        case "coulomb" | "load":
            # That of the load is to be multiplied by the load.
            return np.tanh(qd_rad_s / slow_rad_s)
        case "curved":
            # Lubricated gears: friction that rises steeply first and then ever less.
            return np.tanh(qd_rad_s / slow_rad_s) * np.sqrt(np.abs(qd_rad_s))
        case "stribeck":
            return np.tanh(qd_rad_s / slow_rad_s) * np.exp(-((qd_rad_s / (_STRIBECK * slow_rad_s)) ** 2))
        case "asymmetry":
            return np.abs(np.tanh(qd_rad_s / slow_rad_s))
        case "offset":
            return np.ones_like(qd_rad_s)
        case "lag":
            raise ValueError("the column of a lag is the derivative of the reading, not of the motion")


def term_columns(motion: JointMotion, rate_hz: float, cutoff_hz: float) -> Array:
    """Return the columns of `READING_TERMS`, (m, n, 4), read-only: reading = tau + columns @ parameters.

    Args:
        motion: m consecutive samples of n joints, low-passed at `cutoff_hz`.
        rate_hz: of its samples.
        cutoff_hz: nonlinear columns are low-passed as the motion was.
    """

    def column(term: Term) -> Array:
        if term == "lag":
            return -differentiate(motion.tau_nm, rate_hz)
        signal = term_signal(term, motion.qd_rad_s, motion.qdd_rad_s2, SLOW_RAD_S)
        return signal if TERM_KINDS[term].linear else zero_phase_low_pass(signal, rate_hz, cutoff_hz)

    return read_only(np.stack(list(map(column, READING_TERMS)), axis=2))
