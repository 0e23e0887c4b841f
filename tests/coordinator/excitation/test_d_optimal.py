"""Chosen motions stay within every limit and have more information than joint-by-joint motions."""

from collections.abc import Sequence

import numpy as np
import pytest

from coordinator.excitation.d_optimal import (
    RATE_HZ,
    TORQUE_SHARE,
    Excitation,
    ExcitationTask,
    design_excitation,
    information,
)
from coordinator.excitation.joint_limits import JointLimits, NoExcitation, joint_limits, motion_peaks
from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import SampledMotion, sampled, way
from coordinator.excitation.self_collision import CLEARANCE_M, clearance_m
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import differentiate
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

SIGMA_NM = 0.05


def task_of(name: str, reach_rad: float = 1.2, segments: int = 4) -> ExcitationTask:
    """A shipped robot whose inertia is known well enough to keep its motors' torques."""
    robot = load_robot(name)
    chain = true_chain(robot)
    count = len(chain.serials)
    types = {module.serial: module_type(module.type) for module in robot.modules}
    kinds = [types[serial] for serial in chain.serials]
    return ExcitationTask(
        chain=chain,
        phi=true_inertia(robot).ravel(),
        limits=tuple(joint_limits(kind, 0.0, 0.05) for kind in kinds),
        max_effort_nm=np.array([kind.max_effort_nm for kind in kinds]),
        torque_sigma_nm=np.full(count, SIGMA_NM),
        home_rad=np.zeros(count),
        reach_rad=reach_rad,
        segments=segments,
        segment_s=6.0,
    )


def known_directions(total: Array) -> int:
    values = np.linalg.eigvalsh(total)
    return int((values > 1e-11 * values[-1]).sum())


def thesis_information(task: ExcitationTask, name: str) -> Array:
    """The information of the thesis' pattern, one joint after the other with the others held."""
    robot = load_robot(name)
    types = {module.serial: module_type(module.type) for module in robot.modules}
    count = len(task.limits)
    total = np.zeros((10 * count, 10 * count))
    for joint, serial in enumerate(task.chain.serials):
        pattern = Plan().dynamic(types[serial])
        t_s = np.arange(int(duration_s(pattern, 0.0) * RATE_HZ)) / RATE_HZ
        wave = waveform(pattern, 0.0, t_s)
        q, qd = np.zeros((2, t_s.size, count))
        q[:, joint], qd[:, joint] = wave.offset_rad, wave.velocity_rad_s
        total += information(task, SampledMotion(q, qd, differentiate(qd, RATE_HZ)))
    return total


@pytest.fixture(scope="module")
def designed() -> tuple[ExcitationTask, Excitation]:
    task = task_of("a2085_06")
    return task, design_excitation(task, np.random.default_rng(1), candidates=60)


def test_every_motion_stays_within_the_limits(designed: tuple[ExcitationTask, Excitation]) -> None:
    task, found = designed
    assert len(found.segments) == task.segments
    for segment in found.segments:
        motion = sampled(segment, 200.0)
        assert np.abs(motion.q_rad - task.home_rad).max() <= task.reach_rad + 1e-9
        for pattern, limit in zip(segment.patterns, task.limits, strict=True):
            speed, accel = motion_peaks(pattern)
            assert speed <= limit.speed_rad_s
            assert accel <= limit.accel_rad_s2
        torque = inverse_dynamics(task.chain, task.phi, *motion)
        # Sampled ten times as finely as it was designed: between two samples there is little.
        assert (np.abs(torque) <= 1.05 * TORQUE_SHARE * task.max_effort_nm).all()
        assert clearance_m(task.chain, motion.q_rad, task.home_rad).min() > 0.95 * CLEARANCE_M


@pytest.mark.parametrize("name", ["a2085_04", "a2085_06", "tree_y"])
def test_all_joints_together_tell_what_joint_after_joint_leaves_open(name: str) -> None:
    task = task_of(name)
    found = design_excitation(task, np.random.default_rng(0), candidates=60)
    total = np.sum([information(task, sampled(s, RATE_HZ)) for s in found.segments], axis=0)
    assert known_directions(total) == found.rank
    # Joints that never move together have no information about their coupling.
    assert known_directions(thesis_information(task, name)) < found.rank


def test_chosen_motions_tell_more_than_drawn_ones(designed: tuple[ExcitationTask, Excitation]) -> None:
    task, found = designed
    rng = np.random.default_rng(7)
    drawn = [design_excitation(task, rng, candidates=task.segments + 6).log_det for _ in range(4)]
    # A factor of e in every base parameter's variance would be the rank; a quarter of it is plain.
    assert found.log_det > max(drawn) + 0.25 * found.rank


def test_two_chosen_motions_are_the_best_of_all_pairs() -> None:
    task = task_of("a2085_04", segments=2)

    def log_det(pair: Sequence[Array]) -> float:
        return float(np.linalg.slogdet(np.sum(pair, axis=0) + 1e-3 * np.eye(pair[0].shape[0]))[1])

    found = design_excitation(task, np.random.default_rng(3), candidates=14)
    rng = np.random.default_rng(3)
    everything = design_excitation(task._replace(segments=14), rng, candidates=14).segments
    pieces = [information(task, sampled(s, RATE_HZ)) for s in everything]
    pairs = [log_det([a, b]) for i, a in enumerate(pieces) for b in pieces[i + 1 :]]
    chosen = log_det([information(task, sampled(s, RATE_HZ)) for s in found.segments])
    # Exchanging one at a time may end next to the best pair, but not far from it.
    assert sum(value > chosen + 1e-9 for value in pairs) <= 0.05 * len(pairs)


def test_ways_are_looked_at_in_both_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every joint takes its own time, so that the way back leads elsewhere than the way there."""
    task, looked = task_of("a2085_04", segments=2), []

    def heard(from_rad: Array, to_rad: Array, *others: float) -> Array:
        looked.append((tuple(from_rad), tuple(to_rad)))
        return way(from_rad, to_rad, *others)

    monkeypatch.setattr("coordinator.excitation.d_optimal.way", heard)
    found = design_excitation(task, np.random.default_rng(5), candidates=6)
    home = tuple(task.home_rad)
    for segment in found.segments:
        assert {(home, tuple(segment.pose_rad)), (tuple(segment.pose_rad), home)} <= set(looked)
    there = way(np.zeros(2), np.array([0.2, 1.0]), 1.0, RATE_HZ)
    back = way(np.array([0.2, 1.0]), np.zeros(2), 1.0, RATE_HZ)
    assert np.abs(there - back[::-1]).max() > 0.1


def test_the_same_seed_designs_the_same_motions() -> None:
    task = task_of("a2085_04", segments=2)
    first, second = (design_excitation(task, np.random.default_rng(5), candidates=12) for _ in range(2))
    assert [s.patterns for s in first.segments] == [s.patterns for s in second.segments]


def test_a_robot_too_heavy_for_its_motors_is_refused_by_name() -> None:
    task = task_of("a2085_04", segments=2)
    heavy = task._replace(phi=50.0 * task.phi)
    with pytest.raises(NoExcitation, match="the motors' torques"):
        design_excitation(heavy, np.random.default_rng(0), candidates=8)


def test_a_joint_at_the_end_of_its_range_is_refused_by_name() -> None:
    task = task_of("a2085_04", segments=2)
    stuck = task._replace(limits=(JointLimits(1.0, 1.0, -1.0, 0.0), *task.limits[1:]))
    with pytest.raises(NoExcitation, match="no room"):
        design_excitation(stuck, np.random.default_rng(0), candidates=4)
