"""What a joint's drive adds to the torque of the bodies: friction, offset and the motor's own inertia.

Every term is a column per joint, linear in one parameter (Khalil and Dombre 2002, Modeling, identification
and control of robots, section 9.6): tau_i = ... + Ia qdd_i + Fv qd_i + Fc s(qd_i) + offset. Two joints whose
motors are geared together, as in many wrists, have columns of the sum of their speeds besides: a motor that
turns with qd_i + qd_j loads both joints alike.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array

Term = Literal["inertia", "viscous", "coulomb", "curved", "offset"]
TERMS: tuple[Term, ...] = get_args(Term)
# Everything but `curved`, which is close to a sum of Coulomb and viscous friction in short recordings.
USUAL_TERMS: tuple[Term, ...] = ("inertia", "viscous", "coulomb", "offset")

# Not linear in the motion: of a filtered motion these are not what the filter makes of those of the motion.
NONLINEAR: tuple[Term, ...] = ("coulomb", "curved")

_SYMBOL = {"inertia": "Ia", "viscous": "Fv", "coulomb": "Fc", "curved": "Fr", "offset": "offset"}
_UNIT = {
    "inertia": "kg m^2",
    "viscous": "Nm s/rad",
    "coulomb": "Nm",
    "curved": "Nm (s/rad)^0.5",
    "offset": "Nm",
}


class DriveColumn(NamedTuple):
    """One column: a term of the summed speed of `joints` (indices), which loads each of them alike."""

    term: Term
    joints: tuple[int, ...]

    @property
    def name(self) -> str:
        """Its parameter in words, "Fv3" or "Ia5+6", joints counted from 1."""
        return _SYMBOL[self.term] + "+".join(str(joint + 1) for joint in self.joints)

    @property
    def unit(self) -> str:
        """Of its parameter, if the torques are in Nm."""
        return _UNIT[self.term]


def drive_columns(
    joints: int, terms: Sequence[Term] = USUAL_TERMS, coupled: Sequence[tuple[int, int]] = ()
) -> tuple[DriveColumn, ...]:
    """Return the columns of n joints: every term for every joint, then those of coupled pairs (indices).

    A pair has no offset of its own: it would be the sum of the two that are there.

    Raises:
        ValueError: an unknown or repeated term, or a pair that is not of two different joints of the robot.
    """
    for term in terms:
        if term not in TERMS or list(terms).count(term) > 1:
            raise ValueError(f"term {term!r} is unknown or given twice; known are {', '.join(TERMS)}")
    for one, other in coupled:
        if one == other or not (0 <= one < joints and 0 <= other < joints):
            raise ValueError(
                f"joints {one + 1} and {other + 1} cannot share a drive; "
                f"two different joints of 1 to {joints} are needed"
            )
    alone = [DriveColumn(term, (i,)) for i in range(joints) for term in terms]
    shared = [DriveColumn(term, pair) for pair in coupled for term in terms if term != "offset"]
    return (*alone, *shared)


def drive_signals(
    columns: Sequence[DriveColumn], qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike, slow_rad_s: ArrayLike
) -> Array:
    """Return what each column is for the joints that it loads, (m, k), read-only.

    Where torques went through a low-pass, so must the `NONLINEAR` ones of these before they are used: a sign
    that turns within a sample becomes a slope.

    Args:
        columns: k of them.
        qd_rad_s, qdd_rad_s2: (m, n).
        slow_rad_s: (n,) speed below which the sign of Coulomb friction fades, s(v) = tanh(v / slow). The
            sign itself would make full friction of the noise of a joint at rest. Of a pair the larger one.

    Raises:
        ValueError: shapes that do not fit, or speeds that are not positive.
    """
    qd, qdd = np.asarray(qd_rad_s, dtype=float), np.asarray(qdd_rad_s2, dtype=float)
    slow = np.asarray(slow_rad_s, dtype=float)
    if qd.ndim != 2 or qdd.shape != qd.shape or slow.shape != qd.shape[1:] or not (slow > 0.0).all():
        raise ValueError(
            f"speeds {qd.shape}, accelerations {qdd.shape} and slow speeds {slow} do not fit: "
            "(m, n) twice and n positive numbers are needed"
        )
    found = np.empty((len(qd), len(columns)))
    for k, (term, joints) in enumerate(columns):
        at = list(joints)
        found[:, k] = _signal(term, qd[:, at].sum(axis=1), qdd[:, at].sum(axis=1), float(slow[at].max()))
    found.flags.writeable = False
    return found


def drive_regressor(columns: Sequence[DriveColumn], signals: ArrayLike, joints: int) -> Array:
    """Return the matrix D (m, n, k), read-only, of which the drives' torques are D @ parameters.

    Args:
        columns: k of them. signals: (m, k) of `drive_signals`. joints: n.

    Raises:
        ValueError: shapes that do not fit.
    """
    values = np.asarray(signals, dtype=float)
    if values.ndim != 2 or values.shape[1] != len(columns):
        raise ValueError(f"signals {values.shape} do not fit {len(columns)} columns: (m, k) is needed")
    found = np.zeros((len(values), joints, len(columns)))
    for k, column in enumerate(columns):
        found[:, list(column.joints), k] = values[:, k, None]
    found.flags.writeable = False
    return found


def _signal(term: Term, qd: Array, qdd: Array, slow: float) -> Array:
    match term:
        case "inertia":
            return qdd
        case "viscous":
            return qd
        case "coulomb":
            return np.tanh(qd / slow)
        case "curved":
            # Lubricated gears: friction that rises steeply first and then ever less.
            return np.tanh(qd / slow) * np.sqrt(np.abs(qd))
        case "offset":
            return np.ones_like(qd)
