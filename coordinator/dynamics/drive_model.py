"""The columns of the drives of a robot: friction, offset and the motor's own inertia, joint by joint.

The terms and their equations are those of `torque_terms`. Two joints whose motors are geared together, as in
many wrists, additionally have columns of the sum of their speeds: a motor that turns with qd_i + qd_j loads
both joints alike.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array
from module_agent.model.read_only import read_only
from module_agent.signals.torque_terms import DRIVE_TERMS, TERM_KINDS, Term, term_signal

# Everything but `curved`, which is close to a sum of Coulomb and viscous friction in short recordings.
USUAL_TERMS: tuple[Term, ...] = ("inertia", "viscous", "coulomb", "offset")


class DriveColumn(NamedTuple):
    """One column: a term of the summed speed of `joints` (indices), which loads each of them alike."""

    term: Term
    joints: tuple[int, ...]

    @property
    def name(self) -> str:
        """The name of its parameter, "Fv3" or "Ia5+6", joints counted from 1."""
        return TERM_KINDS[self.term].symbol + "+".join(str(joint + 1) for joint in self.joints)

    @property
    def unit(self) -> str:
        """The unit of its parameter, torques in Nm."""
        return TERM_KINDS[self.term].unit


def drive_columns(
    joints: int, terms: Sequence[Term] = USUAL_TERMS, coupled: Sequence[tuple[int, int]] = ()
) -> tuple[DriveColumn, ...]:
    """Return the columns of n joints: every term for every joint, then those of coupled pairs (indices).

    A pair has no offset of its own: it would be the sum of the two that are there. Its load is not known.

    Raises:
        ValueError: an unknown or repeated term, or a pair that is not of two different joints of the robot.
    """
    for term in terms:
        if term not in DRIVE_TERMS or list(terms).count(term) > 1:
            raise ValueError(f"term {term!r} is unknown or given twice; known are {', '.join(DRIVE_TERMS)}")
    for one, other in coupled:
        if one == other or not (0 <= one < joints and 0 <= other < joints):
            raise ValueError(
                f"joints {one + 1} and {other + 1} cannot share a drive; "
                f"two different joints of 1 to {joints} are needed"
            )
    alone = [DriveColumn(term, (i,)) for i in range(joints) for term in terms]
    shared = [DriveColumn(term, pair) for pair in coupled for term in terms if term not in ("offset", "load")]
    return (*alone, *shared)


def drive_signals(
    columns: Sequence[DriveColumn], qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike, slow_rad_s: ArrayLike
) -> Array:
    """Return the signal of each column, the same for all joints that it loads, (m, k), read-only.

    If the torques were low-passed, the columns that are not linear (`TERM_KINDS`) have to be low-passed too:
    a sign that changes within a sample becomes a slope.

    Args:
        columns: k of them.
        qd_rad_s, qdd_rad_s2: (m, n).
        slow_rad_s: (n,) speed below which the sign of friction fades (`term_signal`); a pair has the larger
            of its two.

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
    signals = np.empty((len(qd), len(columns)))
    for k, (term, joints) in enumerate(columns):
        at = list(joints)
        signals[:, k] = term_signal(
            term, qd[:, at].sum(axis=1), qdd[:, at].sum(axis=1), float(slow[at].max())
        )
    return read_only(signals)


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
    regressor = np.zeros((len(values), joints, len(columns)))
    for k, column in enumerate(columns):
        regressor[:, list(column.joints), k] = values[:, k, None]
    return read_only(regressor)
