"""Runs merged in the parts of their modules: exactly, in any order, and nothing that is not there."""

import json
from pathlib import Path
from typing import NamedTuple
from zipfile import ZipFile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from coordinator.batch_estimation.imu_calibration import CalibrationInformation
from coordinator.main import app
from coordinator.merge.calibration_file import each_once, read_calibration, write_calibration
from coordinator.merge.information_file import (
    RunInformation,
    read_information,
    write_information,
)
from coordinator.merge.merge_runs import MergedInformation, MergeError, merge_runs
from coordinator.merge.run_arrays import RunArraysError, read_held_out_arrays
from coordinator.parameter_fit.module_parts import bodies_from_parts, parts_of
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE
from coordinator.parameter_fit.systematic_errors import chain_effects, error_directions
from coordinator.recording.run_folder import CALIBRATION, INFORMATION, RESULT, SESSION
from module_agent.model.chain import Array, Chain
from module_agent.model.information import compress, merge
from module_agent.model.perturbation import apply_perturbation
from module_agent.model.regressor import inverse_dynamics, torque_regressor
from module_agent.signals.filtering import JointMotion

SERIALS = ("A", "B", "C")
NOISE_NM = np.array([0.02, 0.01, 0.005])
SCALE = np.array([1.0, *[0.1] * 3, *[0.02] * 6])


def assembled(rng: Generator, order: tuple[int, ...] = (0, 1, 2)) -> Chain:
    """A chain of the modules in some order, each axis next to its IMU as its make has it."""
    make = default_rng(7)
    axis_in_imu = make.normal(size=(3, 3))
    axis_in_imu /= np.linalg.norm(axis_in_imu, axis=1, keepdims=True)
    point_in_imu = make.uniform(-0.05, 0.05, (3, 3))
    home = np.tile(np.eye(4), (3, 1, 1))
    home[:, :3, :3] = Rotation.random(3, rng=rng).as_matrix()
    home[:, :3, 3] = np.cumsum(rng.uniform(-0.3, 0.3, (3, 3)), axis=0)
    of = list(order)
    return Chain(
        serials=tuple(SERIALS[k] for k in of),
        parent=(-1, 0, 1),
        reversed=(False,) * 3,
        axis=np.einsum("nij,nj->ni", home[:, :3, :3], axis_in_imu[of]),
        point=np.einsum("nij,nj->ni", home[:, :3, :3], point_in_imu[of]) + home[:, :3, 3],
        imu_home=home,
        gravity=Rotation.random(rng=rng).apply([0.0, 0.0, 9.81]),
    )


class Errors(NamedTuple):
    """A run's systematic errors.

    off: (18,) by how much the chain that it takes is off. spread: (18, 18) of such errors.
    scale: (3,) of every module's torque sensor, which shows 1 / (1 + scale) of the torque. taken: (n,) what
    the run has multiplied its torques by beyond 1. scale_sigma: what is known of them. noise: in `NOISE_NM`.
    """

    off: Array = np.zeros(18)
    spread: Array = np.zeros((18, 18))
    scale: Array = np.zeros(3)
    taken: Array = np.zeros(3)
    scale_sigma: float = 0.0
    noise: float = 1.0


NOISE_ALONE = Errors()
PARTS = parts_of([assembled(default_rng(0))])
PHI = (default_rng(3).uniform(0.2, 1.0, (len(PARTS), 10)) * SCALE).ravel()


