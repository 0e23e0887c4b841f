"""What is wrong with a recording, before it is fitted: units, signs, gravity, length; by name and number.

A fit to torques of the wrong sign, or to degrees, ends with some parameters as every other one does. Each
check compares a column with something that knows better: limits and masses of the URDF, the other columns, or
that friction dissipates.
"""

from collections.abc import Iterator

import numpy as np

from coordinator.arm_fit.data_file import JointLog
from coordinator.arm_fit.problem import Problem
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.parameter_fit.robust_least_squares import WeightedFit, fit_weighted
from module_agent.model.chain import Array
from module_agent.model.regressor import inverse_dynamics

# Slower recordings of slower motions than this share of the speed limits hold no dynamics.
_SLOW_HZ, _SLOW_PART = 20.0, 0.05
# Where a URDF gives no limit: an arm's usual top speed.
_USUAL_RAD_S = 3.0
# Limits of URDFs are approximate; degrees exceed them by far.
_BEYOND_RANGE, _BEYOND_SPEED = 1.5, 5.0
# A velocity differs from the derivative by delay and noise, up to some per cent.
_SAME_WITHIN, _SAME_CORRELATION = 0.1, 0.9
# Standard deviations that count as certain, and the power of friction as a share of torque times speed.
_CERTAIN, _DISSIPATED = 5.0, 0.01
# Masses of a URDF are seldom off by more than this factor altogether. Gravity that is off by more than this
# share has another direction; a component that is less of it is not compared.
_MASS_FACTOR, _GRAVITY_PART, _COMPARABLE_PART = 5.0, 0.5, 0.1
# Weight below this share of all torques is not compared.
_BORNE_PART = 0.02
_KNOWN_FACTORS = (
    (180.0 / np.pi, "degrees per second; multiply by pi / 180"),
    (-1.0, "of the opposite sign; negate one of the two"),
    (1000.0, "in mrad/s or times are in ms; divide by 1000"),
    (0.001, "per ms; multiply by 1000"),
)


