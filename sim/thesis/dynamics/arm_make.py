"""What the thesis' arm of 484 mm weighs by its make: modules, link, and what its printed parameters imply.

The thesis prints the module's mass (table 2) and the length. Of the link it prints nothing: it is that of the
robot file, an aluminium profile with a bracket at each end.
"""

from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from sim.robot.robot_file import Build, Robot, load_robot
from sim.robot.robot_tree import true_inertia
from sim.thesis.dynamics.load_identification import IZZ, MCX, least_mass_kg
from sim.thesis.published import DYNAMIC_LENGTH_MM, DYNAMIC_SEARCHES, MODULE_KG

MASS = 0


class Make(NamedTuple):
    """All that the joint carries: its mass, first moment along x and moment of inertia about the axis.

    mass_kg is None if it is not known; least_kg is the least mass that the other two allow.
    """

    name: str
    mass_kg: float | None
    mcx_kg_m: float
    izz_kg_m2: float

    @property
    def least_kg(self) -> float:
        """The least mass of a body with these moments."""
        phi = np.zeros(IZZ + 1)
        phi[MCX], phi[IZZ] = self.mcx_kg_m, self.izz_kg_m2
        return least_mass_kg(phi)


class Link(NamedTuple):
    """What the printed parameters leave for the link, once the module is taken off.

    mcx_kg_m, izz_kg_m2: its moments. least_kg: the least mass with these. farthest_m: the greatest distance
    of its centre of mass from the axis.
    """

    mcx_kg_m: float
    izz_kg_m2: float
    least_kg: float
    farthest_m: float


def as_designed() -> Make:
    """Return the arm as its robot file has it, modules by the catalogue."""
    return _make("arm of the robot file", _carried_by_mass(1.0))


def with_printed_module() -> Make:
    """Return the arm with a distal module of the mass of table 2."""
    factor = MODULE_KG / _module_kg()
    return _make(f"the same with a module of {1e3 * MODULE_KG:g} g (table 2)", _carried_by_mass(factor))


def module_alone() -> Make:
    """Return a distal module of the mass of table 2 at its place, without the link."""
    # All that the joint carries is linear in the module's mass.
    by_catalogue = _carried_by_mass(2.0) - _carried_by_mass(1.0)
    return _make(f"module of {1e3 * MODULE_KG:g} g alone", MODULE_KG / _module_kg() * by_catalogue)


def printed(section: str) -> Make:
    """Return the printed parameters of section 6.3.2 or 6.3.3."""
    search = DYNAMIC_SEARCHES["vertical" if section == "6.3.2" else "horizontal"]
    return Make(f"printed in {section}", None, search.mcx_kg_m, search.izz_kg_m2)


def link_left() -> Link:
    """Return what the parameters of section 6.3.2 leave for the link, the module of table 2 taken off."""
    whole, module = printed("6.3.2"), module_alone()
    mcx, izz = whole.mcx_kg_m - module.mcx_kg_m, whole.izz_kg_m2 - module.izz_kg_m2
    return Link(mcx, izz, mcx**2 / izz, izz / mcx)


def _make(name: str, phi: Array) -> Make:
    return Make(name, float(phi[MASS]), float(phi[MCX]), float(phi[IZZ]))


def _module_kg() -> float:
    return module_type(_robot().modules[-1].type).mass_kg


def _carried_by_mass(factor: float) -> Array:
    """Return the parameters (10,) of all that the joint carries, the distal module so many times as heavy."""
    robot = _robot()
    first, last = robot.modules
    heavy = last.model_copy(update={"build": Build(mass_factor=factor)})
    plain = first.model_copy(update={"build": Build()})
    return np.asarray(true_inertia(robot.model_copy(update={"modules": (plain, heavy)})).sum(axis=0))


def _robot() -> Robot:
    return load_robot(f"thesis_{DYNAMIC_LENGTH_MM}_vertical")
