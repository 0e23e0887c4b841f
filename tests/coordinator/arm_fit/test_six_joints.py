"""An arm of six joints, simulated by another hand (PyBullet) with friction that grows with the load."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pybullet
import pytest
from numpy.random import default_rng

from coordinator.arm_fit.fit_dynamics import ArmFit, fit_dynamics
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.parameter_fit.base_parameters import into_frames
from module_agent.model.chain import Array

# Tests of this file share one fit: they stay in one process.
pytestmark = pytest.mark.xdist_group("six_joints")

JOINTS = tuple(f"j{i}" for i in range(1, 7))
MASSES = (8.0, 5.0, 3.5, 2.0, 1.2, 0.5)
# Places and axes of a usual arm: an upright waist, two joints across, and a wrist.
PLACES = ("0 0 0.3", "0.05 0 0.2", "0 0 0.4", "0.04 0 0.1", "0.3 0 0", "0.08 0 0")
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
CENTRES = (
    "0.02 0.01 0.1",
    "0.01 0.03 0.2",
    "0.05 0.02 0.05",
    "0.15 0 0.01",
    "0.04 0.005 0",
    "0.02 0.01 0.015",
)
# Rotor, viscous and Coulomb friction, offset, and the share of the load.
IA = np.array([0.4, 0.5, 0.3, 0.1, 0.08, 0.05])
FV = np.array([4.0, 5.0, 3.0, 1.0, 0.8, 0.5])
FC = np.array([3.0, 4.0, 2.5, 1.0, 0.8, 0.5])
OFFSET = np.array([0.1, -0.2, 0.1, 0.05, -0.05, 0.02])
FL = np.array([0.0, 0.15, 0.2, 0.0, 0.0, 0.0])
# Friction turns over within this speed, about 1 % of the top speeds.
SLOW_RAD_S = 0.02
NOISE_NM = np.array([0.5, 0.5, 0.4, 0.15, 0.12, 0.08])
RATE_HZ, SECONDS = 500.0, 20.0


class Simulated(NamedTuple):
    urdf: Path
    npz: Path
    qd_rad_s: Array
    noise_nm: Array


def urdf_text() -> str:
    links, joints = ['<link name="l0"/>'], []
    for i, name in enumerate(JOINTS, start=1):
        mass, ixx = MASSES[i - 1], 0.01 * MASSES[i - 1]
        links.append(
            f'<link name="l{i}"><inertial><mass value="{mass}"/><origin xyz="{CENTRES[i - 1]}"/><inertia '
            f'ixx="{ixx}" iyy="{1.2 * ixx}" izz="{0.8 * ixx}" ixy="0" ixz="{0.1 * ixx}" iyz="0"/>'
            "</inertial></link>"
        )
        joints.append(
            f'<joint name="{name}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
            f'<origin xyz="{PLACES[i - 1]}"/><axis xyz="{AXES[i - 1]}"/>'
            '<limit lower="-3" upper="3" effort="500" velocity="10"/></joint>'
        )
    return "\n".join(['<robot name="six">', *links, *joints, "</robot>"])


def reference(t: Array) -> tuple[Array, Array, Array]:
    rng = default_rng(4)
    rate = 2.0 * np.pi * np.array([0.1, 0.23, 0.41, 0.67, 0.9])[:, None]
    size, phase = rng.uniform(0.1, 0.35, (5, 6)), rng.uniform(0.0, 6.0, (5, 6))
    angle = rate * t[:, None, None] + phase
    waves = (np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
    q, qd, qdd = (np.sum(size * wave, axis=1) for wave in waves)
    return q, qd, qdd


def simulated_motion(urdf: Path) -> tuple[Array, Array]:
    """Track the reference by computed torque; return positions (m, 6) and the torques (m, 6) that did it."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        arm = pybullet.loadURDF(
            str(urdf), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        pybullet.setTimeStep(1.0 / RATE_HZ, physicsClientId=client)
        joints = list(range(6))
        for joint in (-1, *joints):
            pybullet.changeDynamics(
                arm, joint, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, physicsClientId=client
            )
        pybullet.setJointMotorControlArray(
            arm, joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * 6, physicsClientId=client
        )
        q_ref, qd_ref, qdd_ref = reference(np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ)
        for joint in joints:
            pybullet.resetJointState(arm, joint, q_ref[0, joint], qd_ref[0, joint], physicsClientId=client)
        q, tau = np.empty_like(q_ref), np.empty_like(q_ref)
        for k in range(len(q_ref)):
            states = pybullet.getJointStates(arm, joints, physicsClientId=client)
            q[k], qd = (np.array([state[part] for state in states]) for part in (0, 1))
            pull = qdd_ref[k] + 400.0 * (q_ref[k] - q[k]) + 40.0 * (qd_ref[k] - qd)
            tau[k] = pybullet.calculateInverseDynamics(
                arm, list(q[k]), list(qd), list(pull), physicsClientId=client
            )
            pybullet.setJointMotorControlArray(
                arm, joints, pybullet.TORQUE_CONTROL, forces=list(tau[k]), physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
    finally:
        pybullet.disconnect(client)
    return q, tau


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    folder = tmp_path_factory.mktemp("six")
    urdf, npz = folder / "six.urdf", folder / "six.npz"
    urdf.write_text(urdf_text())
    q, rigid = simulated_motion(urdf)
    qd = np.gradient(q, axis=0) * RATE_HZ
    qdd = np.gradient(qd, axis=0) * RATE_HZ
    direction = np.tanh(qd / SLOW_RAD_S)
    tau = rigid + IA * qdd + FV * qd + direction * (FC + FL * np.abs(rigid)) + OFFSET
    rng = default_rng(6)
    noise = NOISE_NM * rng.normal(size=q.shape)
    measured = q + 7e-6 * rng.normal(size=q.shape)
    np.savez(npz, position_rad=measured, torque=tau + noise, sample_rate_hz=RATE_HZ)
    return Simulated(urdf, npz, qd, noise)


@pytest.fixture(scope="module")
def fit(simulated: Simulated) -> ArmFit:
    return fit_dynamics(simulated.urdf, simulated.npz)


def test_friction_that_grows_with_the_load_is_kept_where_it_is(fit: ArmFit) -> None:
    kept = [trial.name for trial in fit.report.trials if trial.kept]
    assert {name for name in kept if name.startswith("Fl")} == {"Fl2", "Fl3"}
    assert fit.report.fit.coupled == []


def test_all_parameters_are_within_three_standard_deviations(fit: ArmFit) -> None:
    robot: UrdfRobot = fit.robot
    assert robot.phi is not None
    truth = {
        f"{symbol}{i + 1}": values[i]
        for i in range(6)
        for symbol, values in (("Ia", IA), ("Fv", FV), ("Fc", FC), ("offset", OFFSET), ("Fl", FL))
    }
    drives = [truth.get(name, 0.0) for name in fit.base.columns.names[60:]]
    grouping = into_frames(fit.base.grouping, np.linalg.inv(robot.homes))
    off = (fit.base.value - grouping @ np.concatenate([robot.phi, drives])) / fit.base.sigma
    assert np.abs(off).max() < 3.0


def test_torques_that_were_held_out_are_predicted_to_the_noise(fit: ArmFit, simulated: Simulated) -> None:
    torques, recording = fit.torques, fit.report.recording
    off = torques.held_out_nm - torques.tau_raw_nm
    moving = np.abs(simulated.qd_rad_s[np.round(torques.t_s * RATE_HZ).astype(int)]) > recording.mask_rad_s
    tested = ~np.isnan(off) & moving
    for i, name in enumerate(JOINTS):
        rms, noise = (np.sqrt(np.mean(e**2)) for e in (off[tested[:, i], i], simulated.noise_nm[:, i]))
        assert rms < 1.2 * noise, name
