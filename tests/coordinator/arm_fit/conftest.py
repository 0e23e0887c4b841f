"""A robot of three joints, the last two of which share a drive, and recordings of it by another hand."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from numpy.random import default_rng

from module_agent.model.chain import Array

_BODY = (
    '<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{centre}"/>'
    '<inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.003" izz="0.025"/></inertial></link>'
)
_JOINT = (
    '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{place}" rpy="{turn}"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" effort="99" velocity="9"/></joint>'
)
URDF = "\n".join(
    [
        '<robot name="three"><link name="base"/>',
        _BODY.format(name="upper", mass=3.0, centre="0.02 0.01 0.1"),
        _BODY.format(name="fore", mass=2.0, centre="0.15 0 0.02"),
        _BODY.format(name="hand", mass=0.8, centre="0.05 0.02 0.06"),
        _JOINT.format(name="waist", parent="base", child="upper", place="0 0 0.3", turn="0 0 0"),
        _JOINT.format(name="elbow", parent="upper", child="fore", place="0.1 0 0.2", turn="-1.5 0 0"),
        _JOINT.format(name="wrist", parent="fore", child="hand", place="0.3 0 0", turn="1.4 0.2 0"),
        "</robot>",
    ]
)
JOINTS = ("waist", "elbow", "wrist")
# Viscous, Coulomb, offset and motor inertia joint by joint; then those of the motor of elbow and wrist.
FV, FC, OFFSET, IA = (0.8, 0.6, 0.3), (1.5, 1.2, 0.5), (0.2, -0.3, 0.1), (0.15, 0.10, 0.02)
SHARED_FV, SHARED_FC, SHARED_IA = 0.2, 0.4, 0.01
RATE_HZ = 400.0


class Recorded(NamedTuple):
    """A motion (m, 3) with its torques, and the files that hold robot and recording."""

    q_rad: Array
    tau_nm: Array
    urdf: Path
    npz: Path


def recorded(
    folder: Path,
    seconds: float = 24.0,
    noise_nm: float = 0.05,
    seed: int = 3,
    load: tuple[float, ...] = (0.0, 0.0, 0.0),
    still: tuple[int, ...] = (),
) -> Recorded:
    """Record sums of sines; torques are pinocchio's, with friction that has a plain sign."""
    rng = default_rng(seed)
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    rate = 2.0 * np.pi * rng.uniform(0.1, 1.2, (5, 3))
    phase, size = rng.uniform(0.0, 6.0, (5, 3)), rng.uniform(0.1, 0.5, (5, 3))
    angle = rate * t[:, None, None] + phase
    q = np.sum(size * np.sin(angle), axis=1)
    qd = np.sum(size * rate * np.cos(angle), axis=1)
    qdd = -np.sum(size * rate**2 * np.sin(angle), axis=1)
    q[:, still], qd[:, still], qdd[:, still] = 0.3, 0.0, 0.0
    rigid = _bodies(folder / "three.urdf", q, qd, qdd)
    tau = rigid + qdd * IA + qd * FV + np.sign(qd) * (FC + load * np.abs(rigid)) + OFFSET
    speed, pull = qd[:, 1:].sum(axis=1), qdd[:, 1:].sum(axis=1)
    tau[:, 1:] += (SHARED_IA * pull + SHARED_FV * speed + SHARED_FC * np.sign(speed))[:, None]
    tau += noise_nm * rng.normal(size=tau.shape)
    np.savez(folder / "motion.npz", position_rad=q, torque=tau, sample_rate_hz=RATE_HZ)
    return Recorded(q, tau, folder / "three.urdf", folder / "motion.npz")


@pytest.fixture(scope="session")
def another(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Another motion of the same robot."""
    return recorded(tmp_path_factory.mktemp("another"), seconds=10.0, seed=9)


def _bodies(urdf: Path, q: Array, qd: Array, qdd: Array) -> Array:
    urdf.write_text(URDF)
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()
    return np.array([pin.rnea(model, data, *sample) for sample in zip(q, qd, qdd, strict=True)])


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """One recording for all tests that only read it."""
    return recorded(tmp_path_factory.mktemp("three"))
