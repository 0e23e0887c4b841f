"""What planners and other simulators take from the URDF: frames, shapes, limits and losses of the modules."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from numpy.random import default_rng

from coordinator.description.module_geometry import links, placed_modules
from coordinator.description.urdf_writer import write_urdf
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.kinematics.frames import distal_homes, housing_homes, output_homes
from module_agent.model.catalogue import module_type
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.regressor import inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

ROBOTS = sorted(path.stem for path in (Path(__file__).parents[3] / "sim" / "robots").glob("*.toml"))


def written(name: str, folder: Path) -> tuple[Path, Chain]:
    robot = load_robot(name)
    chain, path = true_chain(robot), folder / "robot.urdf"
    write_urdf(path, chain, true_inertia(robot), name, build_tree(robot).types)
    return path, chain


def displaced(chain: Chain, q_rad: Array) -> Array:
    """Displacements (n + 1, 4, 4) of all bodies at positions (n,); the last is that of the base, `BASE`."""
    return np.concatenate([body_displacements(chain, q_rad[None])[0], np.eye(4)[None]])


@pytest.mark.parametrize("name", ["a2085_04", "snake16", "tree_y"])
def test_housings_outputs_and_tips_are_frames_where_the_catalogue_has_them(name: str, tmp_path: Path) -> None:
    path, chain = written(name, tmp_path)
    types = build_tree(load_robot(name)).types
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    q = default_rng(1).uniform(-1.0, 1.0, len(chain.serials))
    angle = dict(zip((f"joint_{serial}" for serial in chain.serials), q, strict=True))
    configuration = pin.neutral(model)
    for joint, joint_name in enumerate(model.names):
        at, size = model.joints[joint].idx_q, model.joints[joint].nq
        if joint_name in angle:
            turned = angle[joint_name]
            configuration[at : at + size] = turned if size == 1 else (np.cos(turned), np.sin(turned))
    pin.framesForwardKinematics(model, data, configuration)
    base = data.oMf[model.getFrameId("base")].homogeneous
    moved = displaced(chain, q)
    housing, output, tip = (homes(chain, types) for homes in (housing_homes, output_homes, distal_homes))
    for k, serial in enumerate(chain.serials):
        turns = chain.parent[k] if chain.reversed[k] else k
        expected = {
            "housing": moved[chain.carrier(k)] @ housing[k],
            "output": moved[turns] @ output[k],
            **({"tip": moved[k] @ tip[k]} if k in chain.leaves else {}),
        }
        for kind, pose in expected.items():
            frame = data.oMf[model.getFrameId(f"{kind}_{serial}")].homogeneous
            np.testing.assert_allclose(frame, base @ pose, atol=1e-11, err_msg=f"{kind} of {serial}")
    assert sum(frame.name.startswith("tip_") for frame in model.frames if frame.type == pin.BODY) == len(
        chain.leaves
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_is_clear_of_itself_at_home_but_for_parts_that_a_joint_joins(
    name: str, tmp_path: Path
) -> None:
    """Planners take a start in collision as an error; parent and child are left out by all of them."""
    path, chain = written(name, tmp_path)
    model = pin.buildModelFromUrdf(str(path))
    shapes = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION)
    placed = placed_modules(chain, build_tree(load_robot(name)).types)
    long = [link for link in links(chain, placed) if link.body != BASE and link.length_m > 1e-3]
    assert shapes.ngeoms == len(chain.serials) + len(long)
    body = [shape.parentJoint for shape in shapes.geometryObjects]
    for i in range(shapes.ngeoms):
        for j in range(i):
            joined = model.parents[body[i]] == body[j] or model.parents[body[j]] == body[i]
            if body[i] != body[j] and not joined:
                shapes.addCollisionPair(pin.CollisionPair(j, i))
    distances = pin.GeometryData(shapes)
    pin.computeDistances(model, model.createData(), shapes, distances, pin.neutral(model))
    near = [result.min_distance for result in distances.distanceResults]
    assert all(distance > 0.0 for distance in near)
    assert len(near) > 0 or len(chain.serials) < 3


def test_a_folded_arm_touches_itself(tmp_path: Path) -> None:
    """The shapes are no decoration: an elbow that folds the forearm back puts it into the shoulder."""
    path, _ = written("a2085_04", tmp_path)
    model = pin.buildModelFromUrdf(str(path))
    shapes = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION)
    body = [model.names[shape.parentJoint].removeprefix("joint_") for shape in shapes.geometryObjects]
    for i in range(shapes.ngeoms):
        for j in range(i):
            if {body[i], body[j]} == {"elbow", "shoulder-yaw"}:
                shapes.addCollisionPair(pin.CollisionPair(j, i))

    def nearest_m(elbow_rad: float) -> float:
        q = pin.neutral(model)
        at = model.joints[model.getJointId("joint_elbow")].idx_q
        q[at : at + 2] = np.cos(elbow_rad), np.sin(elbow_rad)
        distances = pin.GeometryData(shapes)
        pin.computeDistances(model, model.createData(), shapes, distances, q)
        return min(result.min_distance for result in distances.distanceResults)

    assert nearest_m(0.0) > 0.1
    assert min(nearest_m(angle) for angle in np.linspace(-np.pi, np.pi, 49)) < 0.05


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16"])
def test_mujoco_converts_it_to_the_same_robot(name: str, tmp_path: Path) -> None:
    """MuJoCo's own compiler writes MJCF of the URDF; masses and the torques of gravity stay."""
    path, chain = written(name, tmp_path)
    phi = true_inertia(load_robot(name))
    model = mujoco.MjModel.from_xml_path(str(path))
    mujoco.mj_saveLastXML(str(tmp_path / "robot.xml"), model)
    converted = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    data = mujoco.MjData(converted)
    q = default_rng(2).uniform(-1.0, 1.0, len(chain.serials))
    converted.opt.gravity[:] = (0.0, 0.0, -float(np.linalg.norm(chain.gravity)))
    for serial, angle in zip(chain.serials, q, strict=True):
        data.joint(f"joint_{serial}").qpos = angle
    mujoco.mj_forward(converted, data)
    still = np.zeros((1, len(q)))
    expected = inverse_dynamics(chain, phi, q[None], still, still)[0]
    gravity = [float(data.joint(f"joint_{serial}").qfrc_bias[0]) for serial in chain.serials]
    # MJCF is written with six digits: 1e-6 of the torque of the whole mass at a metre.
    np.testing.assert_allclose(gravity, expected, atol=1e-5 * 9.81 * float(phi.reshape(-1, 10)[:, 0].sum()))
    assert np.abs(expected).max() > 0.1
    assert float(converted.body_mass.sum()) == pytest.approx(float(phi.reshape(-1, 10)[:, 0].sum()), rel=1e-5)