def measured(
    rng: Generator,
    chain: Chain,
    samples: int = 400,
    name: str = "run",
    phi: Array = PHI,
    errors: Errors = NOISE_ALONE,
) -> RunInformation:
    """A run of a chain whose bodies are made of the parts, with noise on its torques."""
    of = [SERIALS.index(s) for s in chain.serials]
    q, qd, qdd = (scale * rng.normal(size=(samples, 3)) for scale in (1.0, 2.0, 8.0))
    bodies = bodies_from_parts(chain, PARTS) @ phi
    tau = inverse_dynamics(chain, bodies, q, qd, qdd) / (1.0 + errors.scale[of])
    noise = np.asarray(errors.noise * NOISE_NM[of])
    shown = (1.0 + errors.taken) * (tau + noise * rng.normal(size=tau.shape))
    believed = apply_perturbation(chain, errors.off)
    bodies = bodies_from_parts(believed, PARTS) @ phi
    columns = chain_effects(believed, errors.spread, bodies, JointMotion(np.arange(samples), q, qd, qdd, tau))
    pieces = compress(np.concatenate([torque_regressor(believed, q, qd, qdd), columns], axis=2), shown)
    rows = np.vstack([piece.r[:, :30] for piece in pieces]) @ bodies_from_parts(believed, PARTS)
    readings = np.concatenate([piece.z for piece in pieces])
    # What the run makes of its readings: weak directions stay what modules of the type have.
    found = phi + np.linalg.lstsq(rows, readings - rows @ phi, rcond=1e-3)[0]
    return RunInformation(
        name=name,
        session=rng.bytes(16).hex(),
        chain=believed,
        joints=tuple(piece._replace(r=piece.r[:, :30]) for piece in pieces),
        sigma_nm=noise,
        independent_fraction=1.0,
        phi_parts=found,
        directions=error_directions(errors.spread),
        effects=tuple(piece.r[:, 30:] for piece in pieces),
        scale=errors.taken,
        scale_sigma=errors.scale_sigma,
    )


def exact(runs: list[RunInformation]) -> MergedInformation:
    return merge_runs(runs, RANK_TOLERANCE)


def test_runs_of_one_assembly_say_together_what_one_long_run_says() -> None:
    rng = default_rng(1)
    chain = assembled(rng)
    runs = [measured(rng, chain) for _ in range(3)]
    total = runs[0].joints
    for run in runs[1:]:
        total = merge(total, run.joints)
    long = runs[0]._replace(joints=total, effects=tuple(np.zeros((len(j.z), 0)) for j in total))
    merged, alone = exact(runs).base, exact([long]).base
    assert merged.rank == alone.rank
    np.testing.assert_array_equal(merged.independent, alone.independent)
    # The bar for what is distributed.
    np.testing.assert_allclose(merged.value, alone.value, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(merged.covariance, alone.covariance, rtol=1e-8, atol=1e-18)


def test_three_runs_of_one_assembly_cut_the_deviations_by_the_root_of_three() -> None:
    rng = default_rng(2)
    chain = assembled(rng)
    found = exact([measured(rng, chain) for _ in range(3)])
    assert {run.base.rank for run in found.runs} == {found.base.rank}
    # The motions are drawn anew: each tells as much as the others within some percent.
    assert found.gain == pytest.approx(3.0**-0.5, rel=0.1)


@settings(deadline=None, max_examples=8)
@given(st.permutations(range(4)))
def test_the_order_of_the_runs_does_not_matter(order: list[int]) -> None:
    rng = default_rng(5)
    runs = [measured(rng, assembled(rng, o), 150) for o in ((0, 1, 2), (2, 1, 0), (1, 0, 2), (0, 2, 1))]
    one, other = exact(runs), exact([runs[k] for k in order])
    assert one.parts == other.parts
    assert np.array_equal(one.base.independent, other.base.independent)
    # Rounding, by the condition of the sums.
    np.testing.assert_allclose(one.base.value, other.base.value, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(one.base.sigma, other.base.sigma, rtol=1e-6)
    assert one.runs[0].inconsistency_sigma == pytest.approx(
        other.runs[order.index(0)].inconsistency_sigma, rel=1e-6, abs=1e-6
    )


def test_other_orders_of_the_modules_show_other_sums_of_their_parts() -> None:
    rng = default_rng(4)
    found = exact([measured(rng, assembled(rng, order)) for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0))])
    alone = [run.base.rank for run in found.runs]
    assert found.base.rank > max(alone) + 10
    # No sum is known worse than before.
    for run in found.runs:
        assert np.max(run.sigma_merged / run.sigma_alone) < 1.0 + 1e-6


def test_gravity_from_another_side_shows_more_of_the_same_assembly() -> None:
    rng = default_rng(6)
    chain = assembled(rng)
    along = chain._replace(gravity=9.81 * chain.axis[0])
    across = chain._replace(gravity=9.81 * np.cross(chain.axis[0], [0.6, 0.0, 0.8]))
    found = exact([measured(rng, along), measured(rng, across)])
    assert found.base.rank == found.runs[1].base.rank > found.runs[0].base.rank


