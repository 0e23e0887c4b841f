"""Torque constants by a known payload: readings in a unit of their own become torques, joint by joint."""

from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng
from typer.testing import CliRunner

from coordinator.arm_fit.fit_dynamics import ArmFit, fit_dynamics
from coordinator.arm_fit.payload import KnownPayload
from coordinator.main import app
from coordinator.parameter_fit.torque_constants import torque_factors
from module_agent.model.errors import UsageError
from tests.coordinator.arm_fit.test_payload import (
    CHOICE,
    CUTOFF_HZ,
    PAYLOAD_COM_M,
    PAYLOAD_KG,
    record,
    urdf_text,
)

# Torque per reading, j1 to j6; the gear and the amplifier are in it.
CONSTANTS = np.array([1.3, 0.8, 1.15, 0.9, 1.4, 0.7])
PAYLOAD = KnownPayload(PAYLOAD_KG, (*PAYLOAD_COM_M.tolist(),), "flange")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("known_payload")
    (folder / "six.urdf").write_text(urdf_text())
    for name, loaded, seed in (("without", False, 4), ("with", True, 5)):
        path = folder / f"{name}.npz"
        record(folder / "six.urdf", path, payload=loaded, seed=seed, warm=1.0 - 0.3 * loaded)
        with np.load(path) as file:
            arrays = dict(file)
        arrays["torque"] = arrays["torque"] / CONSTANTS
        np.savez(path, **arrays)
    return folder


def fit(folder: Path, **options: object) -> ArmFit:
    files = folder / "six.urdf", folder / "without.npz"
    return fit_dynamics(*files, choice=CHOICE, cutoff_hz=CUTOFF_HZ, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def known(folder: Path) -> ArmFit:
    return fit(folder, loaded=folder / "with.npz", known_payload=PAYLOAD)


def test_constants_are_right_within_three_sigmas(known: ArmFit) -> None:
    parts = known.report.torque_factors
    assert [part.joint for part in parts] == ["j1", "j2", "j3", "j4", "j5", "j6"]
    for part, true in zip(parts, CONSTANTS, strict=True):
        assert part.factor is not None
        assert part.sigma is not None
        assert abs(part.factor - true) < 3.0 * part.sigma
        # 0.8 kg at half a metre against 0.3 Nm of noise, some hundred independent samples: 1 %.
        assert part.sigma < 0.02 * true
    # The first axis is vertical: the payload's inertia alone shows its constant.
    assert parts[0].sigma is not None
    assert parts[1].sigma is not None
    assert parts[0].sigma / CONSTANTS[0] > 2.0 * parts[1].sigma / CONSTANTS[1]


def test_the_fit_is_in_newton_metres(folder: Path, known: ArmFit) -> None:
    factors = np.array([part.factor for part in known.report.torque_factors], dtype=float)
    plain = fit(folder)
    assert plain.report.torque_factors == []
    np.testing.assert_allclose(known.torques.tau_nm, plain.torques.tau_nm * factors, rtol=1e-9)
    # One arm explains all joints again, to the noise; in units of their own it does not.
    (mixed,), (right,) = (
        [e.overall for e in one.report.errors("fitted") if (e.tried_on, e.samples) == ("both", "masked")]
        for one in (plain, known)
    )
    assert right is not None
    assert mixed is not None
    assert right < 0.8 * mixed


def test_joints_that_do_not_carry_it_are_left_as_recorded(folder: Path) -> None:
    here = KnownPayload(PAYLOAD_KG, (0.0, 0.1, 0.1), "l3")
    parts = fit(folder, loaded=folder / "with.npz", known_payload=here).report.torque_factors
    assert [(part.factor, part.sigma) for part in parts[3:]] == [(None, None)] * 3


def test_a_vertical_axis_by_itself_shows_only_inertia_which_is_not_known() -> None:
    rng = default_rng(2)
    qdd, lean = rng.normal(size=(2, 400))
    loaded = np.arange(400) >= 200
    # Of the vertical axis the payload's torque is like its own inertia's; of the level one it is gravity's.
    known = np.where(loaded, np.stack([0.3 * qdd, 4.0 * np.cos(lean)]), 0.0).T
    own = np.broadcast_to(np.stack([qdd, loaded * qdd], axis=1)[:, None], (400, 2, 2))
    readings = (known + 0.7 * qdd[:, None]) / 2.0 + 0.01 * rng.normal(size=(400, 2))
    factors = torque_factors(own, known, readings, np.ones((400, 2), dtype=bool))
    assert factors.determined.tolist() == [False, True]
    assert np.isinf(factors.sigma[0])
    assert factors.value[0] == 1.0
    assert abs(factors.value[1] - 2.0) < 3.0 * factors.sigma[1]


def test_wrong_use_is_named(folder: Path) -> None:
    with pytest.raises(UsageError, match="needs a recording with it"):
        fit(folder, known_payload=PAYLOAD)
    with pytest.raises(UsageError, match="mass must be above 0"):
        fit(folder, loaded=folder / "with.npz", known_payload=PAYLOAD._replace(mass_kg=0.0))
    with pytest.raises(UsageError, match="no joint moves a link of this name"):
        fit(folder, loaded=folder / "with.npz", known_payload=PAYLOAD._replace(link="l9"))
    with pytest.raises(ValueError, match="columns"):
        torque_factors(np.zeros((3, 2, 1)), np.zeros((3, 1)), np.zeros((3, 2)), np.ones((3, 2), dtype=bool))


def test_the_command_says_which_joints_it_determined(folder: Path) -> None:
    files = ["--urdf", "six.urdf", "--data", "without.npz", "--loaded", "with.npz"]
    options = ["--payload-body", "flange", "--cutoff", str(CUTOFF_HZ), "--coupled", "none", "--tried", "none"]
    command = ["fit-dynamics", *(str(folder / one) if "." in one else one for one in files), *options]
    wrong = CliRunner().invoke(app, [*command, "--known-payload", "0.8,1"])
    assert wrong.exit_code == 2
    assert "must be its mass [kg] and its centre [m]" in " ".join(wrong.output.split())
    centre = ",".join(map(str, PAYLOAD_COM_M))
    done = CliRunner().invoke(app, [*command, "--known-payload", f"{PAYLOAD_KG},{centre}"])
    assert done.exit_code == 0, done.output
    assert "readings of j2 were multiplied by 0.80" in " ".join(done.output.split())
