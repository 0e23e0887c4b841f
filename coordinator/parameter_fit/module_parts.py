"""A robot's bodies as sums of module parts, which stay the same when the modules are assembled differently.

Body i of a robot is the moving side of module i, and of every module k on it the side that is fixed to body i
("held"), with the link that leads to module k. These parts do not depend on the assembly as long as every
link stays with the module that it leads to. Their parameters are in the frame of the module's IMU at q = 0,
whose pose is part of the identified chain, so that phi_bodies = T phi_parts. No torque depends on the part
that is fixed to the base.

A module that is mounted reversed holds its output with the link and turns its housing: these are other parts.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.dynamics.inertia_prior import sides_prior
from coordinator.dynamics.pseudo_inertia import parameter_transform, parameters
from coordinator.parameter_fit.base_parameters import Columns, inertial_columns
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.read_only import read_only
from module_agent.model.regressor import PER_BODY

Role = Literal["turned", "held"]


class Part(NamedTuple):
    """One part of a module, mounted forward or reversed."""

    serial: str
    role: Role
    reversed: bool

    @property
    def name(self) -> str:
        """Its name: "J1 turned", "J2 held, reversed"."""
        return f"{self.serial} {self.role}" + (", reversed" if self.reversed else "")


def parts_of(chains: Iterable[Chain]) -> tuple[Part, ...]:
    """Return the parts of all these robots, each once and sorted."""
    return tuple(sorted({part for chain in chains for _, part, _ in _sides(chain)}))


def bodies_from_parts(chain: Chain, parts: Sequence[Part]) -> Array:
    """Return the matrix T (10 n, 10 p), read-only, from parts to the bodies of a chain.

    phi_bodies = T phi_parts, the bodies' in the root frame as in `torque_regressor`, a part's in the frame of
    its module's IMU at q = 0.

    Raises:
        ValueError: a part of the chain is not among them.
    """
    place = {part: k for k, part in enumerate(parts)}
    transform = np.zeros((PER_BODY * len(chain.serials), PER_BODY * len(parts)))
    for k, part, body in _sides(chain):
        if part not in place:
            raise ValueError(f"{part.name} is not among the {len(parts)} parts")
        if body != BASE:
            transform[_ten(body), _ten(place[part])] = parameter_transform(chain.imu_home[k])
    return read_only(transform)


def _sides(chain: Chain) -> Iterator[tuple[int, Part, int]]:
    """Yield every part, the index of its module, and that of the body that it belongs to, or `BASE`."""
    for k, (serial, backwards) in enumerate(zip(chain.serials, chain.reversed, strict=True)):
        yield k, Part(serial, "turned", bool(backwards)), k
        yield k, Part(serial, "held", bool(backwards)), chain.parent[k]


def likely_parts(chain: Chain, types: Sequence[ModuleType], phi: ArrayLike) -> Array:
    """Return likely parameters (20 n,) of the parts of one chain, in the order of `parts_of([chain])`.

    Torques determine a body as a whole. Its parts are those of the catalogue, and the difference of the body
    from their sum is shared out in proportion to their masses, so that T `likely_parts` = phi. Read-only.

    Args:
        chain: n joints. types: their modules'. phi: (10 n,) bodies in the root frame.
    """
    turned, held = (np.stack([parameters(one) for one in side]) for side in sides_prior(chain, types))
    bodies = np.asarray(phi, dtype=float).reshape(-1, PER_BODY)
    expected = turned.copy()
    for k in chain.linked:
        expected[chain.parent[k]] += held[k]
    surplus = (bodies - expected) / expected[:, :1]
    place = {part: k for k, part in enumerate(parts_of([chain]))}
    phi_parts = np.zeros((len(place), PER_BODY))
    for k, part, body in _sides(chain):
        own = turned[k] if part.role == "turned" else held[k]
        whole = own + own[0] * surplus[body] if body != BASE else own
        phi_parts[place[part]] = parameter_transform(np.linalg.inv(chain.imu_home[k])) @ whole
    return read_only(phi_parts.ravel())


def part_columns(parts: Sequence[Part]) -> Columns:
    """Return what the 10 p columns of `bodies_from_parts` are: those of a body each, named by the part."""
    columns = inertial_columns(len(parts))
    kinds = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
    return columns._replace(names=tuple(f"{kind}({part.name})" for part in parts for kind in kinds))


def _ten(which: int) -> slice:
    return slice(PER_BODY * which, PER_BODY * (which + 1))
