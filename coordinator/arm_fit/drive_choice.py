"""Which joints need more than the usual terms: those that are significant and pay on held-out data.

Every kind is fitted for all joints at once first. A significant term is then tried by itself, in the order of
significance, and kept if the joint's own held-out error falls and that of all joints does not rise. The
halves that choose are those that the report tests on: some yes or no for each joint is all that they learn.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from coordinator.arm_fit.cross_validation import fit_part, fitted, held_out_errors
from coordinator.arm_fit.problem import ModelChoice, Problem
from coordinator.dynamics.drive_model import DriveColumn, drive_columns
from coordinator.dynamics.torque_prediction import TorqueError
from coordinator.parameter_fit.significance import SIGNIFICANT_CHANCE, chance_of, f_statistic

# The joint's error has to fall by this share; those of two joints that share a drive by far more.
_PAYS, _SHARED_PAYS = 0.01, 0.1


class Trial(NamedTuple):
    """A term of a joint, or a drive that two share, that was tried; see `TrialPart`."""

    name: str
    joint: str
    f: float
    chance: float
    before: float
    after: float | None
    kept: bool


def candidates(choice: ModelChoice, joints: int) -> tuple[DriveColumn, ...]:
    """Return the columns to try: neighbouring joints that may share a drive, then all joints of all kinds."""
    tried = [term for term in choice.tried if term not in choice.terms]
    return (
        *drive_columns(joints, choice.terms, pairs(choice, joints))[joints * len(choice.terms) :],
        *(DriveColumn(term, (i,)) for term in tried for i in range(joints)),
    )


def pairs(choice: ModelChoice, joints: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs of neighbouring joints that are tried: all, or none if the shared drives are given."""
    return tuple(pairwise(range(joints))) if choice.coupled is None else ()


def choose_drives(posed: Problem) -> tuple[Problem, tuple[Trial, ...]]:
    """Return the problem without those of its `extra` columns that do not pay, and what was tried.

    Raises:
        DataError: too few samples for the usual terms.
    """
    kept: list[DriveColumn] = []
    trials: list[Trial] = []
    before = _error(_with(posed, kept))
    kinds: dict[object, list[DriveColumn]] = {}
    for drive in posed.choice.extra:
        kinds.setdefault("shared" if drive.joints[1:] else drive.term, []).append(drive)
    for kind, some in kinds.items():
        tested = _tested(_with(posed, [*kept, *some]), some)
        for joints in dict.fromkeys(drive.joints for drive, *_ in tested):
            drive, f, chance = next(test for test in tested if test[0].joints == joints)
            own, at, after, pays = [d for d in some if d.joints == joints], list(joints), None, False
            if chance < SIGNIFICANT_CHANCE:
                after = _error(_with(posed, [*kept, *own]))
                part = 1.0 - (_PAYS if kind != "shared" else _SHARED_PAYS)
                falls = (after.per_joint[at] < part * before.per_joint[at]).all()
                pays = bool(falls and after.overall < before.overall)
            trials.append(_trial(posed, drive, f, chance, before, after, pays))
            if after is not None and pays:
                kept, before = [*kept, *own], after
    shared = tuple(dict.fromkeys((d.joints[0], d.joints[1]) for d in kept if d.joints[1:]))
    choice = posed.choice._replace(
        extra=tuple(drive for drive in kept if not drive.joints[1:]), coupled=posed.choice.coupled or shared
    )
    return _with(posed, kept)._replace(choice=choice), tuple(trials)


def _trial(
    posed: Problem,
    drive: DriveColumn,
    f: float,
    chance: float,
    before: TorqueError,
    after: TorqueError | None,
    pays: bool,
) -> Trial:
    worst = drive.joints[-1]
    return Trial(
        name=drive.name,
        joint=posed.robot.chain.serials[worst],
        f=f,
        chance=chance,
        before=float(before.per_joint[worst]),
        after=None if after is None else float(after.per_joint[worst]),
        kept=pays,
    )


def _with(posed: Problem, extra: Sequence[DriveColumn]) -> Problem:
    return posed.with_drives(lambda drive: drive in extra or drive not in posed.choice.extra)


def _tested(problem: Problem, some: Sequence[DriveColumn]) -> list[tuple[DriveColumn, float, float]]:
    """Return columns with their F and its chance, the most significant first."""
    fit = fit_part(problem, slice(0, len(problem.log.tau_nm)))
    at = [problem.inertial + problem.drives.index(drive) for drive in some]
    f = f_statistic(fit.parameters[at], np.sqrt(np.diagonal(fit.covariance)[at]))
    freedom = fit.independent_samples - fit.rank
    return [(some[k], float(f[k]), chance_of(float(f[k]), freedom)) for k in np.argsort(-f)]


def _error(problem: Problem) -> TorqueError:
    errors = held_out_errors(problem, fitted(problem))
    return next(e.error for e in errors if e.tried_on == "both" and not e.raw and not e.masked)
