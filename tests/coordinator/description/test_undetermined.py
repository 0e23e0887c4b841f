"""What torques alone do not determine is marked in the files; all else is right within its claim."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.description.hrdf_writer import write_hrdf
from coordinator.description.urdf_reader import read_urdf
from coordinator.description.urdf_writer import link_homes, write_urdf
from coordinator.dynamics.pseudo_inertia import parameter_transform
from coordinator.identification.inertia.robot_bodies import RobotBodies, robot_bodies
from coordinator.identification.result import IdentifiabilityPart, undetermined
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.systematic_errors import scale_effects
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale
from module_agent.model.information import gather
from module_agent.model.regressor import PER_BODY, inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

ROBOTS = sorted(path.stem for path in (Path(__file__).parents[3] / "sim" / "robots").glob("*.toml"))
SCALE = 0.02


def bodies_of(name: str) -> RobotBodies:
    """Return a robot's bodies from 600 samples at random, by torque sensors whose scales are 2 % off."""
    robot, rng = load_robot(name), default_rng(8)
    chain = true_chain(robot)
    joints = len(chain.serials)
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 600, joints)) * np.array([3.0, 2.0, 10.0])[:, None, None]
    tau = inverse_dynamics(chain, true_inertia(robot), q, qd, qdd)
    tau = tau * (1.0 + SCALE * rng.normal(size=joints)) + 0.005 * rng.normal(size=tau.shape)
    information = gather(chain, q, qd, qdd, tau)
    effects = scale_effects(information, TorqueScale(np.zeros(joints), SCALE**2 * np.eye(joints)))
    types = build_tree(robot).types
    return robot_bodies(information, chain, types, solve_information(information), 1.0, effects)


def marks(bodies: RobotBodies) -> dict[str, tuple[str, ...]]:
    parts = [
        IdentifiabilityPart.of(
            one, parameter=one.name, serial=bodies.serials[k // PER_BODY], identifiability=one.kind
        )
        for k, one in enumerate(bodies.identifiabilities)
    ]
    return undetermined(parts)


@pytest.mark.parametrize("name", ROBOTS)
def test_what_is_not_marked_is_the_built_robots(name: str, tmp_path: Path) -> None:
    robot, bodies = load_robot(name), bodies_of(name)
    chain, marked = true_chain(robot), marks(bodies)
    assert bodies.fit is not None
    write_urdf(tmp_path / "robot.urdf", chain, bodies.fit.phi, undetermined=marked)
    written = read_urdf(tmp_path / "robot.urdf")
    assert written.phi is not None
    pulls: list[float] = []
    for i, (frame, home) in enumerate(zip(bodies.frames, link_homes(chain), strict=True)):
        at = written.chain.serials.index(f"joint_{chain.serials[i]}")
        # The file's root is upright; its links are the chain's.
        into = parameter_transform(np.linalg.inv(frame) @ home @ np.linalg.inv(written.homes[at]))
        own = into @ written.phi.reshape(-1, PER_BODY)[at]
        true = parameter_transform(np.linalg.inv(frame)) @ true_inertia(robot)[i]
        for k, one in enumerate(bodies.identifiabilities[PER_BODY * i : PER_BODY * (i + 1)]):
            if one.name not in marked.get(chain.serials[i], ()):
                assert one.sigma is not None
                pulls.append((own[k] - true[k]) / one.sigma)
        # On a fixed base no torque depends on a mass alone: the catalogue divides it between neighbours.
        assert f"m{i + 1}" in marked[chain.serials[i]]
    assert np.abs(pulls).max(initial=0.0) < 4.0


def test_a_comment_names_them_in_both_files(tmp_path: Path) -> None:
    robot = load_robot("a2085_03")
    chain, types = true_chain(robot), build_tree(robot).types
    phi, marked = true_inertia(robot).ravel(), {chain.serials[1]: ("m2", "I2xx")}
    texts = []
    for some in ({}, marked):
        write_urdf(tmp_path / "robot.urdf", chain, phi, undetermined=some)
        write_hrdf(tmp_path / "robot.hrdf", chain, types, phi, undetermined=some)
        texts.append([(tmp_path / name).read_text() for name in ("robot.urdf", "robot.hrdf")])
    for without, text in zip(*texts, strict=True):
        assert "do not determine" not in without
        assert text.count("Torques alone do not determine m2, I2xx of this body") == 1
        # Readers see the same robot.
        assert [e.attrib for e in ElementTree.fromstring(text).iter()] == [
            e.attrib for e in ElementTree.fromstring(without).iter()
        ]
    body = ElementTree.fromstring(
        texts[1][0], ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    ).find(f"link[@name='body_{chain.serials[1]}']")
    assert body is not None
    assert "do not determine m2" in str(next(iter(body)).text)
