"""The regressor of motion as it was seen is that of a robot that has what was seen built in."""

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from coordinator.batch_estimation.imu_prediction import LinkTurn, body_motions
from coordinator.batch_estimation.sensor_data import BaseMotion
from coordinator.dynamics.body_regressor import body_tracks, track_regressor
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import inverse_dynamics, torque_regressor

SAMPLES = 40


def tree(rng: Generator, parents: tuple[int, ...]) -> Chain:
    n = len(parents)
    axis = rng.normal(size=(n, 3))
    return Chain(
        serials=tuple(f"M{i}" for i in range(n)),
        parent=parents,
        reversed=(False,) * n,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-0.4, 0.4, (n, 3)),
        imu_home=np.tile(np.eye(4), (n, 1, 1)),
        gravity=np.array([0.3, 0.0, 9.81]),
    )


def motion(rng: Generator, joints: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = rng.normal(size=(3, SAMPLES, joints)) * np.array([1.0, 2.0, 10.0])[:, None, None]
    return q, qd, qdd


@pytest.mark.parametrize("seed", range(5))
def test_without_anything_that_gives_it_is_the_rigid_robots(seed: int) -> None:
    rng = default_rng(seed)
    chain = tree(rng, (-1, 0, 0, 2, 1))
    joints = motion(rng, 5)
    tracks = body_tracks(chain, joints[0], body_motions(chain, *joints), {})
    rigid = torque_regressor(chain, *joints)
    np.testing.assert_allclose(track_regressor(tracks), rigid, rtol=0.0, atol=1e-11 * np.abs(rigid).max())


def with_hinge(chain: Chain, below: int, axis: Array, point: Array) -> Chain:
    """Return a serial chain with one more joint, which turns the link that begins at body `below`."""
    at = below + 1
    return Chain(
        (*chain.serials[:at], "hinge", *chain.serials[at:]),
        tuple(range(-1, len(chain.serials))),
        (False,) * (len(chain.serials) + 1),
        np.insert(chain.axis, at, axis, axis=0),
        np.insert(chain.point, at, point, axis=0),
        np.insert(chain.imu_home, at, np.eye(4), axis=0),
        chain.gravity,
    )


def test_a_link_that_turns_a_little_is_as_good_as_a_joint_there(rng: Generator) -> None:
    chain = tree(rng, (-1, 0, 1, 2))
    phi = rng.normal(size=40)
    joints = motion(rng, 4)
    axis, point = np.array([0.6, 0.0, 0.8]), rng.normal(size=3) * 0.2
    small = 1e-5 * rng.normal(size=(3, SAMPLES)) * np.array([1.0, 10.0, 100.0])[:, None]
    turns = {2: [LinkTurn(point, axis[None, :, None] * small[:, None, :])]}
    tracks = body_tracks(chain, joints[0], body_motions(chain, *joints, turns=turns), turns)
    seen = track_regressor(tracks) @ phi

    hinged = with_hinge(chain, 1, axis, point)
    whole = [np.insert(signal, 2, own, axis=1) for signal, own in zip(joints, small, strict=True)]
    # Of body 1 all lies beyond its link's hinge.
    bodies = np.insert(phi.reshape(4, 10), 1, np.zeros(10), axis=0)
    true = np.delete(inverse_dynamics(hinged, bodies, *whole), 2, axis=1)
    rigid = inverse_dynamics(chain, phi, *joints)
    # To first order in angles of 1e-5 rad: what is left is of second order.
    assert np.abs(true - rigid).max() > 1e3 * np.abs(true - seen).max()


def test_a_base_that_moves_shakes_all_bodies(rng: Generator) -> None:
    chain = tree(rng, (-1, 0, 1))
    phi = rng.normal(size=30)
    joints = motion(rng, 3)
    # An elevator: the base accelerates upwards, which is as if gravity were stronger.
    up = chain.gravity / np.linalg.norm(chain.gravity)
    felt = np.outer(rng.normal(size=SAMPLES), up)
    still = np.zeros((SAMPLES, 3))
    tracks = body_tracks(
        chain, joints[0], body_motions(chain, *joints, base_motion=BaseMotion(still, still, felt)), {}
    )
    seen = track_regressor(tracks) @ phi
    for k in range(3):
        there = chain._replace(gravity=chain.gravity + felt[k])
        true = inverse_dynamics(there, phi, *(signal[k : k + 1] for signal in joints))
        np.testing.assert_allclose(seen[k], true[0], rtol=1e-10, atol=1e-12)
