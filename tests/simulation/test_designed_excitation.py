"""A whole session whose inertia is told by motions of all joints at once, designed from its own chain."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag

from coordinator.dynamics.pseudo_inertia import parameter_transform
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Identified, Kinematics
from coordinator.identification.identify import identify, identify_kinematics
from coordinator.parameter_fit.base_parameters import joint_frames
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import SESSION, load_recording
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION
from module_agent.model.chain import Chain
from module_agent.model.regressor import torque_regressor
from module_agent.network_emulation.profile_file import network
from module_agent.signals.torque_terms import READING_TERMS
from sim.actuator.actuator import SPRING_LOSS_S
from sim.imperfections.noise_profile import noise_profile
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia
from sim.robot.variants import as_built
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.run import QUICK_PLAN, VirtualConfig, run_virtual
from sim.virtual_time.session import record_session

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("designed_excitation")

ARM, MOTIONS, SEED, NOISE = "a2085_03", 3, 4, "x5"
BUILT = as_built(load_robot(ARM), SEED, noise_profile(NOISE))
PLAN = Plan(excitation="d-optimal", excitation_motions=MOTIONS, excitation_s=4.0, imu="calibrated")


@pytest.fixture(scope="module")
def found_in() -> tuple[Recording, Identified]:
    """A recorded session, and what is identified with the chain that its motions were designed for."""
    explored: list[Kinematics] = []
    settings = VirtualSettings(load_robot(ARM), network("lan"), SEED, NOISE)
    recording = record_session(settings, PLAN, on_explored=explored.append)
    return recording, identify(recording, explored=explored[0])


@pytest.fixture(scope="module")
def recording(found_in: tuple[Recording, Identified]) -> Recording:
    return found_in[0]


@pytest.fixture(scope="module")
def found(found_in: tuple[Recording, Identified]) -> Identified:
    return found_in[1]


def test_no_motion_of_all_joints_is_designed_on_an_exploration_that_is_suspect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether it would be free of collisions is told by a chain that is not believed."""
    monkeypatch.setattr(
        "coordinator.session.run.identify_kinematics",
        lambda *of: identify_kinematics(*of)._replace(damage=("an IMU is sick",)),
    )
    plan = QUICK_PLAN.model_copy(update={"dynamics": True, "excitation": "d-optimal", "dynamic_repeats": 1})
    robot = load_robot("thesis_171_horizontal")
    run_virtual(VirtualConfig(robot, tmp_path / "run", seed=3, plan=plan))
    journal = load_recording(tmp_path / "run" / SESSION).journal
    excited = [event for event in journal if event.what == "motion" and event.purpose == "dynamic"]
    assert {event.step for event in excited} == {f"excite/{serial}" for serial in robot.serials}


def base_parameter_count(chain: Chain) -> int:
    """Return what any motion could tell: the rank at random positions, rates and accelerations."""
    motion = np.random.default_rng(0).uniform(-3.0, 3.0, (3, 300, len(chain.serials)))
    regressor = torque_regressor(chain, *motion).reshape(-1, 10 * len(chain.serials))
    return int(np.linalg.matrix_rank(regressor, tol=1e-9 * np.linalg.norm(regressor, 2)))


def test_all_joints_moved_at_the_same_time_and_one_motion_was_held_out(recording: Recording) -> None:
    for purpose, steps in (("dynamic", MOTIONS), ("held_out", 1)):
        events = [e for e in recording.journal if e.what == "motion" and e.purpose == purpose]
        by_step = {e.step: [other for other in events if other.step == e.step] for e in events}
        assert len(by_step) == steps
        for moved in by_step.values():
            assert sorted(e.serial for e in moved) == sorted(load_robot(ARM).serials)
            assert all(e.motion is not None and e.motion.pattern.kind == "multi_sine" for e in moved)


def test_every_parameter_that_any_motion_could_tell_is_identified(found: Identified) -> None:
    assert found.inertia is not None
    # Joint after joint leaves some of them open. Axes that are parallel by design show further parameters by
    # the 1 mrad that they are off in their housings: those are in the noise.
    by_design = base_parameter_count(true_chain(load_robot(ARM)))
    assert found.inertia.instrumental.fit.rank == by_design < base_parameter_count(true_chain(BUILT))


def test_the_held_out_motion_of_all_joints_is_predicted(found: Identified) -> None:
    assert found.held_out is not None
    # Springs, links and the bench give, which a rigid model does not have: 0.8 % on the longer arm.
    assert found.held_out.error.overall < 0.03
    # What is held constant predicts nothing of a motion that turns every link in gravity.
    assert found.held_out.error.mean_overall > 10.0 * found.held_out.error.overall


def test_imus_explain_the_torques_better_than_encoders(found: Identified) -> None:
    assert found.inertia is not None
    assert found.inertia.motion_source == "imus"
    # White noise of 0.2 % of the largest torque is the limit: what the low-pass leaves of it.
    limit = 0.002 * np.array([t.max_effort_nm for t in build_tree(load_robot(ARM)).types])
    limit *= np.sqrt(INDEPENDENT_FRACTION)
    np.testing.assert_allclose(found.inertia.noise_nm["imus"], limit, rtol=0.15)
    # A short arm's; a long one's encoders, differentiated twice, leave 1.2 to 1.4 times as much.
    assert found.inertia.gain > 1.01


def test_readings_lag_by_the_damping_of_the_springs_and_hold_nothing_else(found: Identified) -> None:
    assert found.inertia is not None
    terms = found.inertia.instrumental.terms
    lag = READING_TERMS.index("lag")
    # The last joint turns a bare output against next to nothing.
    np.testing.assert_array_equal(terms.used[:, lag], [True, True, False])
    error = terms.value[:2, lag] - SPRING_LOSS_S
    assert (np.abs(error) < 4.0 * terms.sigma[:2, lag]).all()
    assert not np.delete(terms.used, lag, axis=1).any()


def test_base_parameters_are_as_uncertain_as_claimed(found: Identified) -> None:
    """With all that real arms do: links that give, friction, springs, a chain that was estimated."""
    assert found.bodies is not None
    base = found.bodies.base
    frames = joint_frames(true_chain(BUILT))
    into = block_diag(*(parameter_transform(np.linalg.inv(frame)) for frame in frames))
    error = base.value - base.grouping @ (into @ true_inertia(BUILT).ravel())
    # The scale of the torque sensors is not known: all are taken to be off by as much as they may be.
    pulls = error / base.sigma
    assert np.abs(pulls).max() < 3.0
    known = base.relative_sigma < 0.1
    assert known.sum() >= 4
    # They are not off here: relative to each other the largest are known far better than that.
    true = base.value - error
    largest = np.argsort(-np.abs(true / base.columns.scale[base.independent]))[:4]
    assert (np.abs(error[largest]) < 0.01 * np.abs(true[largest])).all()


def test_an_offset_that_is_taken_for_none_is_claimed_as_an_error_of_its_own_joint(found: Identified) -> None:
    assert found.inertia is not None
    joints = len(found.inertia.effects)
    for i, effects in enumerate(found.inertia.effects):
        size = np.linalg.norm(effects[:, -joints:], axis=0)
        assert size[i] > 0.0
        np.testing.assert_array_equal(np.delete(size, i), 0.0)