def test_what_is_claimed_of_the_merged_sums_is_true() -> None:
    rng = default_rng(8)
    found = exact([measured(rng, assembled(rng, order)) for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0))])
    off = (found.base.value - found.base.grouping @ PHI) / found.base.sigma
    # Of some 35 standard normal draws the largest is below 4 in 99.8 of 100.
    assert np.abs(off).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.4
    assert max(run.inconsistency_sigma for run in found.runs) < 1.3


def test_a_part_that_was_not_the_same_is_noticed() -> None:
    rng = default_rng(9)
    heavier = PHI.copy()
    heavier[[part.name == "B turned" for part in PARTS].index(True) * 10] += 0.1
    chain = assembled(rng)
    same, other = ([measured(rng, chain), measured(rng, chain, phi=phi)] for phi in (PHI, heavier))
    assert max(run.inconsistency_sigma for run in exact(same).runs) < 1.3
    assert max(run.inconsistency_sigma for run in exact(other).runs) > 5.0


ORDERS = ((0, 1, 2), (2, 1, 0), (1, 2, 0), (0, 2, 1))


def test_a_doubtful_scale_leaves_nothing_better_known() -> None:
    """Sensors that may be 5 % off leave every sum as doubtful, with any number of rows."""
    chain = assembled(default_rng(10))
    quiet, doubtful = (
        exact([measured(default_rng(1), chain, errors=Errors(scale_sigma=e))]).base for e in (0.0, 0.05)
    )
    assert quiet.relative_sigma.min() < 0.005
    # Of three sensors' mean.
    assert doubtful.relative_sigma.min() > 0.9 * 0.05 / np.sqrt(3)


def test_putting_modules_together_anew_does_not_average_the_scales_of_their_sensors() -> None:
    rng = default_rng(14)
    doubt = Errors(scale_sigma=0.05)
    runs = [measured(rng, assembled(rng, order), errors=doubt) for order in ORDERS]
    found = exact(runs).base
    # All sensors off alike are all parts heavier: no run tells that, and runs are no sensors. Four runs with
    # sensors of their own would have half of this.
    whole = found.grouping @ PHI
    known = np.linalg.pinv(found.covariance, hermitian=True)
    assert 1.0 / np.sqrt(whole @ known @ whole) > 0.95 * 0.05 / np.sqrt(3)


def test_what_is_claimed_under_scales_of_sensors_is_true() -> None:
    rng = default_rng(15)
    chains = [assembled(rng, order) for order in ORDERS]
    off = []
    for _ in range(25):
        scale = 0.03 * rng.normal(size=3)
        runs = []
        for chain, order in zip(chains, ORDERS, strict=True):
            # A run finds the scales of its sensors relative to each other, but for what all have in common.
            taken = (scale - scale.mean() + 0.01 * rng.normal())[list(order)]
            runs.append(measured(rng, chain, 150, errors=Errors(scale=scale, taken=taken, scale_sigma=0.03)))
        found = exact(runs)
        off.append((found.base.value - found.base.grouping @ PHI) / found.base.sigma)
    # Three scales drawn 25 times: their mean square scatters by a quarter.
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_every_sum_is_as_uncertain_as_claimed_where_only_chains_err() -> None:
    rng = default_rng(16)
    chains = [assembled(rng, order) for order in ORDERS[:3]]
    # A tenth of a millimetre and 0.2 mrad; noise and what is of second order are far below that.
    length = np.tile([2e-4] * 3 + [1e-4] * 3, 3)
    motions = default_rng(17)
    state = motions.bit_generator.state
    pulls = []
    for _ in range(60):
        motions.bit_generator.state = state
        runs = [
            measured(
                motions,
                chain,
                150,
                errors=Errors(off=length * rng.normal(size=18), spread=np.diag(length**2), noise=1e-2),
            )
            for chain in chains
        ]
        sums = merge_runs(runs).base
        pulls.append((sums.value - sums.grouping @ PHI) / sums.sigma)
    # The rms of 60 draws scatters by a tenth, and the largest of some 40 by three times that.
    each = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert each.min() > 0.6
    assert each.max() < 1.5