def test_without_dynamics_bodies_are_those_of_the_modules_make_so_that_simulators_load_them(
    tmp_path: Path,
) -> None:
    robot = load_robot("a2085_03")
    chain, kinds = true_chain(robot), build_tree(robot).types
    write_urdf(tmp_path / "robot.urdf", chain, None, module_types=kinds)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.urdf"))
    assert float(model.body_mass.sum()) == pytest.approx(
        float(sum(one[3, 3] for one in module_prior(chain, kinds))), rel=1e-6
    )
    assert "they are not identified" in (tmp_path / "robot.urdf").read_text()


def test_joints_have_the_ends_and_losses_of_their_types(tmp_path: Path) -> None:
    chain = true_chain(load_robot("thesis_171_horizontal"))
    kinds = [module_type("X5-9"), module_type("SEA-snake")]
    write_urdf(tmp_path / "robot.urdf", chain, None, module_types=kinds)
    joints = ElementTree.parse(tmp_path / "robot.urdf").getroot().findall("joint")
    turning = [joint for joint in joints if joint.get("type") != "fixed"]
    assert [joint.get("type") for joint in turning] == ["continuous", "revolute"]
    for joint, kind in zip(turning, kinds, strict=True):
        limit, losses = joint.find("limit"), joint.find("dynamics")
        assert limit is not None
        assert losses is not None
        ends = [float(limit.get(end, "nan")) for end in ("lower", "upper")]
        expected = [np.nan, np.nan] if kind.range_rad is None else list(kind.range_rad)
        np.testing.assert_array_equal(ends, expected)
        assert float(losses.get("friction", "")) == pytest.approx(kind.motor.coulomb_nm)
        assert float(losses.get("damping", "")) == pytest.approx(kind.motor.viscous_nm_s_rad)


def test_what_the_run_did_not_determine_is_marked_at_the_joint(tmp_path: Path) -> None:
    robot = load_robot("a2085_03")
    chain, path = true_chain(robot), tmp_path / "robot.urdf"
    write_urdf(path, chain, None, unknown={chain.serials[1]: ("z_mm", "rz_deg")})
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.parse(path, parser).getroot()
    marked = {
        joint.get("name"): child.text or ""
        for joint in root.findall("joint")
        for child in joint
        if child.tag is ElementTree.Comment
    }
    assert list(marked) == [f"joint_{chain.serials[1]}"]
    assert "z_mm, rz_deg" in marked[f"joint_{chain.serials[1]}"]
