"""What the joints of a known robot have to bear, from the result of the run that it is known from."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from coordinator.baseline.known_robot import BaselineError
from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import parameter_transform
from coordinator.identification.result import BodiesPart, ModuleBodyPart, Result
from coordinator.recording.run_folder import RESULT
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import inverse_dynamics


class GravityModel(NamedTuple):
    """A robot of n joints: its name, its modules' types in the chain's order, its parameters (10 n,)."""

    robot: str
    types: tuple[str, ...]
    chain: Chain
    phi: Array

    def effort_nm(self, q_rad: ArrayLike, qd_rad_s: ArrayLike) -> Array:
        """Return what the springs have to exert (n,) [Nm] at positions and velocities (n,), unaccelerated.

        That is the weight of the bodies, C(q, qd) qd + g(q): thesis eq. 28 with qdd = 0.
        """
        q = np.asarray(q_rad, dtype=float)[None]
        rate = np.asarray(qd_rad_s, dtype=float)[None]
        found: Array = inverse_dynamics(self.chain, self.phi, q, rate, np.zeros_like(q))[0]
        return found


def gravity_model(folder: Path) -> GravityModel:
    """Read what a robot weighs from the folder of a run.

    The parameters are those of real bodies where any were found: in poses that were never measured they stay
    those of something that could exist.

    Raises:
        KnownRobotError: the folder holds no result, or one without inertia.
    """
    path = folder / RESULT
    if not path.is_file():
        raise BaselineError(f"{folder} holds no {RESULT}: give the folder of a run that has finished")
    try:
        result = Result.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise BaselineError(f"{path} is no result of a run: {place}: {first['msg']}") from error
    if result.dynamics is None:
        raise BaselineError(
            f"{path} does not tell what the robot weighs: it was run with --no-dynamics; identify it again"
        )
    return weight_of(result)


def weight_of(result: Result) -> GravityModel:
    """Return what the robot of a result weighs.

    Raises:
        ValueError: the result is without inertia.
    """
    dynamics = result.dynamics
    if dynamics is None:
        raise ValueError("a result without dynamics does not tell what the robot weighs")
    chain = result.chain.chain()
    phi = np.array(dynamics.phi) if dynamics.bodies is None else _phi(chain, dynamics.bodies)
    phi.flags.writeable = False
    return GravityModel(result.robot, tuple(result.types[s] for s in chain.serials), chain, phi)


def _phi(chain: Chain, part: BodiesPart) -> Array:
    """Return the parameters (10 n,) in the root frame of bodies that are told in their links' frames."""
    by_serial = {one.serial: one for one in part.bodies}
    pairs = zip(chain.serials, link_homes(chain), strict=True)
    return np.concatenate([parameter_transform(home) @ _about_origin(by_serial[s]) for s, home in pairs])


def _about_origin(one: ModuleBodyPart) -> Array:
    """Return a body's ten parameters in its link's frame: the inertia about the origin (parallel axes)."""
    centre, inertia = np.array(one.com_m), np.array(one.inertia_kg_m2)
    inertia = inertia + one.mass_kg * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[one.mass_kg], one.mass_kg * centre, inertia[np.triu_indices(3)]])
