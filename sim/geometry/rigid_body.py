"""Mass, centre of mass and inertia of a rigid body; transforms and sums of bodies."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from module_agent.model.perturbation import skew
from module_agent.model.read_only import read_only
from sim.geometry.pose import Array


class RigidBody(NamedTuple):
    """A rigid body in some frame: mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2]."""

    mass_kg: float
    com_m: Array
    inertia_kg_m2: Array


NOTHING = RigidBody(0.0, read_only(np.zeros(3)), read_only(np.zeros((3, 3))))


def tensor(ixx: float, iyy: float, izz: float, ixy: float, ixz: float, iyz: float) -> Array:
    """Return the symmetric (3, 3) tensor of six components, in the catalogue's order."""
    return read_only(np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]))


def moved(body: RigidBody, transform: Array) -> RigidBody:
    """Return the body in the frame in which its own frame has the pose `transform` (4, 4)."""
    rotation = transform[:3, :3]
    com = rotation @ body.com_m + transform[:3, 3]
    return RigidBody(body.mass_kg, read_only(com), read_only(rotation @ body.inertia_kg_m2 @ rotation.T))


def about_origin(body: RigidBody) -> Array:
    """Return the inertia about the frame's origin instead of the centre of mass (parallel axes), (3, 3)."""
    c = skew(body.com_m)
    return body.inertia_kg_m2 - body.mass_kg * c @ c


def joined(bodies: Iterable[RigidBody]) -> RigidBody:
    """Return the sum of bodies given in one frame; a body of negative mass is subtracted."""
    parts = [b for b in bodies if b.mass_kg != 0.0]
    mass = sum(b.mass_kg for b in parts)
    if mass == 0.0:
        return NOTHING
    com = np.sum([b.mass_kg * b.com_m for b in parts], axis=0) / mass
    whole = np.sum([about_origin(b) for b in parts], axis=0)
    c = skew(com)
    return RigidBody(mass, read_only(com), read_only(whole + mass * c @ c))


def negative(body: RigidBody) -> RigidBody:
    """Return the body of negative mass, which `joined` subtracts."""
    return RigidBody(-body.mass_kg, body.com_m, read_only(-body.inertia_kg_m2))


def parameters(body: RigidBody) -> Array:
    """Return [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz] about the origin, the ten parameters of eq. 25."""
    inertia = about_origin(body)
    upper = inertia[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return read_only(np.concatenate([[body.mass_kg], body.mass_kg * body.com_m, upper]))
