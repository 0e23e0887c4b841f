"""The whole of an offline identification: a robot whose truth is known, and a real one whose bar is."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.arm_fit.cross_validation import fit_part, fitted, halves, held_out_errors
from coordinator.arm_fit.cross_validation import overall as overall_of
from coordinator.arm_fit.cutoff import chosen_cutoff_hz, cutoff_curve
from coordinator.arm_fit.data_file import JointLog, in_two, read_log
from coordinator.arm_fit.filtered_log import filtered_log
from coordinator.arm_fit.fit import STEPS, named
from coordinator.arm_fit.fit_dynamics import fit_dynamics
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.arm_fit.report import ErrorPart, FitReport
from coordinator.description.urdf_reader import read_urdf
from coordinator.dynamics.drive_model import USUAL_TERMS
from module_agent.model.errors import DataError, UsageError

TX40 = Path(__file__).resolve().parents[3] / ".." / "shared" / "data" / "tx40"
# Of the robot in conftest.py.
TRUE_DRIVES = {
    "Fv1": 0.8,
    "Fv2": 0.6,
    "Fv3": 0.3,
    "Fc1": 1.5,
    "Fc2": 1.2,
    "Fc3": 0.5,
    "offset1": 0.2,
    "offset2": -0.3,
    "offset3": 0.1,
    "Ia2": 0.10,
    "Ia3": 0.02,
    "Fv2+3": 0.2,
    "Fc2+3": 0.4,
    "Ia2+3": 0.01,
}
RATE_HZ = 400.0
SHARED = ModelChoice(coupled=((1, 2),), tried=())
# Some eight times the motion's frequency.
CUTOFF_HZ = 10.0


def posed(
    urdf: Path, data: Path, choice: ModelChoice, cutoff_hz: float = CUTOFF_HZ
) -> tuple[JointLog, Problem]:
    robot = read_urdf(urdf)
    log = read_log(data, robot.chain.serials)
    cutoff_hz = cutoff_hz or chosen_cutoff_hz(cutoff_curve(robot, log, choice))
    return log, problem(robot, filtered_log(log, cutoff_hz), choice)


def report(urdf: Path, data: Path, choice: ModelChoice, cutoff_hz: float | None = CUTOFF_HZ) -> FitReport:
    return fit_dynamics(urdf, data, choice=choice, cutoff_hz=cutoff_hz).report


def error(
    found: FitReport,
    model: str = "fitted",
    samples: str = "all",
    torque: str = "filtered",
    tried_on: str = "both",
) -> ErrorPart:
    wanted = (model, samples, torque, tried_on)
    return next(e for e in found.held_out if (e.model, e.samples, e.torque, e.tried_on) == wanted)


def overall(found: FitReport, **which: str) -> float:
    value = error(found, **which).overall
    assert value is not None
    return value


@pytest.fixture(scope="module")
def three(recording: Any) -> FitReport:
    return report(recording.urdf, recording.npz, SHARED)


def test_friction_motors_and_offsets_come_out_as_they_are(three: FitReport) -> None:
    found = {part.name: part for part in three.fit.drives}
    for name, truth in TRUE_DRIVES.items():
        part = found[name]
        # 4 standard deviations, and 1 % of 0.5 Nm for the plain sign, which the model rounds at reversals.
        assert abs(part.value - truth) < 4.0 * part.sigma + 0.005, part
        assert part.lumped_with == ""


def test_the_sums_that_the_torques_show_are_those_of_the_true_bodies(three: FitReport) -> None:
    bodies = [part for part in three.fit.base_parameters if part.urdf is not None]
    # A first joint that stands upright shows one parameter, each further one seven: 15.
    assert len(bodies) == 15
    for part in bodies:
        # The first motor's inertia turns with the first body: they only show together.
        truth = part.urdf + (0.15 if part.summary.startswith("Ia1 + I1zz") else 0.0)
        assert abs(part.value - truth) < 4.0 * part.sigma, part
    assert sum(part.summary.startswith("Ia1 + I1zz") for part in bodies) == 1


def test_every_body_is_spoken_of_in_words(three: FitReport) -> None:
    assert [(body.link, body.joint) for body in three.fit.bodies] == [
        ("upper", "waist"),
        ("fore", "elbow"),
        ("hand", "wrist"),
    ]
    # All that an upright first joint shows of its body is one moment, and that only with its motor.
    first, _, last = (body.summary for body in three.fit.bodies)
    assert first.startswith("only in combinations: I1zz; without effect: m1, ")
    assert "identified: " in last
    assert "m3 c3x" in last


def test_what_was_held_out_is_predicted_and_the_baselines_are_far_behind(three: FitReport) -> None:
    # 0.05 Nm of noise on torques of some 4 Nm, of which the low-pass leaves about a sixth: 0.2 %.
    assert overall(three) < 0.005
    assert overall(three, samples="masked") < 0.005
    # Raw torques have all of their noise.
    noise = three.recording.noise
    assert overall(three, torque="raw") == pytest.approx(np.hypot(noise, overall(three)), rel=0.1)
    # Exact inertias without friction, friction without bodies, and neither.
    assert overall(three, model="urdf") > 0.1
    assert overall(three, model="drives_only") > 0.1
    assert overall(three, model="mean") > 0.5


def test_every_term_that_is_there_earns_its_place_and_one_that_is_not_does_not(recording: Any) -> None:
    more = report(recording.urdf, recording.npz, SHARED._replace(terms=(*USUAL_TERMS, "curved")))
    whole = overall(more)
    gains = {gain.without: gain.all for gain in more.gains}
    assert set(gains) == {*USUAL_TERMS, "curved", "coupling"}
    for term in ("inertia", "viscous", "coulomb", "offset", "coupling"):
        assert gains[term] > 2.0 * whole, term
    assert gains["curved"] < 1.05 * whole
    plain = report(recording.urdf, recording.npz, SHARED).fit.drives
    for part in plain:
        # Every friction and offset is far above what 24 s of this noise hide.
        if part.term in ("viscous", "coulomb", "offset"):
            assert part.significant, part
    motors = {part.name: part for part in plain if part.term == "inertia"}
    assert not motors["Ia1"].significant
    assert "I1zz" in motors["Ia1"].lumped_with


def test_terms_left_out_are_left_out_of_everything(recording: Any) -> None:
    bare = report(recording.urdf, recording.npz, ModelChoice(terms=(), coupled=(), tried=()))
    assert bare.fit.drives == []
    assert bare.gains == []
    assert bare.fit.parameters == 30
    assert "drives_only" not in bare.models()
    assert overall(bare) > 0.2


def test_instruments_find_the_inertia_that_a_noisy_encoder_hides(recording: Any) -> None:
    robot = read_urdf(recording.urdf)
    # 0.1 mrad is an encoder of 14 bits; the cut-off is far above the motion, which is not known beforehand.
    shaken = recording.q_rad + 1e-4 * default_rng(5).normal(size=recording.q_rad.shape)
    log, cutoff_hz = JointLog(RATE_HZ, shaken, None, recording.tau_nm, False), 60.0
    one, again = (filtered_log(half, cutoff_hz) for half in in_two(log))
    plain, tooled = (
        problem(robot, filtered_log(log, cutoff_hz), SHARED),
        problem(robot, one, SHARED, again),
    )
    turned = []
    for some in (plain, tooled):
        found = named(some, fit_part(some, slice(0, len(some.log.tau_nm))))
        i = next(i for i in range(found.rank) if found.summary(i).startswith("Ia1 + I1zz"))
        turned.append((float(found.value[i]), float(found.sigma[i])))
    # What stands upright turns with 0.15 of the motor, 0.025 of its own and the forearm and hand: the same
    # fit at 10 Hz.
    _, slow = posed(recording.urdf, recording.npz, SHARED)
    known = named(slow, fit_part(slow, slice(0, len(slow.log.tau_nm))))
    truth = next(
        float(known.value[i]) for i in range(known.rank) if known.summary(i).startswith("Ia1 + I1zz")
    )
    assert turned[0][0] < 0.85 * truth
    assert turned[1][0] == pytest.approx(truth, abs=4.0 * turned[1][1])
    assert turned[1][0] == pytest.approx(truth, rel=0.05)


def test_no_torque_of_the_held_out_half_reaches_its_own_prediction(recording: Any) -> None:
    _, found = posed(recording.urdf, recording.npz, SHARED)
    first, second = halves(len(found.log.tau_nm), found.log.settling)
    changed = found.log.tau_nm.copy()
    changed[first.stop :] = 100.0
    other = found._replace(log=found.log._replace(tau_nm=changed))
    np.testing.assert_array_equal(fitted(found)(first, second), fitted(other)(first, second))
    assert second.start - first.stop >= found.log.settling


def test_samples_of_a_joint_at_rest_are_not_fitted_to(recording: Any) -> None:
    _, found = posed(recording.urdf, recording.npz, SHARED)
    held = np.where(found.moving, found.log.tau_nm, 77.0)
    other = found._replace(log=found.log._replace(tau_nm=held))
    whole = slice(0, len(held))
    np.testing.assert_array_equal(fit_part(found, whole).parameters, fit_part(other, whole).parameters)


def test_a_fit_to_more_predicts_better(three: FitReport) -> None:
    lengths = [point.seconds for point in three.lengths]
    assert lengths == sorted(lengths)
    assert lengths[-1] == pytest.approx(three.recording.duration_s / 2, rel=0.1)
    assert three.lengths[-1].all < three.lengths[0].all
    assert three.lengths[-1].all == overall(three)


def test_another_recording_is_predicted_by_what_the_first_one_told(recording: Any, another: Any) -> None:
    _, first = posed(recording.urdf, recording.npz, SHARED)
    robot = read_urdf(another.urdf)
    more = filtered_log(read_log(another.npz, robot.chain.serials), first.log.cutoff_hz)
    second = problem(robot, more, SHARED, top_rad_s=first.log.top_rad_s)
    found = fit_dynamics(
        recording.urdf, recording.npz, held_out=another.npz, choice=SHARED, cutoff_hz=CUTOFF_HZ
    ).report
    # As for the halves: 0.2 % of noise, and a little for reversals.
    assert overall(found, tried_on="other recording") < 0.006
    assert overall(found, tried_on="other recording", model="bodies") < 0.006
    assert overall(found, tried_on="other recording", model="urdf") > 0.1
    # By an independent way: the parameters of the whole first recording, applied to the second.
    fit = fit_part(first, slice(0, len(first.log.tau_nm)))
    off = second.regressor @ fit.parameters - second.log.tau_nm
    expected = np.linalg.norm(off) / np.linalg.norm(second.log.tau_nm)
    assert overall(found, tried_on="other recording") == pytest.approx(expected, rel=1e-6)
    # The halves know nothing of it.
    alone = report(recording.urdf, recording.npz, SHARED)
    assert overall(alone) == overall(found)


def test_a_recording_too_short_to_halve_is_refused(recording: Any) -> None:
    _, found = posed(recording.urdf, recording.npz, SHARED)
    short = found.log._replace(tau_nm=found.log.tau_nm[: found.log.settling])
    with pytest.raises(DataError, match="cannot be halved"):
        held_out_errors(found._replace(log=short), fitted(found))


def test_a_joint_that_never_moves_is_named(recording: Any) -> None:
    robot = read_urdf(recording.urdf)
    still = recording.q_rad.copy()
    still[:, 1] = 0.3
    log = JointLog(RATE_HZ, still, None, recording.tau_nm, False)
    with pytest.raises(UsageError, match="joint 'elbow' never moves"):
        problem(robot, filtered_log(log, 10.0), SHARED)


def test_the_staubli_tx40_is_predicted_within_the_best_known_errors() -> None:
    if not TX40.is_dir():
        pytest.skip("the data of the Staubli TX40 is not next to the project")
    found = report(TX40 / "tx40.urdf", TX40 / "motion.npz", ModelChoice(), cutoff_hz=None)
    # What weighted least squares with the same terms reaches elsewhere: 12.3 % of all samples, 7.9 % masked.
    for tried_on in ("first half", "second half", "both"):
        assert overall(found, tried_on=tried_on) < 0.123
        assert overall(found, tried_on=tried_on, samples="masked") < 0.079
    # Friction that grows with the load, and with the root of the speed, takes off another third. (Bodies that
    # can exist, near the maker's, predict better than sums fitted freely to nine seconds.)
    assert overall(found, model="bodies") < 0.075
    assert overall(found, model="bodies", samples="masked") < 0.049
    assert overall(found, model="bodies") < overall(found)
    assert overall(found, model="bodies", samples="masked") < overall(found, samples="masked")
    # The wrist's shared drive is found without being told; no other is.
    assert found.fit.coupled == [["joint_5", "joint_6"]]
    assert "Fl3" in [trial.name for trial in found.trials if trial.kept]
    assert {gain.without: gain.all for gain in found.gains}["coupling"] > 1.5 * overall(found)
    # Rank: 7 of each body of six but 1 of the first upright one, and the drives less two lumped motors.
    assert found.fit.rank == 61 + sum(trial.kept and "+" not in trial.name for trial in found.trials)
    # The maker's inertias are no part of the fit; sums that come out near the claimed ones say that axes,
    # frames and signs are right.
    sums = {part.summary: part for part in found.fit.base_parameters}
    reach = sums["m2 c2x + 0.225 (m3 + m4 + m5 + m6)"]
    assert reach.urdf == pytest.approx(2.397, abs=1e-3)
    assert reach.value == pytest.approx(reach.urdf, rel=0.15)


@pytest.mark.parametrize("damage", ["repeated rows", "repeated rows at 1 kHz", "hole"])
def test_the_staubli_tx40_is_predicted_as_well_from_a_damaged_recording(damage: str, tmp_path: Path) -> None:
    if not TX40.is_dir():
        pytest.skip("the data of the Staubli TX40 is not next to the project")
    with np.load(TX40 / "motion.npz") as file:
        rate_hz, q, tau = float(file["sample_rate_hz"]), file["position_rad"], file["torque"]
    if damage.endswith("1 kHz"):
        rate_hz, q, tau = rate_hz / 5.0, q[::5], tau[::5]
    rows = np.arange(len(q))
    if damage == "hole":
        kept = np.r_[0:30000, 30045 : len(q)]
    else:
        rows[1:][default_rng(7).random(len(q) - 1) < 0.06] = 0
        kept = np.maximum.accumulate(rows)
    errors = []
    for name, values in (("clean", slice(None)), ("damaged", kept)):
        times = np.arange(len(q)) / rate_hz
        at = times[values] if damage == "hole" else times
        np.savez(tmp_path / f"{name}.npz", t_s=at, position_rad=q[values], torque=tau[values])
        choice = ModelChoice(coupled=((4, 5),), tried=())
        _, posed_one = posed(TX40 / "tx40.urdf", tmp_path / f"{name}.npz", choice, 0.0)
        errors.append(overall_of(held_out_errors(posed_one, fitted(posed_one))))
    assert errors[1][0] < 1.1 * errors[0][0]
    assert errors[1][1] < 1.1 * errors[0][1]


def test_the_library_takes_files_or_what_was_read_from_them(recording: Any, tmp_path: Path) -> None:
    robot = read_urdf(str(recording.urdf))
    log = read_log(str(recording.npz), robot.chain.serials)
    steps: list[str] = []
    fit = fit_dynamics(robot, log, choice=SHARED, progress=steps.append)
    of_files = fit_dynamics(str(recording.urdf), str(recording.npz), choice=SHARED)
    assert fit.report.held_out == of_files.report.held_out
    assert (fit.report.data, of_files.report.data) == ("a recording in memory", str(recording.npz))
    assert len(steps) == STEPS
    assert fit.bodies is not None
    assert fit.drives is not None
    assert [part.rigid_body.mass_kg for part in fit.report.fit.bodies if part.rigid_body] == [
        body.mass_kg for body in fit.bodies
    ]
    fit.write_urdf(tmp_path / "fitted.urdf")
    assert (tmp_path / "fitted.urdf").read_text() == fit.urdf
    again = read_urdf(tmp_path / "fitted.urdf")
    np.testing.assert_allclose(again.phi, fit.phi, atol=1e-9)
    with pytest.raises(UsageError, match="do not fit the joints waist, elbow, wrist"):
        fit_dynamics(robot, log._replace(tau_nm=log.tau_nm[:, :2]))