def wrong_motion(robot: UrdfRobot, log: JointLog) -> Iterator[str]:
    """Yield what is wrong with times, positions and velocities, with file, column, number and remedy."""
    reach = max(1, len(log.q_rad) // 500)
    speed = np.concatenate([_mean_speed(piece, reach) for piece in log.pieces()])
    top = np.abs(speed).max(axis=0)
    limit = np.where(np.isfinite(robot.limits[:, 2]), robot.limits[:, 2], _USUAL_RAD_S)
    names, fastest = robot.chain.serials, int(np.argmax(top / limit))
    if log.rate_hz < _SLOW_HZ and (top < _SLOW_PART * limit).all():
        yield (
            f"{log.column('t', '')}: a sample every {1.0 / log.rate_hz:.3g} s, and the fastest joint, "
            f"{names[fastest]}, turns at {top[fastest]:.2g} rad/s at most (limit {limit[fastest]:.3g}); "
            "seconds and Hz are needed: milliseconds must be divided by 1000, kHz multiplied"
        )
        return
    for i, name in enumerate(names):
        furthest = float(np.abs(log.q_rad[:, i]).max())
        allowed = float(np.abs(robot.limits[i, :2]).max())
        if furthest > _BEYOND_RANGE * allowed or top[i] > _BEYOND_SPEED * limit[i]:
            yield (
                f"{log.column('q', name)}: up to {furthest:.4g} rad at {top[i]:.3g} rad/s; the URDF allows "
                f"{allowed:.4g} rad and {limit[i]:.3g} rad/s; radians are needed: degrees must be multiplied "
                "by pi / 180"
            )
    if log.qd_rad_s is not None:
        yield from _wrong_velocities(robot, log, speed, reach)


def _mean_speed(log: JointLog, reach: int) -> Array:
    """Return the mean speeds over 2 reach samples."""
    step = log.q_rad[2 * reach :] - log.q_rad[: -2 * reach]
    return np.asarray(step * (log.rate_hz / (2 * reach)))


def _wrong_velocities(robot: UrdfRobot, log: JointLog, speed: Array, reach: int) -> Iterator[str]:
    """Compare the means of the velocities over an interval with the differences of positions over it."""
    means = []
    for piece in log.pieces():
        assert piece.qd_rad_s is not None
        total = np.cumsum(0.5 * (piece.qd_rad_s[1:] + piece.qd_rad_s[:-1]), axis=0)
        total = np.vstack([np.zeros_like(total[:1]), total])
        means.append((total[2 * reach :] - total[: -2 * reach]) / (2 * reach))
    measured = np.concatenate(means)
    product, own, other = (
        np.sum(a * b, axis=0) for a, b in ((measured, speed), (speed,) * 2, (measured,) * 2)
    )
    for i, name in enumerate(robot.chain.serials):
        if not own[i] > 0.0:
            continue
        factor = product[i] / own[i]
        correlation = abs(product[i]) / np.sqrt(own[i] * other[i]) if other[i] > 0.0 else 0.0
        if correlation > _SAME_CORRELATION and abs(factor - 1.0) < _SAME_WITHIN:
            continue
        remedy = [text for known, text in _KNOWN_FACTORS if abs(factor / known - 1.0) < _SAME_WITHIN]
        yield (
            f"{log.column('qd', name)}: {factor:.3g} times the derivative of its position, correlation "
            f"{correlation:.2f}; rad/s of the same joint are needed"
            + (f": it is {remedy[0]}" if remedy and correlation > _SAME_CORRELATION else "")
        )


def wrong_torques(problem: Problem, log: JointLog) -> Iterator[str]:
    """Yield what is wrong with torques, gravity and length, with file, column, number and remedy."""
    yield from _too_short(problem, log)
    flipped = list(_flipped(problem, log))
    yield from flipped
    if not flipped and problem.robot.phi is not None:
        yield from _against_masses(problem, problem.robot.phi, log)


def _too_short(problem: Problem, log: JointLog) -> Iterator[str]:
    samples = len(problem.log.tau_nm)
    for half, part in (("first", slice(0, samples // 2)), ("second", slice(samples // 2, samples))):
        direction = np.where(problem.moving[part], np.sign(problem.log.qd_rad_s[part]), 0.0)
        for i in np.flatnonzero((direction.max(axis=0) < 1.0) | (direction.min(axis=0) > -1.0)):
            yield (
                f"{log.column('q', problem.robot.chain.serials[i])}: in the {half} half of "
                f"{log.duration_s:.2f} s it does not turn both ways; the recording is too short: every joint "
                "must turn forth and back in each half"
            )


def _flipped(problem: Problem, log: JointLog) -> Iterator[str]:
    """Yield the joints whose friction adds power: fitted alone, with bodies of its own."""
    for i, name in enumerate(problem.robot.chain.serials):
        own = [
            problem.inertial + k
            for k, drive in enumerate(problem.drives)
            if drive.term in ("viscous", "coulomb", "curved") and i in drive.joints
        ]
        used = problem.moving[:, i]
        power, sigma = _friction_power(problem, i, own)
        size = float(np.sqrt(np.mean(problem.log.tau_nm[used, i] ** 2 * problem.log.qd_rad_s[used, i] ** 2)))
        if power < -_CERTAIN * sigma and power < -_DISSIPATED * size:
            yield (
                f"{log.column('tau', name)}: its friction would add {-power:.3g} +- {sigma:.2g} W to the "
                "motion; the sign of the torque is flipped against that of the position: negate it"
            )


def _friction_power(problem: Problem, joint: int, friction: list[int]) -> tuple[float, float]:
    fit = _fit(problem, problem.regressor[:, [joint]], [joint], problem.columns.scale)
    speed = np.where(problem.moving[:, joint], problem.log.qd_rad_s[:, joint], 0.0)
    power = speed @ problem.regressor[:, joint][:, friction] / problem.moving[:, joint].sum()
    covariance = fit.covariance[np.ix_(friction, friction)]
    return float(power @ fit.parameters[friction]), float(np.sqrt(power @ covariance @ power))


def _against_masses(problem: Problem, phi: Array, log: JointLog) -> Iterator[str]:
    """Fit gravity and a factor of all inertia to the URDF's bodies: tau = a M qdd + .. + sum g_k G_k(q)."""
    chain, motion = problem.robot.chain, problem.log[2:5]
    weightless = inverse_dynamics(chain._replace(gravity=np.zeros(3)), phi, *motion)
    pulls = [inverse_dynamics(chain._replace(gravity=unit), phi, *motion) - weightless for unit in np.eye(3)]
    columns = np.stack([weightless, *pulls], axis=2)
    regressor = np.concatenate([columns, problem.regressor[..., problem.inertial :]], axis=2)
    fit = _fit(problem, regressor, list(range(len(chain.serials))), np.ones(regressor.shape[2]))
    factor, gravity = float(fit.parameters[0]), fit.parameters[1:4]
    sigma = np.sqrt(np.diagonal(fit.covariance)[:4])
    size = float(np.linalg.norm(chain.gravity))
    # A vertical axis that is tilted by a hair bears a hair of the weight: it tells nothing.
    felt = size * np.linalg.norm(pulls, axis=(1, 2)) > _BORNE_PART * np.linalg.norm(problem.log.tau_nm)
    given, shown = np.where(felt, chain.gravity, 0.0), np.where(felt, gravity, 0.0)
    # Where given gravity loads no joint there is nothing to compare the units with.
    comparable = float(np.linalg.norm(given)) > _COMPARABLE_PART * size
    ratio = float(np.linalg.norm(shown)) / size if comparable else 1.0
    if not np.linalg.norm(shown - given) > _CERTAIN * np.linalg.norm(sigma[1:][felt]):
        return
    text = (
        f"{log.file}: with the URDF's masses the torques show gravity {_three(gravity)} m/s^2, given is "
        f"{_three(chain.gravity)}"
    )
    if shown @ given < 0.0 and factor < -_CERTAIN * sigma[0]:
        yield f"{text}, and inertias of {factor:.2g} times theirs: negate the tau columns"
    elif not 1.0 / _MASS_FACTOR < ratio < _MASS_FACTOR:
        yield (
            f"{text}: the tau columns are {ratio:.3g} times the torque [Nm] of those masses; "
            "currents need --gain JOINT=NM_PER_A, other units a factor"
        )
    elif np.linalg.norm(shown / ratio - given) > _GRAVITY_PART * size:
        yield (
            f"{text}: the base is mounted otherwise, or the zero of a joint is; give "
            f"--gravity {','.join(f'{9.81 * g / np.linalg.norm(gravity):.3g}' for g in gravity)} or so"
        )


def _three(vector: Array) -> str:
    return "(" + ", ".join(f"{part:.3g}" for part in vector) + ")"


def _fit(problem: Problem, regressor: Array, joints: list[int], scale: Array) -> WeightedFit:
    return fit_weighted(
        regressor,
        problem.log.tau_nm[:, joints],
        scale,
        used=problem.moving[:, joints],
        min_correlation=problem.log.rate_hz / (2.0 * problem.log.cutoff_hz),
    )
