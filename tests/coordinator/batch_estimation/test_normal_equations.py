"""The equations by each IMU's own path are those of the whole Jacobian, with the IMUs' own eliminated."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.imu_calibration import ImuCalibration, catalogued
from coordinator.batch_estimation.imu_intrinsics import SIZE, mixing, slopes
from coordinator.batch_estimation.imu_jacobian import (
    Displacements,
    imu_jacobian,
    kernel_displacements,
    kernel_motion,
)
from coordinator.batch_estimation.imu_prediction import BodyMotion, body_motions, readings_on
from coordinator.batch_estimation.link_compliance import ComplianceJacobian
from coordinator.batch_estimation.normal_equations import Expected, Problem, State, normal_equations
from coordinator.batch_estimation.sensor_data import SensorData
from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2
from module_agent.model.chain import Array
from module_agent.model.imu_prior import BIASES_ONLY, UNCALIBRATED, ImuPrior
from tests.random_chains import displaced

# More than one block of them, and no multiple of the kernels' groups.
SAMPLES = 300
Joints = tuple[Array, Array, Array]


def _problem(
    robots: Any, seed: int, joints: int, coupled: bool, prior: ImuPrior = UNCALIBRATED
) -> tuple[Problem, State, Joints]:
    """A random tree whose links and first encoder give, at some state of its parameters."""
    rng = np.random.default_rng(seed)
    chain, _ = robots.random(seed, joints=joints, roots=1 + seed % 2)
    q, qd, qdd = rng.normal(size=(3, SAMPLES, joints))
    data = SensorData(q, qd, qdd, *rng.normal(size=(2, SAMPLES, joints, 3)))
    data = data._replace(
        imu_rates=rng.normal(size=(SAMPLES, joints, 6)), motion=np.repeat([0, 1, 2], SAMPLES // 3)
    )
    links = tuple(k for k in chain.linked for _ in range(2))
    carried = Displacements(
        (*links, 0),
        (*(False,) * len(links), True),
        rng.normal(size=(len(links) + 1, 6, 6)),
        (*np.repeat(np.arange(len(links) // 2), 2).tolist(), len(links) // 2),
        rng.normal(size=(len(links) // 2 + 1, 18, SAMPLES)),
    )
    flex = ComplianceJacobian(np.full(len(links) + 1, 3.0), carried, rng.normal(size=len(links) + 1))
    known = catalogued(chain.serials, prior)
    if coupled:
        size = known.sigma.ravel()
        factors = rng.normal(size=(len(size), 3))
        together = np.outer(size, size) * (np.eye(len(size)) + 0.1 * factors @ factors.T)
        known = ImuCalibration(known.serials, known.mean, together)
    own = known.sigma * rng.normal(size=known.mean.shape)
    # Small amounts: IMUs in their places.
    own[:, SIZE:] = 0.0
    problem = Problem(data, flex, kernel_displacements(carried), known, known.information()[0])
    return problem, State(chain, own, rng.normal(size=len(flex.links))), (q, qd, qdd)


def _at(problem: Problem, state: State, joints: Joints) -> tuple[Expected, list[BodyMotion]]:
    bodies = body_motions(state.chain, *joints)
    residuals = tuple(np.random.default_rng(5).normal(size=(2, SAMPLES, len(state.own), 3)))
    motion = kernel_motion(bodies, *joints[:2])
    return Expected(state.chain, motion, None, readings_on(state.chain, bodies), residuals), bodies  # type: ignore[arg-type]


def _dense(problem: Problem, state: State, joints: Joints, sigmas: list[Array]) -> tuple[Array, Array]:
    """Information and right-hand side by the whole Jacobian of all readings, own parameters last."""
    expected, bodies = _at(problem, state, joints)
    count, links = len(state.own), len(problem.flex.links)
    first = 6 * count + 3 + links
    whole = np.zeros((count, 6, SAMPLES, first + 40 * count))
    units = [
        displaced(
            state.chain,
            joints,
            problem.flex.carried,
            unit,
        )
        for unit in np.eye(links)
    ]
    motion = kernel_motion(bodies, *joints[:2])
    for k in range(count):
        one, mixed = imu_jacobian(state.chain, motion, len(joints[0]), k), mixing(state.imus, k)
        # Slopes of the readings of an IMU with errors are those, mixed.
        errs = imu_jacobian(state.chain, motion, len(joints[0]), k, mixed)
        for with_errors, perfect in zip(errs[1:], one[1:], strict=True):
            np.testing.assert_allclose(with_errors, mixed @ perfect, atol=1e-10)
        rates = problem.data.imu_rates
        assert rates is not None
        for place, module in enumerate(one.modules):
            part = one.poses[6 * place : 6 * place + 6]
            whole[k, ..., 6 * module : 6 * module + 6] = np.moveaxis(mixed @ part, 0, 2)
        whole[k, ..., 6 * count : 6 * count + 3] = np.moveaxis(mixed @ one.gravity, 0, 2)
        for p, unit in enumerate(units):
            whole[k, ..., 6 * count + 3 + p] = mixed @ unit[k]
        errors = slopes(
            expected.ideal.gyro_rad_s[:, k], expected.ideal.accel_m_s2[:, k], rates[:, k], np.ones(SIZE, bool)
        )
        own = np.concatenate([errors, mixed @ one.placement])
        whole[k, ..., first + 40 * k : first + 40 * (k + 1)] = np.moveaxis(own, 0, 2)
    weight = np.stack([1.0 / sigma[problem.data.motion] for sigma in sigmas])  # (2, m, n)
    weight = np.repeat(weight, 3, axis=0).transpose(2, 0, 1)
    target = np.concatenate(expected.residuals, axis=2).transpose(1, 2, 0) * weight
    rows = (whole * weight[..., None]).reshape(-1, whole.shape[-1])
    information, rhs = rows.T @ rows, rows.T @ target.ravel()
    size = float(np.linalg.norm(state.chain.gravity))
    up, at = state.chain.gravity / size, slice(6 * count, 6 * count + 3)
    information[at, at] += np.outer(up, up) / GRAVITY_SIGMA_M_S2**2
    rhs[at] += up * (GRAVITY_M_S2 - size) / GRAVITY_SIGMA_M_S2**2
    of_links = slice(6 * count + 3, first)
    information[of_links, of_links] += np.diag(problem.flex.sigmas**-2.0)
    rhs[of_links] -= problem.flex.sigmas**-2.0 * (state.compliance + problem.flex.taken)
    # What is not free of the IMUs is no parameter.
    free = np.concatenate([np.arange(first), first + np.flatnonzero(np.tile(problem.free, count))])
    information, rhs = information[np.ix_(free, free)], rhs[free]
    information[first:, first:] += problem.known
    rhs[first:] += problem.known @ (problem.calibration.mean - state.own)[:, problem.free].ravel()
    return information, rhs


def _close(found: Array, expected: Array, relative: float = 1e-10) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * float(np.abs(expected).max()))


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(
    ("seed", "joints", "prior"),
    [(0, 2, UNCALIBRATED), (1, 4, UNCALIBRATED), (2, 6, BIASES_ONLY), (3, 7, UNCALIBRATED)],
)
def test_equations_by_paths_are_those_of_the_whole_jacobian(
    robots: Any, seed: int, joints: int, prior: ImuPrior, coupled: bool
) -> None:
    problem, state, motion = _problem(robots, seed, joints, coupled, prior)
    sigmas = list(np.random.default_rng(seed).uniform(0.01, 0.1, (2, 3, joints)))
    expected, _ = _at(problem, state, motion)
    found = normal_equations(problem, state, expected, expected.still, sigmas)
    information, rhs = _dense(problem, state, motion, sigmas)
    own = 6 * joints + 3 + len(problem.flex.links)
    through = np.linalg.solve(information[own:, own:], np.column_stack([information[own:, :own], rhs[own:]]))
    reduced = information[:own, :own] - information[:own, own:] @ through[:, :-1]
    right = rhs[:own] - information[:own, own:] @ through[:, -1]
    poses, rest = slice(6, 6 * joints), slice(6 * joints, None)
    for mine, theirs in (
        (found.pose, reduced[poses, poses]),
        (found.cross, reduced[poses, rest]),
        (found.nuisance, reduced[rest, rest]),
        (found.pose_rhs, right[poses]),
        (found.nuisance_rhs, right[rest]),
    ):
        _close(mine, theirs)
    # What follows for the IMUs from a step of all else, and from its covariance.
    step = np.random.default_rng(1).normal(size=own)
    _close(found.own_step(step), through[:, -1] - through[:, :-1] @ step, 1e-9)
    spread = np.linalg.inv(np.eye(own) + np.outer(step, step))
    by_others = np.linalg.inv(information[own:, own:]) + through[:, :-1] @ spread @ through[:, :-1].T
    _close(found.own_covariance(spread), by_others, 1e-9)


@pytest.mark.parametrize("coupled", [False, True])
def test_what_samples_without_noise_do_not_show_is_left_to_the_prior(robots: Any, coupled: bool) -> None:
    """At rest an IMU's scales, axes and biases have the same effects; beside sigmas of nothing at all the
    information of the prior that tells them apart is less than the last digit of that of the samples.
    """
    problem, state, motion = _problem(robots, 1, 4, coupled)
    rest = (motion[0], np.zeros_like(motion[1]), np.zeros_like(motion[2]))
    expected, _ = _at(problem, state, rest)
    sigmas = [np.full((3, 4), 1e-8)] * 2
    found = normal_equations(problem, state, expected, expected.still, sigmas)
    assert all(np.isfinite(part).all() for part in found[:5])
    spectrum = np.linalg.eigvalsh(found.pose)
    assert spectrum[0] > -1e-9 * spectrum[-1]
