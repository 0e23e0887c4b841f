"""A payload of 0.8 kg on an arm of six joints, from the fits of two recordings; torques are pinocchio's."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from numpy.random import default_rng

from coordinator.arm_fit.fit_dynamics import ArmFit, fit_dynamics
from coordinator.arm_fit.problem import ModelChoice
from coordinator.arm_fit.report import FitReport, PayloadPart, write_report
from coordinator.parameter_fit.payload import EXPLAINED_BELOW
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError

RATE_HZ, SECONDS = 200.0, 24.0
MASSES = (8.0, 5.0, 3.5, 2.0, 1.2, 0.5)
PLACES = ("0 0 0.3", "0.05 0 0.2", "0 0 0.4", "0.04 0 0.1", "0.3 0 0", "0.08 0 0")
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
CENTRE = "0.05 0.02 0.03"
# A tool flange, turned and away from the last joint's frame.
FLANGE_M = np.array([0.06, 0.0, 0.0])
PAYLOAD_KG, PAYLOAD_COM_M = 0.8, np.array([0.03, -0.02, 0.09])
PAYLOAD_INERTIA = np.array([[3e-3, 2e-4, 0.0], [2e-4, 2.5e-3, -3e-4], [0.0, -3e-4, 1.5e-3]])
IA = np.array([0.4, 0.5, 0.3, 0.1, 0.08, 0.05])
NOISE_NM = np.array([0.3, 0.3, 0.25, 0.1, 0.08, 0.05])
# The terms that the arm has; what chooses others has tests of its own.
CHOICE = ModelChoice(coupled=(), tried=())
CUTOFF_HZ = 8.0


class Recorded(NamedTuple):
    urdf: Path
    without: Path
    loaded: Path


def urdf_text(reach: str = "0.3 0 0", elbow: str = "j3") -> str:
    links, joints = ['<link name="l0"/>'], []
    names = ["j1", "j2", elbow, "j4", "j5", "j6"]
    places = [*PLACES[:4], reach, PLACES[5]]
    for i, (name, mass) in enumerate(zip(names, MASSES, strict=True), start=1):
        ixx = 0.01 * mass
        links.append(
            f'<link name="l{i}"><inertial><mass value="{mass}"/><origin xyz="{CENTRE}"/><inertia '
            f'ixx="{ixx}" iyy="{1.2 * ixx}" izz="{0.8 * ixx}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        joints.append(
            f'<joint name="{name}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
            f'<origin xyz="{places[i - 1]}"/><axis xyz="{AXES[i - 1]}"/>'
            '<limit lower="-3" upper="3" effort="500" velocity="10"/></joint>'
        )
    links.append('<link name="flange"/>')
    at = " ".join(str(part) for part in FLANGE_M)
    joints.append(
        '<joint name="tool" type="fixed"><parent link="l6"/><child link="flange"/>'
        f'<origin xyz="{at}" rpy="1.5707963267948966 0 0"/></joint>'
    )
    return "\n".join(['<robot name="six">', *links, *joints, "</robot>"])


def motion(seed: int) -> tuple[Array, Array, Array]:
    rng = default_rng(seed)
    t = np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ
    rate = 2.0 * np.pi * np.array([0.1, 0.23, 0.41, 0.67, 0.9])[:, None]
    size, phase = rng.uniform(0.1, 0.35, (5, 6)), rng.uniform(0.0, 6.0, (5, 6))
    angle = rate * t[:, None, None] + phase
    waves = (np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
    q, qd, qdd = (np.sum(size * wave, axis=1) for wave in waves)
    return q, qd, qdd


def record(urdf: Path, npz: Path, payload: bool, seed: int, warm: float = 1.0, bump_kg: float = 0.0) -> None:
    model = pin.buildModelFromUrdf(str(urdf))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    if payload:
        here = pin.SE3(turn, FLANGE_M)
        model.inertias[6] += here.act(pin.Inertia(PAYLOAD_KG, PAYLOAD_COM_M, PAYLOAD_INERTIA))
    model.inertias[3] += pin.Inertia(bump_kg, np.array([0.0, 0.1, 0.1]), 1e-3 * np.eye(3))
    data, moved = model.createData(), motion(seed)
    q, qd, qdd = moved
    tau = np.array([pin.rnea(model, data, *sample) for sample in zip(*moved, strict=True)])
    # Friction is another in another recording.
    tau += IA * qdd + warm * (2.0 * IA + 0.3) * qd + warm * np.sign(qd) * (1.0 + IA) + 0.1 * warm
    tau += NOISE_NM * default_rng(seed + 50).normal(size=q.shape)
    np.savez(npz, position_rad=q, torque=tau, sample_rate_hz=RATE_HZ)


def fit(urdf: Path, npz: Path, **options: object) -> ArmFit:
    return fit_dynamics(urdf, npz, choice=CHOICE, cutoff_hz=CUTOFF_HZ, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("payload")
    urdf = folder / "six.urdf"
    urdf.write_text(urdf_text())
    record(urdf, folder / "without.npz", payload=False, seed=4)
    record(urdf, folder / "with.npz", payload=True, seed=5, warm=0.7)
    return Recorded(urdf, folder / "without.npz", folder / "with.npz")


@pytest.fixture(scope="module")
def baseline(recorded: Recorded) -> Path:
    path = recorded.urdf.with_name("fit.json")
    write_report(path, fit(recorded.urdf, recorded.without).report)
    return path


def payload_of(one: ArmFit) -> PayloadPart:
    assert one.report.payload is not None
    return one.report.payload


@pytest.fixture(scope="module")
def part(recorded: Recorded, baseline: Path) -> PayloadPart:
    return payload_of(fit(recorded.urdf, recorded.loaded, baseline=baseline, payload_body="flange"))


def test_mass_centre_and_inertia_are_within_three_sigmas(part: PayloadPart) -> None:
    assert part.mass_kg is not None
    assert part.mass_sigma_kg is not None
    assert abs(part.mass_kg - PAYLOAD_KG) < 3.0 * part.mass_sigma_kg
    # Half a newton metre of noise at 0.4 m and more, of some hundreds of independent samples: grams.
    assert 1e-3 < part.mass_sigma_kg < 0.04
    centre = np.array(part.com_m, dtype=float) - PAYLOAD_COM_M
    sigma = np.array(part.com_sigma_m, dtype=float)
    assert (np.abs(centre) < 3.0 * sigma).all()
    assert (sigma < 0.01).all()
    inertia, spread = np.array(part.inertia_kg_m2), np.array(part.inertia_sigma_kg_m2)
    assert (np.abs(inertia - PAYLOAD_INERTIA) < 3.0 * spread).all()
    assert (spread < 0.02).all()
    assert part.undetermined == []
    assert part.misfit < 3.0
    assert part.inconsistency_sigma < 3.0
    assert np.linalg.eigvalsh(part.rigid_body.inertia_kg_m2).min() > 0.0


def test_errors_are_as_large_as_their_sigmas(recorded: Recorded, baseline: Path, tmp_path: Path) -> None:
    off = []
    for seed in range(20, 26):
        record(recorded.urdf, tmp_path / "with.npz", payload=True, seed=seed, warm=1.2)
        one = payload_of(fit(recorded.urdf, tmp_path / "with.npz", baseline=baseline, payload_body="flange"))
        off += [
            (float(one.mass_kg or np.nan) - PAYLOAD_KG) / float(one.mass_sigma_kg or np.nan),
            *(np.array(one.com_m, float) - PAYLOAD_COM_M) / np.array(one.com_sigma_m, float),
        ]
    # 24 figures, with one baseline between them.
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.6


def test_the_same_arm_carries_nothing(recorded: Recorded, baseline: Path, tmp_path: Path) -> None:
    record(recorded.urdf, tmp_path / "again.npz", payload=False, seed=8)
    one = payload_of(fit(recorded.urdf, tmp_path / "again.npz", baseline=baseline))
    assert one.link == "l6"
    assert abs(one.mass_kg or np.nan) < 3.0 * (one.mass_sigma_kg or np.nan)
    assert one.com_m == [None, None, None]
    assert one.inertia_kg_m2 is None
    # Noise alone takes an estimate out of the bodies that exist.
    assert one.inconsistency_sigma < 3.0
    assert one.rigid_body.mass_kg > 0.0


def test_what_changed_elsewhere_is_no_payload(recorded: Recorded, baseline: Path, tmp_path: Path) -> None:
    record(recorded.urdf, tmp_path / "bump.npz", payload=False, seed=8, bump_kg=2.0)
    assert payload_of(fit(recorded.urdf, tmp_path / "bump.npz", baseline=baseline)).misfit > EXPLAINED_BELOW


def test_what_was_taken_off_is_no_body(recorded: Recorded, baseline: Path) -> None:
    report = fit(recorded.urdf, recorded.loaded).report
    one = payload_of(fit(recorded.urdf, recorded.without, baseline=report, payload_body="flange"))
    assert one.mass_kg == pytest.approx(-PAYLOAD_KG, abs=4.0 * (one.mass_sigma_kg or np.nan))
    assert not one.consistent
    assert one.inconsistency_sigma > 10.0


def test_on_the_first_body_only_what_the_waist_feels_is_known(recorded: Recorded, baseline: Path) -> None:
    one = payload_of(fit(recorded.urdf, recorded.loaded, baseline=baseline, payload_body="l1"))
    assert "mass" in one.undetermined
    assert "centre z" in one.undetermined
    assert "inertia zz" not in one.undetermined
    assert one.mass_kg is None


def test_a_baseline_that_does_not_fit_is_refused_by_name(
    recorded: Recorded, baseline: Path, tmp_path: Path
) -> None:
    longer, renamed, text = tmp_path / "longer.urdf", tmp_path / "renamed.urdf", tmp_path / "text.json"
    longer.write_text(urdf_text(reach="0.35 0 0"))
    renamed.write_text(urdf_text(elbow="elbow"))
    for urdf, words in (
        (longer, r"fit\.json: a fit of another arm: joint 'j5' is 0\.05 m and its axis 0 rad from"),
        (renamed, r"fit\.json: a fit of the joints j1, j2, j3, .*; those that move .* j1, j2, elbow"),
    ):
        with pytest.raises(UsageError, match=words):
            fit(urdf, recorded.loaded, baseline=baseline)
    text.write_text("{}")
    with pytest.raises(UsageError, match=r"text\.json: no report of fit-dynamics"):
        fit(recorded.urdf, recorded.loaded, baseline=text)
    with pytest.raises(
        UsageError, match="payload body 'hand': no joint moves a link of this name; flange, l1"
    ):
        fit(recorded.urdf, recorded.loaded, baseline=baseline, payload_body="hand")
    with pytest.raises(UsageError, match="payload body 'l6': a payload needs the --baseline"):
        fit(recorded.urdf, recorded.loaded, payload_body="l6")
    report = FitReport.model_validate_json(baseline.read_bytes())
    assert report.information is not None
    damaged = report.model_copy(
        update={"information": report.information.model_copy(update={"rows": "not numbers"})}
    )
    with pytest.raises(UsageError, match="its information is damaged"):
        fit(recorded.urdf, recorded.loaded, baseline=damaged)
    with pytest.raises(UsageError, match="without the information of its fit"):
        fit(recorded.urdf, recorded.loaded, baseline=report.model_copy(update={"information": None}))


def test_a_baseline_in_which_a_still_joint_stood_elsewhere_is_refused(
    recorded: Recorded, tmp_path: Path
) -> None:
    """What it carries has turned with it, and would count as a payload."""
    report = tmp_path / "fit.json"
    for name, npz, last_rad in (("without", recorded.without, 0.0), ("with", recorded.loaded, 1.57)):
        arrays = dict(np.load(npz))
        arrays["position_rad"][:, 5] = last_rad
        np.savez(tmp_path / f"{name}.npz", **arrays)
    write_report(report, fit(recorded.urdf, tmp_path / "without.npz").report)
    with pytest.raises(UsageError, match=r"joint 'j6' stood at 0 \(rad or m\), and stands at 1\.57"):
        fit(recorded.urdf, tmp_path / "with.npz", baseline=report)
