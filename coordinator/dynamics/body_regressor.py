"""The torque regressor from measured motions of bodies, without assuming a rigid chain on a fixed base.

`torque_regressor` computes every motion from the joints' positions, twice differentiated, on a base at rest
and with rigid links. Here motions and axes are given: with a moving base, compliant links or IMUs. The
regressor is the same (thesis eqs. 25-28).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_prediction import BodyMotion, LinkTurn, LinkTurns, given, turned
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.perturbation import cross
from module_agent.model.regressor import PER_BODY


class Screw(NamedTuple):
    """The screw of a joint's axis in the frame of a body that it carries: direction and moment, (3, m)
    each.
    """

    direction: Array
    moment: Array


class BodyTrack(NamedTuple):
    """One body's motion and the screws of the joints that carry it, by their index; both in its own frame.

    If the link to its first child is compliant, the frame is that beyond the link: there is the child's
    housing, the heaviest part of the body.
    """

    motion: BodyMotion
    screws: dict[int, Screw]


def body_tracks(
    chain: Chain, q_rad: Array, bodies: Sequence[BodyMotion], turns: LinkTurns
) -> list[BodyTrack]:
    """Return the tracks of all bodies.

    Args:
        chain: n joints.
        q_rad: (m, n) joint positions.
        bodies: motions, as `body_motions` returns them for the same `turns`.
        turns: rotations of compliant links, by the module that each carries.
    """
    near: list[dict[int, Screw]] = []
    tracks = []
    for i, parent in enumerate(chain.parent):
        own = chain.axis[i], np.cross(chain.point[i], chain.axis[i])
        screws = {i: Screw(*(np.repeat(part[:, None], len(q_rad), axis=1) for part in own))}
        if parent != BASE:
            for joint, screw in near[parent].items():
                screws[joint] = _carried(chain, i, q_rad[:, i], _beyond(screw, turns.get(i, ())))
        near.append(screws)
        link = turns.get(next(iter(chain.children(i)), BASE), ())
        tracks.append(
            BodyTrack(given(bodies[i], link), {joint: _beyond(s, link) for joint, s in screws.items()})
        )
    return tracks


def track_regressor(tracks: Sequence[BodyTrack]) -> Array:
    """Return the regressor (m, n, 10 n) of n bodies, as `torque_regressor` has it."""
    joints = len(tracks)
    samples = tracks[0].motion.omega.shape[1]
    regressor = np.zeros((samples, joints, PER_BODY * joints))
    for i, track in enumerate(tracks):
        for joint, screw in track.screws.items():
            regressor[:, joint, PER_BODY * i : PER_BODY * (i + 1)] = _row(track.motion, screw).T
    return regressor


def _beyond(screw: Screw, link: Sequence[LinkTurn]) -> Screw:
    """Return a screw in the frame beyond a link that turns a little about its hinge, to first order."""
    for turn in link:
        angle = turn.theta_rad[0]
        shift = -cross(angle, np.broadcast_to(turn.hinge[:, None], angle.shape))
        moment = screw.moment + cross(screw.direction, shift)
        screw = Screw(screw.direction - cross(angle, screw.direction), moment - cross(angle, moment))
    return screw


def _carried(chain: Chain, joint: int, q: Array, screw: Screw) -> Screw:
    """Return a screw in the frame that a joint turns, from the one below it."""
    axis, point = chain.axis[joint], np.broadcast_to(chain.point[joint][:, None], screw.moment.shape)
    shift = point - turned(axis, q, point)
    moved = np.stack([screw.direction, screw.moment + cross(screw.direction, shift)], axis=1)
    return Screw(*np.swapaxes(turned(axis, -q, moved), 0, 1))


def _row(motion: BodyMotion, screw: Screw) -> Array:
    """Return a joint's torque per parameter of a body, (10, m); see `regressor_kernel`."""
    (w, v), omega, alpha = screw, motion.omega, motion.alpha
    first = cross(motion.acceleration, w) + cross(v, alpha) + cross(omega, cross(omega, v))
    u = cross(w, omega)
    # Of a symmetric matrix: the products of its rows and columns, off-diagonal ones twice.
    product = w[:, None] * alpha + u[:, None] * omega
    both = product + product.swapaxes(0, 1)
    return np.stack(
        [
            np.sum(v * motion.acceleration, axis=0),
            *first,
            *(product[0, 0], both[0, 1], both[0, 2], product[1, 1], both[1, 2], product[2, 2]),
        ]
    )
