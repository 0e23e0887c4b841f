"""Update of a baseline by a session that explores what differs, and the rest only briefly.

Unchanged parts keep the geometry and covariance of the baseline; the session estimates only the poses of the
parts. With the perturbations of all modules d = B x + D e, where x are those of the parts and e the
baseline's errors within them, and the session's information L, x = -(B' L B)^-1 B' L D e: least squares with
considered parameters, which are not estimated again (Schmidt, 1966; Tapley, Schutz and Born, Statistical
Orbit Determination, 6.2). The errors of the IMUs are common to both sessions, so that a second measurement
would not make the lengths within a part more certain. The session begins with the IMUs as the baseline
measured them; that their remaining errors are in x and in e alike is neglected.
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

# Prior sigma of a direction that the baseline leaves open [rad or m].
OPEN_SIGMA = 1.0


def placed(baseline: ChainEstimate, session: ChainEstimate, parts: Sequence[Sequence[str]]) -> ChainEstimate:
    """Place the unchanged parts of a baseline at the poses that a session measures.

    Args:
        baseline: the robot before.
        session: the robot by the session alone; its root is the frame.
        parts: serials of connected unchanged modules, the topmost first; together all modules of `session`.

    Raises:
        ValueError: a part has a module that is not in the baseline.
    """
    chain = _with_parts(baseline.chain, session.chain, parts)
    apart = perturbation_between(session.chain, chain)
    within, own = _within(baseline, chain, parts)
    joint = _rigidly(chain, parts)
    measured = _information(session)
    inner = joint.T @ measured @ joint
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    determined = values > UNKNOWN_ABOVE**-2
    spread = (vectors[:, determined] / values[determined]) @ vectors[:, determined].T
    # The baseline's errors within the parts, and their effect on the poses of the parts.
    carried = own - joint @ spread @ joint.T @ measured @ own
    moved = apply_perturbation(chain, joint @ (-spread @ joint.T @ measured @ apart))
    open_basis = joint @ vectors[:, ~determined]
    return _report(
        moved._replace(gravity=session.chain.gravity),
        joint @ spread @ joint.T + carried @ within @ carried.T,
        open_basis,
    )


def _with_parts(baseline: Chain, session: Chain, parts: Sequence[Sequence[str]]) -> Chain:
    """Return the session's chain with the baseline's geometry within every part."""
    index, before = session.serials.index, baseline.serials.index
    axis, point, home = session.axis.copy(), session.point.copy(), session.imu_home.copy()
    for part in parts:
        if len(part) == 1:
            continue
        missing = [s for s in part if s not in baseline.serials]
        if missing:
            raise ValueError(f"the baseline has no module {', '.join(missing)}")
        frame = _frame(baseline, session, part[0])
        for serial in part[1:]:
            k, j = index(serial), before(serial)
            axis[k] = frame[:3, :3] @ baseline.axis[j]
            point[k] = frame[:3, :3] @ baseline.point[j] + frame[:3, 3]
            home[k] = frame @ baseline.imu_home[j]
    return session._replace(axis=frozen(axis), point=frozen(point), imu_home=frozen(home))


def _frame(baseline: Chain, session: Chain, top: str) -> Array:
    """Return the pose (4, 4) of the baseline's root frame in the session's, by a part's topmost module."""
    there, here = (chain.imu_home[chain.serials.index(top)] for chain in (baseline, session))
    return np.asarray(here @ np.linalg.inv(there))


def _within(baseline: ChainEstimate, chain: Chain, parts: Sequence[Sequence[str]]) -> tuple[Array, Array]:
    """Return the covariance of the baseline's errors (k, k), and their effect on the modules (6 n, k).

    Only errors relative to a part's topmost module count, since the session measures its pose.
    """
    before, index = baseline.chain.serials.index, chain.serials.index
    open_basis = baseline.null_basis
    covariance = baseline.covariance + OPEN_SIGMA**2 * open_basis @ open_basis.T
    own = np.zeros((6 * len(chain.serials), len(covariance)))
    for part in parts:
        if len(part) == 1:
            continue
        carry = adjoint(_frame(baseline.chain, chain, part[0]))
        top = 6 * before(part[0])
        for serial in part[1:]:
            row, column = 6 * index(serial), 6 * before(serial)
            own[row : row + 6, column : column + 6] += carry
            own[row : row + 6, top : top + 6] -= carry
    return covariance, own


def _rigidly(chain: Chain, parts: Sequence[Sequence[str]]) -> Array:
    """Return the perturbations (6 n, 6 (p - 1)) by twists of all parts but the root's, the frame."""
    moving = [part for part in parts if part[0] != chain.serials[0]]
    twists = np.zeros((6 * len(chain.serials), 6 * len(moving)))
    for column, part in enumerate(moving):
        for serial in part:
            row = 6 * chain.serials.index(serial)
            twists[row : row + 6, 6 * column : 6 * column + 6] = np.eye(6)
    return twists


def _information(session: ChainEstimate) -> Array:
    """Return the information (6 n, 6 n) of the session, zero along its unobservable directions."""
    values, vectors = np.linalg.eigh(session.covariance)
    # Unobservable directions have zero variance, except for rounding.
    informed = values > 1e-13 * values.max()
    return np.asarray((vectors[:, informed] / values[informed]) @ vectors[:, informed].T)


def _report(chain: Chain, covariance: Array, open_basis: Array) -> ChainEstimate:
    """Split the determined directions from the open ones: `open_basis`, and those of wide covariance."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    wide = values > UNKNOWN_ABOVE**2
    hidden = np.concatenate([open_basis, vectors[:, wide]], axis=1)
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


def updated(baseline: Kinematics, session: Kinematics) -> Kinematics:
    """Return a session's kinematics with the baseline's geometry wherever nothing has changed."""
    other = difference(baseline.topology, session.topology)
    estimate = placed(baseline.fit, session.fit, other.parts)
    notes = (*(line for line in other.summary()), *session.notes)
    return session._replace(refinement=session.refinement._replace(estimate=estimate), notes=notes)
