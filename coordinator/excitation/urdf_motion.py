"""The motion that tells most about the dynamics of any arm, within its limits and clear of itself.

Every joint follows a finite Fourier series about home (Swevers et al., Optimal robot excitation and
identification, 1997), whose coefficients are such that the motion begins and ends at rest, at home:

    q(t) = home + sum_l a_l sin(l w t) / (l w) + b_l (cos(l w t) - 1) / (l w),  sum a_l = 0,  sum l b_l = 0.

It can be repeated without a stop. Among random series the best is changed joint by joint as long as that
helps. The score is D-optimality, the mean log eigenvalue of the information about base parameters and
drives, less the log condition number, because D-optimality alone strengthens what is strong already.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space

from coordinator.description.shape_clearance import ClearanceCheck
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.drive_model import USUAL_TERMS, drive_columns, drive_regressor, drive_signals
from coordinator.excitation.joint_limits import NoExcitation
from coordinator.excitation.segment import SampledMotion
from coordinator.parameter_fit.base_parameters import inertial_columns
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE, spectrum
from module_agent.model.chain import Array
from module_agent.model.files import write_text
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import inverse_dynamics, torque_regressor

# Samples of the fastest sine while motions are tried, and in the last check.
_COARSE, _FINE = 30, 1000
# Share of a limit that is used: the coarse grid misses 0.6 % of a peak.
LIMIT_SHARE = 0.95
# Motions that collide or need too much torque are made smaller.
_SHRINK = (1.0, 0.8, 0.6, 0.4, 0.25, 0.15)
# In the last check, on the fine grid, by 3 % at a time.
_SHRINKS = 20
# Random motions, of which the best is improved; the directions that so many excite are the base parameters.
_RANDOM_SHARE, _SPANNING = 0.15, 6
# Change of a joint's coefficients as a share of their size, at first; 1/5 of the changes should succeed.
_STEP, _LONGER, _SHORTER = 0.3, 1.5, 0.9
_STEPS_RANGE = (0.01, 1.0)
ROUNDS = 20
# Of the top speed; below it Coulomb friction fades (as in `fit-dynamics`).
_SLOW_PART = 0.01


class MotionTask(NamedTuple):
    """The arm to be excited and its limits; arrays (n,).

    low_rad, high_rad, speed_rad_s, accel_rad_s2: limits of all joints, finite. effort_nm: largest torques,
    infinite where not known; kept by the URDF's bodies if it has any. sigma_nm: relative noise of the
    torques. clearance: None if collisions are not checked.
    """

    robot: UrdfRobot
    low_rad: Array
    high_rad: Array
    speed_rad_s: Array
    accel_rad_s2: Array
    effort_nm: Array
    sigma_nm: Array
    home_rad: Array
    period_s: float
    harmonics: int
    clearance: ClearanceCheck | None


class FourierMotion(NamedTuple):
    """A periodic motion of n joints from rest at home to rest at home; coefficients (2 harmonics - 2, n)."""

    home_rad: Array
    period_s: float
    harmonics: int
    coefficients: Array

    def sampled(self, t_s: Array) -> SampledMotion:
        """Return the motion at times (m,)."""
        q, qd, qdd = (part @ self.coefficients for part in _basis(t_s, self.period_s, self.harmonics))
        motion = SampledMotion(self.home_rad + q, qd, qdd)
        make_read_only(motion)
        return motion


class Design(NamedTuple):
    """A motion, the condition number and rank of its regressor, weighted by `MotionTask.sigma_nm`.

    random_condition: the median of random motions of the same length within the same limits, which may
    collide.
    """

    motion: FourierMotion
    condition: float
    rank: int
    random_condition: float


def design_motion(
    task: MotionTask, rng: np.random.Generator, tries: int, progress: Callable[[int, str], None]
) -> Design:
    """Search for the motion.

    Args:
        task: arm and limits. rng: of the search. tries: motions that are tried.
        progress: is called with 1 to `ROUNDS` and a sentence before each part of the search.

    Raises:
        NoExcitation: no random motion is possible.
    """
    search = _Search(task)
    first = max(int(_RANDOM_SHARE * tries), 1)
    progress(1, f"try {first} random motions")
    drawn = [search.draw(rng) for _ in range(first)]
    scores = [search.score(coefficients) for coefficients in drawn]
    best, score = _first_possible(search, drawn, scores)
    step = np.full(len(task.home_rad), _STEP)
    for k in range(tries - first):
        if k * (ROUNDS - 1) % (tries - first) < ROUNDS - 1:
            part = 2 + k * (ROUNDS - 1) // (tries - first)
            progress(part, f"improve the best: condition number {score.condition:.0f}")
        joint = int(rng.integers(len(step)))
        changed = best.copy()
        size = np.abs(best[:, joint]).mean() * step[joint]
        changed[:, joint] += size * rng.normal(size=len(best))
        changed *= np.minimum(1.0, search.room(changed))
        tried = search.score(changed)
        better = tried.value > score.value and search.is_possible(changed)
        if better:
            best, score = changed, tried
        step[joint] = np.clip(step[joint] * (_LONGER if better else _SHORTER), *_STEPS_RANGE)
    motion = FourierMotion(task.home_rad, task.period_s, task.harmonics, best)
    fine = _Search(task, _FINE)
    share = next((s for s in 0.97 ** np.arange(_SHRINKS) if fine.is_possible(s * best)), None)
    if share is None:
        raise NoExcitation("the motion that was designed comes too near to a collision between its samples")
    best = share * best
    make_read_only((best,))
    condition = search.score(best).condition
    typical = float(np.median([one.condition for one in scores]))
    return Design(motion._replace(coefficients=best), condition, search.base.shape[1], typical)


class _Score(NamedTuple):
    value: float
    condition: float


class _Search:
    """What is computed once for all motions: the series on a grid of time, and the base parameters."""

    def __init__(self, task: MotionTask, per_sine: int = _COARSE):
        self.task = task
        t_s = np.linspace(0.0, task.period_s, per_sine * task.harmonics, endpoint=False)
        self.basis = _basis(t_s, task.period_s, task.harmonics)
        joints = len(task.home_rad)
        self.drives = drive_columns(joints, USUAL_TERMS)
        self.scale = np.append(inertial_columns(joints).scale, np.ones(len(self.drives)))
        rng = np.random.default_rng(0)
        within = spectrum(np.vstack([self._rows(self.draw(rng)) for _ in range(_SPANNING)]))
        self.base = within.directions[within.determined(RANK_TOLERANCE)].T

    def draw(self, rng: np.random.Generator) -> Array:
        """Return a random motion that reaches the first limit of every joint."""
        drawn = rng.normal(size=(self.basis[0].shape[1], len(self.task.home_rad)))
        return np.asarray(drawn * self.room(drawn))

    def room(self, coefficients: Array) -> Array:
        """Return by how much every joint's motion may be multiplied (n,)."""
        task = self.task
        q, qd, qdd = (part @ coefficients for part in self.basis)
        tiny = 1e-12
        room = [
            (task.high_rad - task.home_rad) / np.maximum(q.max(axis=0), tiny),
            (task.home_rad - task.low_rad) / np.maximum(-q.min(axis=0), tiny),
            task.speed_rad_s / np.maximum(np.abs(qd).max(axis=0), tiny),
            task.accel_rad_s2 / np.maximum(np.abs(qdd).max(axis=0), tiny),
        ]
        return np.asarray(LIMIT_SHARE * np.min(room, axis=0))

    def is_possible(self, coefficients: Array) -> bool:
        """Tell whether a motion keeps torque and clearance, and on this grid the other limits."""
        task, (q, qd, qdd) = self.task, (part @ coefficients for part in self.basis)
        # 2 % of the share is for what the coarse grid misses.
        if (self.room(coefficients) < LIMIT_SHARE / (LIMIT_SHARE + 0.02)).any():
            return False
        if task.robot.phi is not None and np.isfinite(task.effort_nm).any():
            torque = inverse_dynamics(task.robot.chain, task.robot.phi, task.home_rad + q, qd, qdd)
            if (np.abs(torque) > LIMIT_SHARE * task.effort_nm).any():
                return False
        return task.clearance is None or task.clearance.is_clear(task.home_rad + q)

    def made_possible(self, coefficients: Array) -> Array | None:
        """Return a motion, made smaller if necessary, or None if that does not help."""
        smaller = (share * coefficients for share in _SHRINK)
        return next((one for one in smaller if self.is_possible(one)), None)

    def score(self, coefficients: Array) -> _Score:
        """Return the score of a motion, -inf if it leaves a base parameter open."""
        rows = self._rows(coefficients) @ self.base
        values = np.linalg.eigvalsh(rows.T @ rows)
        if not values[0] > 0.0:
            return _Score(-np.inf, np.inf)
        condition = float(np.sqrt(values[-1] / values[0]))
        return _Score(float(np.log(values).mean() - np.log(condition)), condition)

    def _rows(self, coefficients: Array) -> Array:
        task, (q, qd, qdd) = self.task, (part @ coefficients for part in self.basis)
        signals = drive_signals(self.drives, qd, qdd, _SLOW_PART * task.speed_rad_s)
        parts = [
            torque_regressor(task.robot.chain, task.home_rad + q, qd, qdd),
            drive_regressor(self.drives, signals, len(task.home_rad)),
        ]
        rows = np.concatenate(parts, axis=2) / task.sigma_nm[:, None]
        return np.asarray(rows.reshape(-1, len(self.scale)) * self.scale)


