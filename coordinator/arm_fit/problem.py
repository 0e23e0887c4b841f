"""The least-squares problem of a recording: the columns of the model for every sample that is used."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.arm_fit.filtered_log import FilteredLog
from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.drive_model import (
    USUAL_TERMS,
    DriveColumn,
    drive_columns,
    drive_regressor,
    drive_signals,
)
from coordinator.parameter_fit.base_parameters import Columns, inertial_columns
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only
from module_agent.model.regressor import PER_BODY, torque_regressor
from module_agent.signals.torque_terms import TERM_KINDS, Term


class ModelChoice(NamedTuple):
    """The terms and options of the model.

    terms, coupled: see `drive_columns`; if `coupled` is None, pairs of neighbouring joints are tried.
    robust: Huber's weights. slow_part, mask_part: the speed below which the sign of friction fades, and that
    below which a sample is masked, in parts of the joint's top speed. tried: terms that are tried joint by
    joint, and kept where they pay (`drive_choice`). extra: columns that are in the model besides.
    """

    terms: tuple[Term, ...] = USUAL_TERMS
    coupled: tuple[tuple[int, int], ...] | None = None
    robust: bool = False
    slow_part: float = 0.01
    mask_part: float = 0.05
    tried: tuple[Term, ...] = ("load", "curved", "stribeck", "asymmetry")
    extra: tuple[DriveColumn, ...] = ()


class Problem(NamedTuple):
    """m samples of n joints and p columns, the inertial ones first; arrays are read-only.

    moving: (m, n) samples whose joint turns fast enough that friction has a direction. Only these are fitted:
        friction at rest depends on how the joint came to a stop. instruments: (m, n, p) the regressor by
        other measurements of the same motion, None for least squares.

    The column of friction that grows with the load has the sign alone; `linearised` multiplies by the load.
    """

    robot: UrdfRobot
    log: FilteredLog
    choice: ModelChoice
    drives: tuple[DriveColumn, ...]
    columns: Columns
    regressor: Array
    moving: NDArray[np.bool_]
    instruments: Array | None

    @property
    def inertial(self) -> int:
        """The number of columns of the bodies."""
        return PER_BODY * len(self.robot.bodies)

    @property
    def loads(self) -> list[tuple[int, int]]:
        """The columns of friction that grows with the load, each with its joint."""
        return [(self.inertial + k, d.joints[0]) for k, d in enumerate(self.drives) if d.term == "load"]

    def linearised(self, x: Array, regressor: Array) -> tuple[Array, Array]:
        """Return the derivatives J (m, n, p) of the torques at parameters x, and J x less the torques (m, n).

        Of tau = Y phi + Fl |Y phi| s the derivative by phi is Y (1 + Fl sign(Y phi) s).
        """
        shift = np.zeros(regressor.shape[:2])
        if not self.loads:
            return regressor, shift
        slope = regressor.copy()
        for column, joint in self.loads:
            rigid, sign = (
                regressor[:, joint, : self.inertial] @ x[: self.inertial],
                regressor[:, joint, column],
            )
            slope[:, joint, : self.inertial] *= (1.0 + x[column] * np.sign(rigid) * sign)[:, None]
            slope[:, joint, column] = sign * np.abs(rigid)
            shift[:, joint] = x[column] * slope[:, joint, column]
        return slope, shift

    def predicted(self, x: Array, some: slice) -> Array:
        """Return the torques (m', n) of some samples by parameters x (p,)."""
        slope, shift = self.linearised(x, self.regressor[some])
        return np.asarray(slope @ x - shift)

    def with_drives(self, keep: Callable[[DriveColumn], bool], bodies: bool = True) -> "Problem":
        """Return the problem with some of the drives' columns, and with or without the bodies'."""
        some = np.array(
            [bodies] * self.inertial + [keep(drive) for drive in self.drives],
            dtype=bool,
        )
        at = np.flatnonzero(some)
        order = {int(column): i for i, column in enumerate(at)}
        preferred = [order[int(c)] for c in self.columns.preferred if some[c]]
        return self._replace(
            drives=tuple(drive for drive in self.drives if keep(drive)),
            columns=Columns(
                tuple(self.columns.names[i] for i in at),
                self.columns.scale[at],
                np.array(preferred, dtype=np.int64),
            ),
            regressor=self.regressor[..., at],
            instruments=None if self.instruments is None else self.instruments[..., at],
        )


def problem(
    robot: UrdfRobot,
    log: FilteredLog,
    choice: ModelChoice,
    again: FilteredLog | None = None,
    top_rad_s: Array | None = None,
) -> Problem:
    """Pose the least-squares problem of a recording.

    Args:
        robot, log, choice: the arm, the filtered recording, and the model.
        again: the same motion at the same times by other measurements, for instruments (`in_two`).
        top_rad_s: (n,) top speeds that the speed limits refer to, of another recording; by default this
        one's.

    Raises:
        UsageError: parts of speed out of range, or a joint that never moves.
        ValueError: terms or pairs that do not exist (`drive_columns`).
    """
    for name, part in (("slow", choice.slow_part), ("mask", choice.mask_part)):
        if not 0.0 < part < 1.0:
            raise UsageError(f"the {name} part of the top speed is {part}; it must be between 0 and 1")
    top_rad_s = log.top_rad_s if top_rad_s is None else top_rad_s
    if (still := np.flatnonzero(top_rad_s < 1e-6)).size:
        raise UsageError(
            f"joint {robot.chain.serials[still[0]]!r} never moves in the recording; its friction is not "
            "determined: record a motion of all joints"
        )
    drives = (*drive_columns(len(robot.bodies), choice.terms, choice.coupled or ()), *choice.extra)
    slow_rad_s = choice.slow_part * top_rad_s
    moving = np.abs(log.qd_rad_s) > choice.mask_part * top_rad_s
    moving.flags.writeable = False
    return Problem(
        robot=robot,
        log=log,
        choice=choice,
        drives=drives,
        columns=inertial_columns(len(robot.bodies)).append([drive.name for drive in drives]),
        regressor=_regressor(robot, drives, log, slow_rad_s),
        moving=moving,
        instruments=None if again is None else _regressor(robot, drives, again, slow_rad_s),
    )


def joined(one: Problem, other: Problem) -> Problem:
    """Return the samples of both recordings, those of `one` first, to fit one and test on the other.

    Raises:
        ValueError: the two have different columns.
    """
    if one.columns.names != other.columns.names:
        raise ValueError("two recordings with different columns cannot be joined")
    log, more = one.log, other.log
    return one._replace(
        log=log._replace(
            q_rad=np.concatenate([log.q_rad, more.q_rad]),
            qd_rad_s=np.concatenate([log.qd_rad_s, more.qd_rad_s]),
            qdd_rad_s2=np.concatenate([log.qdd_rad_s2, more.qdd_rad_s2]),
            tau_nm=np.concatenate([log.tau_nm, more.tau_nm]),
            tau_raw_nm=np.concatenate([log.tau_raw_nm, more.tau_raw_nm]),
        ),
        regressor=np.concatenate([one.regressor, other.regressor]),
        moving=np.concatenate([one.moving, other.moving]),
        instruments=None
        if one.instruments is None
        # Only `one` is fitted; the tested samples need none.
        else np.concatenate([one.instruments, other.regressor]),
    )


def _regressor(robot: UrdfRobot, drives: Sequence[DriveColumn], log: FilteredLog, slow_rad_s: Array) -> Array:
    inertial = torque_regressor(robot.chain, log.q_rad, log.qd_rad_s, log.qdd_rad_s2)
    further = drive_regressor(drives, _signals(drives, log, slow_rad_s), len(robot.bodies))
    regressor = np.concatenate([inertial, further], axis=2)
    return read_only(regressor)


def _signals(drives: Sequence[DriveColumn], log: FilteredLog, slow_rad_s: Array) -> Array:
    """Return the drives' signals (m, k) low-passed as the torques are."""
    signals = drive_signals(drives, log.qd_rad_s, log.qdd_rad_s2, slow_rad_s).copy()
    at = [k for k, drive in enumerate(drives) if not TERM_KINDS[drive.term].linear]
    if at:
        some = [drives[k] for k in at]
        motions = zip(log.fine_qd_rad_s, log.fine_qdd_rad_s2, strict=True)
        signals[:, at] = log.low_passed([drive_signals(some, *motion, slow_rad_s) for motion in motions])
    return signals