def test_a_run_is_not_counted_twice() -> None:
    rng = default_rng(18)
    one, two = (measured(rng, assembled(rng), name=name) for name in ("one", "two"))
    with pytest.raises(MergeError, match="the runs one and copy are of the same recording"):
        merge_runs([one, two, one._replace(name="copy")])
    assert len(merge_runs([one, two]).runs) == 2


def test_runs_of_other_modules_are_not_merged() -> None:
    rng = default_rng(11)
    run = measured(rng, assembled(rng))
    other = run._replace(name="other", session="another", chain=run.chain._replace(serials=("X", "Y", "Z")))
    with pytest.raises(MergeError, match="the runs run, other have no module in common"):
        merge_runs([run, other])
    with pytest.raises(MergeError, match="no runs"):
        merge_runs([])


def test_the_file_holds_every_double(tmp_path: Path) -> None:
    errors = Errors(spread=1e-8 * np.eye(18), taken=np.array([0.01, -0.02, 0.03]), scale_sigma=0.05)
    run = measured(default_rng(12), assembled(default_rng(12)), errors=errors)
    (tmp_path / "run").mkdir()
    write_information(tmp_path / "run" / INFORMATION, run)
    again = read_information(tmp_path / "run" / INFORMATION)
    assert again.name == "run"
    assert again.chain.serials == run.chain.serials
    assert np.array_equal(again.chain.imu_home, run.chain.imu_home)
    for one, other in zip(run.joints, again.joints, strict=True):
        assert np.array_equal(one.r, other.r)
        assert np.array_equal(one.z, other.z)
        assert (one.rest, one.samples) == (other.rest, other.samples)
    assert all(np.array_equal(a, b) for a, b in zip(run.effects, again.effects, strict=True))
    assert (again.session, again.scale_sigma) == (run.session, run.scale_sigma)
    assert np.array_equal(run.phi_parts, again.phi_parts)
    assert np.array_equal(run.directions, again.directions)
    assert np.array_equal(run.scale, again.scale)