def _first_possible(search: _Search, drawn: list[Array], scores: list[_Score]) -> tuple[Array, _Score]:
    for k in np.argsort([-one.value for one in scores]):
        if (best := search.made_possible(drawn[k])) is not None:
            return best, search.score(best)
    raise NoExcitation(
        f"none of {len(drawn)} random motions about home is possible, not even at {min(_SHRINK):.2f} of its "
        "size: the links are too near to each other or to the floor, or hold more than their torque; give "
        "another --home or less --clearance"
    )


def _basis(t_s: Array, period_s: float, harmonics: int) -> tuple[Array, Array, Array]:
    """Return the series (m, 2 harmonics - 2) that begin at rest at zero, and two derivatives."""
    order = np.arange(1.0, harmonics + 1.0)
    rate = 2.0 * np.pi / period_s * order
    sines, cosines = null_space(np.ones((1, harmonics))), null_space(order[None])
    sin, cos = np.sin(t_s[:, None] * rate), np.cos(t_s[:, None] * rate)
    return (
        np.hstack([sin / rate @ sines, (cos - 1.0) / rate @ cosines]),
        np.hstack([cos @ sines, -sin @ cosines]),
        np.hstack([-rate * sin @ sines, -rate * cos @ cosines]),
    )


def write_motion(path: Path, task: MotionTask, motion: FourierMotion, periods: int, rate_hz: float) -> int:
    """Write a motion as CSV, whole or not at all, and return the number of its samples.

    Columns are `t_s`, and per joint `q_<joint>_rad`, `qd_<joint>_rad_s`, `qdd_<joint>_rad_s2` and, if the
    URDF has inertias, `tau_<joint>_nm` by them, to feed forward.

    Raises:
        OSError: the file cannot be written.
    """
    t_s = np.arange(int(periods * motion.period_s * rate_hz + 1e-6) + 1) / rate_hz
    sampled = motion.sampled(t_s)
    signals = {
        "q_{}_rad": sampled.q_rad,
        "qd_{}_rad_s": sampled.qd_rad_s,
        "qdd_{}_rad_s2": sampled.qdd_rad_s2,
    }
    if task.robot.phi is not None:
        signals["tau_{}_nm"] = inverse_dynamics(task.robot.chain, task.robot.phi, *sampled)
    names = ["t_s", *(form.format(name) for form in signals for name in task.robot.chain.serials)]
    rows = np.column_stack([t_s, *signals.values()])
    # Nothing below 1e-9 rad is resolved; minus zero would be written as such.
    lines = (",".join(f"{value:.9g}" for value in row) for row in (np.round(rows, 9) + 0.0).tolist())
    write_text(path, "\n".join([",".join(names), *lines]) + "\n")
    return len(t_s)
