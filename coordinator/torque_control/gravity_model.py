"""The gravity torques of a robot, from the result of its identification."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from coordinator.baseline.baseline_robot import BaselineError
from coordinator.description.urdf_writer import link_homes
from coordinator.dynamics.pseudo_inertia import parameter_transform
from coordinator.identification.result import ModuleBodyPart, Result
from coordinator.recording.run_folder import RESULT
from coordinator.recording.versions import current_run
from module_agent.model.chain import Array, Chain
from module_agent.model.model_faults import first_fault
from module_agent.model.read_only import read_only
from module_agent.model.regressor import inverse_dynamics


class GravityModel(NamedTuple):
    """A robot of n joints: its name, its modules' types in the chain's order, its parameters (10 n,).

    suspicions: why it is not to be believed as usual.
    """

    robot: str
    types: tuple[str, ...]
    chain: Chain
    phi: Array
    suspicions: tuple[str, ...] = ()

    def effort_nm(self, q_rad: ArrayLike, qd_rad_s: ArrayLike) -> Array:
        """Return the spring torques (n,) [Nm] at positions and velocities (n,) without acceleration.

        These are C(q, qd) qd + g(q): eq. 28 with qdd = 0.
        """
        q = np.asarray(q_rad, dtype=float)[None]
        rate = np.asarray(qd_rad_s, dtype=float)[None]
        return np.asarray(inverse_dynamics(self.chain, self.phi, q, rate, np.zeros_like(q))[0])


def read_result(folder: Path) -> Result:
    """Read the result of a run, or of its current version, from its folder.

    Raises:
        BaselineError: the folder holds no result, or one that cannot be read.
        VersionError: see `current_run`.
    """
    path = current_run(folder) / RESULT
    if not path.is_file():
        raise BaselineError(f"{folder} holds no {RESULT}: give the folder of a run that has finished")
    try:
        return Result.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BaselineError(f"{path} is no result of a run: {first_fault(error)}") from error


def gravity_model(folder: Path, suspect: bool = False) -> GravityModel:
    """Read the gravity model of a robot from the folder of a run.

    The parameters are the physically consistent ones where the result has them: they stay plausible in poses
    that were never measured. suspect: take a result too that is not to be believed as usual.

    Raises:
        BaselineError: the folder holds no result, one without dynamics, or one that is suspect.
    """
    result = read_result(folder)
    why = "; ".join(result.suspicions)
    if result.dynamics is None:
        raise BaselineError(
            f"the result in {folder} has no inertial parameters: {why or 'the run had --no-dynamics'}; "
            "identify the robot again"
        )
    if why and not suspect:
        raise BaselineError(
            f"the result in {folder} is not to be believed as usual: {why}. Identify the robot again, or "
            "move it by this model nevertheless, with --suspect"
        )
    return gravity_model_of_result(result)


def gravity_model_of_result(result: Result) -> GravityModel:
    """Return the gravity model of the robot of a result.

    Raises:
        ValueError: the result has no dynamics.
    """
    dynamics = result.dynamics
    if dynamics is None:
        raise ValueError("a result without dynamics has no inertial parameters")
    chain = result.chain.chain()
    phi = np.array(dynamics.phi)
    if dynamics.bodies is not None:
        by_serial = {one.serial: one for one in dynamics.bodies.bodies}
        pairs = zip(chain.serials, link_homes(chain), strict=True)
        phi = np.concatenate([parameter_transform(home) @ _about_origin(by_serial[s]) for s, home in pairs])
    types = tuple(result.types[s] for s in chain.serials)
    return GravityModel(result.robot, types, chain, read_only(phi), tuple(result.suspicions))


def _about_origin(one: ModuleBodyPart) -> Array:
    """Return a body's ten parameters in its link's frame: the inertia about the origin (parallel axes)."""
    centre, inertia = np.array(one.com_m), np.array(one.inertia_kg_m2)
    inertia = inertia + one.mass_kg * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[one.mass_kg], one.mass_kg * centre, inertia[np.triu_indices(3)]])
