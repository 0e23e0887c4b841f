"""A known robot brought up to date: by a session that looked closely at what is other, briefly at the rest.

Parts that are as they were known keep their geometry and its covariance: of a part the session only tells
where it is. With the increments of all modules d = B x + D e, x those of the parts and e the known errors
within them, the session's information L gives x = -(B' L B)^-1 B' L D e: least squares with parameters that
are considered, but not estimated anew (Schmidt, 1966; Tapley, Schutz and Born, Statistical Orbit
Determination, 6.2). That is on purpose: errors of the IMUs are common to both sessions, so that a second look
makes the lengths within a part no surer.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.baseline.difference import difference
from coordinator.batch_estimation.estimator import UNKNOWN_ABOVE
from coordinator.identification.identified import Kinematics
from coordinator.kinematics.chain_estimate import ChainEstimate
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import adjoint, apply_perturbation, perturbation_between
from module_agent.model.read_only import frozen

# A direction that a known part does not tell is this uncertain, in rad or in m.
UNTOLD = 1.0


def placed(known: ChainEstimate, found: ChainEstimate, parts: Sequence[Sequence[str]]) -> ChainEstimate:
    """Put the known parts where a session finds them.

    Args:
        known: the robot as it was known.
        found: the robot as the session alone tells it; its root is the frame.
        parts: serials that hang together as known, the topmost first; together all of `found`'s.

    Raises:
        ValueError: a part has a module that the known robot has not.
    """
    chain = _with_parts(known.chain, found.chain, parts)
    apart = perturbation_between(found.chain, chain)
    within, own = _within(known, chain, parts)
    joint = _rigidly(chain, parts)
    session = _information(found)
    inner = joint.T @ session @ joint
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    told = values > UNKNOWN_ABOVE**-2
    spread = (vectors[:, told] / values[told]) @ vectors[:, told].T
    # Of the whole, what the known parts' errors do with the places of the parts.
    carried = own - joint @ spread @ joint.T @ session @ own
    moved = apply_perturbation(chain, joint @ (-spread @ joint.T @ session @ apart))
    untold = joint @ vectors[:, ~told]
    return _report(
        moved._replace(gravity=found.chain.gravity),
        joint @ spread @ joint.T + carried @ within @ carried.T,
        untold,
    )


def _with_parts(known: Chain, found: Chain, parts: Sequence[Sequence[str]]) -> Chain:
    """Return the found chain with every part as it is known, its topmost module where it was found."""
    index, before = _index(found), _index(known)
    axis, point, home = found.axis.copy(), found.point.copy(), found.imu_home.copy()
    for part in parts:
        if len(part) == 1:
            continue
        missing = [s for s in part if s not in before]
        if missing:
            raise ValueError(f"the known robot has no module {', '.join(missing)}")
        frame = _frame(known, found, part[0])
        for serial in part[1:]:
            k, j = index[serial], before[serial]
            axis[k] = frame[:3, :3] @ known.axis[j]
            point[k] = frame[:3, :3] @ known.point[j] + frame[:3, 3]
            home[k] = frame @ known.imu_home[j]
    return found._replace(axis=frozen(axis), point=frozen(point), imu_home=frozen(home))


def _frame(known: Chain, found: Chain, top: str) -> Array:
    """Return the pose (4, 4) of the known root frame in the found one, by a part's topmost module."""
    there, here = known.imu_home[_index(known)[top]], found.imu_home[_index(found)[top]]
    return np.asarray(here @ np.linalg.inv(there))


def _within(known: ChainEstimate, chain: Chain, parts: Sequence[Sequence[str]]) -> tuple[Array, Array]:
    """Return the covariance of the known robot's errors (k, k), and how they displace the modules (6 n, k).

    A part's topmost module is where the session finds it: only what is against it counts.
    """
    before, index = _index(known.chain), _index(chain)
    size = known.covariance.shape[0]
    untold = known.null_basis
    covariance = known.covariance + UNTOLD**2 * untold @ untold.T
    own = np.zeros((6 * len(chain.serials), size))
    for part in parts:
        if len(part) == 1:
            continue
        carry = adjoint(_frame(known.chain, chain, part[0]))
        top = 6 * before[part[0]]
        for serial in part[1:]:
            row, column = 6 * index[serial], 6 * before[serial]
            own[row : row + 6, column : column + 6] += carry
            own[row : row + 6, top : top + 6] -= carry
    return covariance, own


def _rigidly(chain: Chain, parts: Sequence[Sequence[str]]) -> Array:
    """Return the increments (6 n, 6 (p - 1)) by twists of all parts but the root's, the frame."""
    index = _index(chain)
    moving = [part for part in parts if part[0] != chain.serials[0]]
    found = np.zeros((6 * len(chain.serials), 6 * len(moving)))
    for column, part in enumerate(moving):
        for serial in part:
            row = 6 * index[serial]
            found[row : row + 6, 6 * column : 6 * column + 6] = np.eye(6)
    return found


def _information(found: ChainEstimate) -> Array:
    """Return the information (6 n, 6 n) of the session, none along what it does not know."""
    values, vectors = np.linalg.eigh(found.covariance)
    # What is unknown has no variance at all, but for rounding.
    known = values > 1e-13 * values.max()
    return np.asarray((vectors[:, known] / values[known]) @ vectors[:, known].T)


def _report(chain: Chain, covariance: Array, untold: Array) -> ChainEstimate:
    """Split what is known from what is not: `untold`, and where the covariance is wide."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    wide = values > UNKNOWN_ABOVE**2
    hidden = np.concatenate([untold, vectors[:, wide]], axis=1)
    full, sizes, _ = np.linalg.svd(np.column_stack([hidden, np.zeros(len(hidden))]), full_matrices=False)
    basis = full[:, sizes > 1e-6]
    seen = np.eye(len(covariance)) - basis @ basis.T
    kept = seen @ covariance @ seen
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(0.5 * (kept + kept.T)), 0.0))
    used = spread[spread > 1e-9]
    return ChainEstimate(
        chain=chain,
        covariance=frozen(0.5 * (kept + kept.T)),
        null_basis=frozen(basis),
        rank=len(covariance) - 6 - basis.shape[1],
        condition=float(used.max() / used.min()) if used.size else float("inf"),
    )


def _index(chain: Chain) -> dict[str, int]:
    return {serial: k for k, serial in enumerate(chain.serials)}


def updated(known: Kinematics, found: Kinematics) -> Kinematics:
    """Return a session's kinematics with the known robot's geometry wherever nothing is other."""
    other = difference(known.topology, found.topology)
    estimate = placed(known.fit, found.fit, other.parts)
    notes = (*(line for line in other.words()), *found.notes)
    return found._replace(refinement=found.refinement._replace(estimate=estimate), notes=notes)
