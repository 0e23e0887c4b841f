"""The prior of the bodies: modules from the catalogue, links by a guess of their mass per length.

A body is what its joint moves: one side of its own module, the links to its children, and the held side of
each child. The prior decides only where torques determine little, so that an error of the guess by a factor
of two does no harm.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.kinematics.frames import distal_homes, housing_homes, output_homes, proximal_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.read_only import make_read_only, read_only

# What turns with a module's output: a flange and the last wheel of the gear. Not published; a flange of
# aluminium of 36 mm by 6 mm has 16 g, the wheel and its bearing about as much.
OUTPUT_SHARE = 0.1
OUTPUT_RADIUS_M = 0.02
# Tubes and brackets of aluminium with their ends, between what joins two modules: 0.3 to 0.8 kg/m.
LINK_KG_M = 0.5
# Modules stand apart by at least their screws and a plate.
MIN_LINK_KG = 0.02
# Smallest radius of gyration, which is also the uncertainty of a place.
SMEAR_M = 0.01


def module_prior(chain: Chain, types: Sequence[ModuleType]) -> Array:
    """Return the expected pseudo-inertia of every body (n, 4, 4) in the root frame at q = 0, read-only.

    Raises:
        ValueError: there is not one type per module.
    """
    turned, held = sides_prior(chain, types)
    prior = turned.copy()
    for i in chain.linked:
        prior[chain.parent[i]] += held[i]
    return read_only(prior)


def sides_prior(chain: Chain, types: Sequence[ModuleType]) -> tuple[Array, Array]:
    """Return the side that every module's joint moves, and the held side with the link that leads to it.

    Each (n, 4, 4), pseudo-inertias in the root frame at q = 0, read-only. The link of a module on the base is
    left out: no torque depends on it.

    Raises:
        ValueError: there is not one type per module.
    """
    leaves, enters = distal_homes(chain, types), proximal_homes(chain, types)
    turned, held = _module_sides(chain, types)
    for i in chain.linked:
        held[i] += _link(leaves[chain.parent[i]][:3, 3], enters[i][:3, 3])
    make_read_only((turned, held))
    return turned, held


def modules_alone(chain: Chain, types: Sequence[ModuleType], modules: Sequence[int]) -> Array:
    """Return the pseudo-inertia of every body (n, 4, 4), of some modules by their types and without links.

    In the root frame at q = 0, read-only. What they have on the base is left out.

    Raises:
        ValueError: there is not one type per module.
    """
    turned, held = _module_sides(chain, types)
    bodies = np.zeros_like(turned)
    for i in modules:
        bodies[i] += turned[i]
        if chain.parent[i] != BASE:
            bodies[chain.parent[i]] += held[i]
    return read_only(bodies)


def _module_sides(chain: Chain, types: Sequence[ModuleType]) -> tuple[Array, Array]:
    """Return the side that every module's joint moves, and the other one, (n, 4, 4) each."""
    housings, outputs = housing_homes(chain, types), output_homes(chain, types)
    turned, held = np.zeros((2, len(chain.serials), 4, 4))
    for i, kind in enumerate(types):
        sides = _housing(kind, housings[i]), _output(kind, outputs[i])
        turned[i], held[i] = sides if chain.reversed[i] else sides[::-1]
    return turned, held


def _housing(kind: ModuleType, home: Array) -> Array:
    ixx, iyy, izz, ixy, ixz, iyz = kind.inertia
    inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    share = 1.0 - OUTPUT_SHARE
    spread = share * (0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return _lump(
        share * kind.mass_kg, home @ np.array([*kind.com_xyz, 1.0]), home[:3, :3] @ spread @ home[:3, :3].T
    )


def _output(kind: ModuleType, home: Array) -> Array:
    mass = OUTPUT_SHARE * kind.mass_kg
    # A disc across the axis: m r^2 / 4 along each of its directions.
    across = np.eye(3) - np.outer(home[:3, 2], home[:3, 2])
    return _lump(mass, home[:, 3], 0.25 * mass * OUTPUT_RADIUS_M**2 * across)


def _link(begin: Array, end: Array) -> Array:
    """Return a straight rod between two faces."""
    along = end - begin
    mass = max(LINK_KG_M * float(np.linalg.norm(along)), MIN_LINK_KG)
    return _lump(mass, np.append(0.5 * (begin + end), 1.0), mass / 12.0 * np.outer(along, along))


def _lump(mass_kg: float, centre: Array, spread: Array) -> Array:
    """Return the pseudo-inertia of a mass about a centre (4,), its second moments `spread` (3, 3) smeared."""
    pseudo = mass_kg * np.outer(centre, centre)
    pseudo[:3, :3] += spread + mass_kg * SMEAR_M**2 * np.eye(3)
    return np.asarray(pseudo)