@pytest.mark.parametrize(
    ("what", "why"),
    [("missing", "a run with dynamics that does not end with code 5 writes it"), ("junk", "is not the")],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, what: str, why: str) -> None:
    path = tmp_path / INFORMATION
    if what == "junk":
        path.write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(RunArraysError, match=why) as caught:
        read_information(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("version", [1, 99])
def test_a_file_of_another_version_is_refused(tmp_path: Path, version: int) -> None:
    np.savez(tmp_path / INFORMATION, version=version)
    with pytest.raises(RunArraysError, match=f"version {version}, 2 is read here: replay"):
        read_information(tmp_path / INFORMATION)


def test_the_command_merges_folders_and_says_by_how_much(tmp_path: Path) -> None:
    rng = default_rng(13)
    for name, order in (("one", (0, 1, 2)), ("two", (2, 1, 0))):
        (tmp_path / name).mkdir()
        write_information(tmp_path / name / INFORMATION, measured(rng, assembled(rng, order)))
    folders = [str(tmp_path / name) for name in ("one", "two")]
    done = CliRunner().invoke(app, ["merge", *folders, "--out", str(tmp_path / "both"), "--json", "-"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.output)
    assert said == json.loads((tmp_path / "both" / "merged.json").read_text())
    assert [run["run"] for run in said["runs"]] == ["one", "two"]
    assert said["rank"] > max(run["rank"] for run in said["runs"])
    assert len(said["base_parameters"]) == said["rank"]
    told = CliRunner().invoke(app, ["merge", *folders, "--out", str(tmp_path / "both")])
    assert "merged" in told.output
    twice = CliRunner().invoke(app, ["merge", folders[0], *folders, "--out", str(tmp_path / "twice")])
    assert twice.exit_code == 1
    assert "one and one are of the same recording" in " ".join(twice.output.split())
    assert not (tmp_path / "twice").exists()
    for run, file in (("third", SESSION), ("fourth", RESULT)):
        (tmp_path / run).mkdir()
        (tmp_path / run / file).write_bytes(b"")
    for run in ("one", "third", "fourth"):
        lost = CliRunner().invoke(app, ["merge", *folders, "--out", str(tmp_path / run)])
        assert lost.exit_code == 2
        assert "is the folder of a run, whose imu_calibration.npz would be lost" in " ".join(
            lost.output.split()
        )


def test_a_suspect_run_makes_what_it_is_merged_into_suspect(tmp_path: Path) -> None:
    rng, size = default_rng(19), 40 * len(SERIALS)
    for name, why in (("well", ()), ("sick", ("B took no part: it was silent",))):
        (tmp_path / name).mkdir()
        write_information(tmp_path / name / INFORMATION, measured(rng, assembled(rng)))
        told = CalibrationInformation(SERIALS, np.zeros((size, size)), np.zeros(size), name, suspicions=why)
        write_calibration(tmp_path / name / CALIBRATION, [told])
    folders, out = [str(tmp_path / name) for name in ("well", "sick")], tmp_path / "both"
    done = CliRunner().invoke(app, ["merge", *folders, "--out", str(out)])
    assert done.exit_code == 5
    said = "sick: B took no part: it was silent"
    assert said in " ".join(done.output.split())
    assert json.loads((out / "merged.json").read_text())["suspicions"] == [said]
    # A merge of the merged says it, too: it is in the file that a run may begin with.
    assert [one.suspicions for one in read_calibration(out / CALIBRATION)] == [
        (),
        ("B took no part: it was silent",),
    ]


def test_a_recording_counts_once_and_no_copy_takes_a_suspicion_away() -> None:
    size = 40 * len(SERIALS)
    plain = CalibrationInformation(SERIALS, np.zeros((size, size)), np.zeros(size), "same")
    doubted = plain._replace(suspicions=("B took no part",))
    for order in ([plain, doubted], [doubted, plain], [doubted, plain, doubted]):
        (one,) = each_once(order)
        assert one.suspicions == doubted.suspicions


def test_the_command_says_what_it_needs(tmp_path: Path) -> None:
    alone = CliRunner().invoke(app, ["merge", str(tmp_path), "--out", str(tmp_path / "x")])
    assert alone.exit_code == 2
    empty = CliRunner().invoke(app, ["merge", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "x")])
    assert empty.exit_code == 2
    assert not (tmp_path / "x").exists()


def test_whatever_is_damaged_in_a_file_it_is_refused_by_name(tmp_path: Path) -> None:
    path, rng = tmp_path / "held_out.npz", default_rng(1)
    names = ("q_rad", "tau_measured_nm", "tau_predicted_nm")
    arrays = dict(zip(names, rng.normal(size=(3, 40, 2)), strict=True))
    np.savez_compressed(path, serials=np.array(["A", "B"]), session_ns=np.arange(40), **arrays)
    whole = path.read_bytes()
    assert np.array_equal(read_held_out_arrays(path).measured_nm, arrays["tau_measured_nm"])
    refused: list[str] = []
    for _ in range(1000):
        content = bytearray(whole)
        # As often in the head of the archive and in its directory, which are a small part of it.
        for at in rng.choice([rng.integers(len(whole)), rng.integers(300), -1 - rng.integers(400)], 2):
            content[at] = rng.integers(256)
        path.write_bytes(content)
        try:
            read_held_out_arrays(path)
        except RunArraysError as error:
            refused.append(str(error))
    assert len(refused) > 700
    assert all(str(path) in text and "replaying one" in text for text in refused)
    # The heads of arrays: one that does not end, and one of more than any memory.
    for head in (b"{'descr': (", b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000000,)}"):
        with ZipFile(path, "w") as archive:
            archive.writestr("serials.npy", b"\x93NUMPY\x01\0" + len(head).to_bytes(2, "little") + head)
        with pytest.raises(RunArraysError, match="is not the torques of held-out motions"):
            read_held_out_arrays(path)
    # A file of numpy, but no archive of several arrays.
    with path.open("wb") as file:
        np.save(file, arrays["q_rad"])
    with pytest.raises(RunArraysError, match="it is no npz file"):
        read_held_out_arrays(path)
