"""A robot's own URDF with other bodies; what another program makes of it is pinocchio's."""

from pathlib import Path

import numpy as np
import pinocchio as pin

from coordinator.description.urdf_reader import read_urdf
from coordinator.description.urdf_update import fitted_urdf_text
from coordinator.dynamics.pseudo_inertia import bodies_in_frames, pseudo_inertia

HELD = {"wrist": 1.2, "finger": 0.04}


def link(name: str, mass_kg: float, centre_m: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre_m} 0.01 0"/><mass value="{mass_kg}"/>'
        '<inertia ixx="0.01" iyy="0.02" izz="0.015" ixy="0.001" ixz="0" iyz="0"/></inertial></link>'
    )


def joint(name: str, parent: str, child: str, kind: str, axis: str, x_m: float) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x_m} 0 0" rpy="0.1 0.2 0.3"/><axis xyz="{axis}"/>'
        '<limit lower="-3" upper="3" effort="50" velocity="3"/><dynamics damping="1"/></joint>'
    )


def test_what_held_joints_carry_is_on_the_body_before_them_and_they_are_fixed_there(tmp_path: Path) -> None:
    """A movable link without mass would make the mass matrix of every other program singular."""
    path, out = tmp_path / "arm.urdf", tmp_path / "fitted.urdf"
    path.write_text(
        '<robot name="arm">'
        + link("base", 1.0, 0.0)
        + link("upper", 2.0, 0.2)
        + link("lower", 1.5, 0.2)
        + link("hand", 1.0, 0.1)
        + link("pad", 0.8, 0.05)
        + joint("shoulder", "base", "upper", "revolute", "0 1 0", 0.0)
        + joint("elbow", "upper", "lower", "revolute", "0 1 0", 0.4)
        + joint("wrist", "lower", "hand", "revolute", "0 1 1", 0.4)
        + joint("finger", "hand", "pad", "prismatic", "1 0 0", 0.2)
        + "</robot>"
    )
    robot = read_urdf(path, held=HELD)
    assert robot.phi is not None
    bodies = bodies_in_frames(
        np.stack([pseudo_inertia(one) for one in robot.phi.reshape(-1, 10)]), robot.homes
    )
    text = fitted_urdf_text(robot, bodies, np.zeros((2, 3)))
    assert "Fixed, as they were held: wrist, finger." in text
    out.write_text(text)

    whole, fitted = (pin.buildModelFromUrdf(str(one)) for one in (path, out))
    assert [fitted.names[k] for k in range(1, fitted.njoints)] == ["shoulder", "elbow"]
    rng, still = np.random.default_rng(1), np.zeros(2)
    for q, qd, qdd in rng.uniform(-2.0, 2.0, (20, 3, 2)):
        theirs = pin.rnea(fitted, fitted.createData(), q, qd, qdd)
        held = np.concatenate([q, list(HELD.values())])
        ours = pin.rnea(
            whole, whole.createData(), held, np.concatenate([qd, still]), np.concatenate([qdd, still])
        )
        np.testing.assert_allclose(theirs, ours[:2], atol=1e-9)
    # Written again, it stays as it is.
    again = read_urdf(out)
    assert again.phi is not None
    np.testing.assert_allclose(again.phi, robot.phi, atol=1e-9)
