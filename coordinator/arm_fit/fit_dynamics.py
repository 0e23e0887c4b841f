"""The library's `fit_dynamics`: inertia, friction and motors of an arm from its URDF and a log of torques."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.arm_fit.checks import wrong_torques
from coordinator.arm_fit.consistent_bodies import USUAL_TRUST, lacking, urdf_drives
from coordinator.arm_fit.cutoff import CutoffPoint, chosen_cutoff_hz, cutoff_curve
from coordinator.arm_fit.data_file import DataFileError, JointLog, in_two
from coordinator.arm_fit.drive_choice import Trial, candidates, choose_drives, pairs
from coordinator.arm_fit.filtered_log import filtered_log, max_samples
from coordinator.arm_fit.fit import Elsewhere, fit_and_test
from coordinator.arm_fit.payload import KnownPayload, factors_by_payload, read_baseline
from coordinator.arm_fit.predictions import Predictions
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.arm_fit.recordings import Recordings, Source, read_other, read_recordings
from coordinator.arm_fit.report import FitReport, TorqueFactorPart
from coordinator.description.urdf_reader import STANDARD_GRAVITY, UrdfRobot, read_urdf
from coordinator.description.urdf_update import fitted_urdf_text
from coordinator.dynamics.pseudo_inertia import Body
from coordinator.parameter_fit.base_parameters import BaseParameters
from coordinator.parameter_fit.torque_constants import TorqueFactors
from module_agent.model.chain import Array
from module_agent.model.errors import DataError, UsageError
from module_agent.model.files import write_text
from module_agent.model.read_only import read_only

_USUAL = ModelChoice()
_NO_GAINS: Mapping[str, float] = MappingProxyType({})


class ArmFit(NamedTuple):
    """The dynamics of an arm with n joints as `fit_dynamics` returns them; SI units, arrays are read-only.

    robot: the arm by its URDF. report: everything with its uncertainty: base parameters, drives, residuals,
        and torque errors on samples that were not fitted to.
    bodies: (n,) physically consistent bodies in the frames of the links `robot.bodies`, centre of mass and
        the inertia about it. phi: (10 n,) the same in the root frame at q = 0, as `torque_regressor` takes
        them. drives: (n, 3) rotor inertia behind the gear [kg m^2], viscous [Nm s/rad] and Coulomb [Nm], as a
        URDF holds them (`urdf_drives`). urdf: the text of the URDF with bodies and drives. The four are None
        if the URDF gives a link no mass, so that there is no prior for what the torques do not determine;
        `report.fit.bodies_note` says so.
    base: the base parameters in the frames of the links, with covariance and grouping. torques: measured and
        predicted.
    """

    robot: UrdfRobot
    report: FitReport
    base: BaseParameters
    torques: Predictions
    bodies: tuple[Body, ...] | None
    phi: Array | None
    drives: Array | None
    urdf: str | None

    def write_urdf(self, path: str | Path) -> None:
        """Write the URDF with the fitted bodies and friction, whole or not at all.

        Raises:
            DataError: there are no bodies to write.
            OSError: the file cannot be written.
        """
        if self.urdf is None:
            raise DataError(
                f"{path}: not written, there are no physically consistent bodies: "
                f"{self.report.fit.bodies_note}"
            )
        write_text(Path(path), self.urdf)


def fit_dynamics(
    urdf: str | Path | UrdfRobot,
    data: Source | Sequence[Source],
    *,
    held_out: Source | None = None,
    gains: Mapping[str, float] = _NO_GAINS,
    choice: ModelChoice = _USUAL,
    instruments: bool = False,
    cutoff_hz: float | None = None,
    gravity: ArrayLike = STANDARD_GRAVITY,
    trust: float = USUAL_TRUST,
    checked: bool = True,
    baseline: str | Path | FitReport | None = None,
    payload_body: str | None = None,
    loaded: Source | None = None,
    known_payload: KnownPayload | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> ArmFit:
    """Identify inertia, friction and motors of an arm, and test the result on held-out samples.

    The torques are a linear function of the parameters, tau = Y(q, qd, qdd) x; every joint's equations are
    weighted by its residual, and the covariance takes the correlation of the residuals into account
    (`fit_weighted`). The bodies are those nearest to the URDF's that explain the torques
    (`consistent_bodies`).

    Args:
        urdf: file of the arm, or what `read_urdf` returned for it.
        data: CSV or npz file of the recording (see `read_log`), or the recording itself; or several. Joints
            that stand still in all of them are held where they are: taken as fixed.
        held_out: another recording of the same arm, predicted by the fit to the whole of `data`.
        gains: torque constants [Nm/A], gear included, of joints whose currents are in the files.
        choice: terms of the drives, joints that share a drive, robust weights, and the speeds below which
            friction fades and samples are masked.
        instruments: fit by instrumental variables, every other sample against the rest, so that the noise of
            the encoders does not bias the inertias; needs twice as many samples.
        cutoff_hz: low-pass over motion and torque; by default that with which halves predict each other's raw
            torques best (`cutoff_curve`).
        gravity: (3,) specific force at rest in the root link's frame [m/s^2], upwards. Ignored if `urdf` is a
            robot, whose chain has its own.
        trust: weight of the URDF's inertias for the bodies.
        checked: refuse a recording whose units, signs, gravity or length are wrong (`checks`).
        baseline: report of an earlier fit of the same arm without the payload that it carries in `data`, or
            its JSON file; then `report.payload` is what was added.
        payload_body: the link that carries the payload, the last body's by default.
        loaded: another recording of the arm, with `known_payload`, which `data` is without. The two tell
            the scale of the joints' readings, and with it torque constants; the fit is to `data` in Nm.
        progress: is called with a sentence before every step (`STEPS`).

    Raises:
        UsageError: a file that is not what it should be, or an option out of range.
        DataError: the recording does not determine the parameters.
        OSError: a file cannot be read.
    """
    if not 0.0 < trust < np.inf:
        raise UsageError(f"trust {trust}: it must be a number above 0")
    sources = [data] if isinstance(data, str | Path | JointLog) else list(data)
    names = ", ".join(_name(source) for source in sources)
    progress(f"read {_name(urdf)} and {names}")
    robot = urdf if isinstance(urdf, UrdfRobot) else read_urdf(urdf, gravity)
    recordings = read_recordings(robot, sources, gains, checked)
    known = read_baseline(baseline, recordings.robot, payload_body)
    factors: list[TorqueFactorPart] = []
    if (loaded is None) != (known_payload is None):
        raise UsageError("a known payload needs a recording with it (loaded), and the other way round")
    if loaded is not None and known_payload is not None:
        fitted_factors = _factors(recordings, loaded, known_payload, choice, cutoff_hz)
        factors = _factor_parts(recordings, fitted_factors)
        recordings = recordings.scaled(fitted_factors.value)
    robot, log = recordings.robot, recordings.log
    if choice.coupled is not None:
        places = {joint: i for i, joint in enumerate(recordings.moving)}
        moving = [pair for pair in choice.coupled if set(pair) <= set(places)]
        choice = choice._replace(coupled=tuple((places[i], places[j]) for i, j in moving))
    posed, curve, trials = _chosen(
        robot, log, choice, cutoff_hz=cutoff_hz, instruments=instruments, checked=checked, progress=progress
    )
    elsewhere = (
        None if held_out is None else Elsewhere(_name(held_out), _posed_like(posed, recordings, held_out))
    )
    result = fit_and_test(
        posed,
        log,
        curve,
        trials,
        urdf_name=_name(urdf),
        data_name=names,
        step=progress,
        trust=trust,
        elsewhere=elsewhere,
        baseline=known,
    )
    report = result.report.model_copy(update={"torque_factors": factors})
    parts = (robot, report, result.base, result.torques)
    if result.consistent is None:
        return ArmFit(*parts, bodies=None, phi=None, drives=None, urdf=None)
    fitted = result.consistent
    x = np.concatenate([fitted.phi, fitted.drives])
    drives = read_only(urdf_drives(posed, x, slice(0, len(posed.log.tau_nm))))
    text = fitted_urdf_text(robot, fitted.bodies, drives, lacking(posed))
    return ArmFit(*parts, bodies=fitted.bodies, phi=fitted.phi, drives=drives, urdf=text)


def _factors(
    recordings: Recordings,
    loaded: Source,
    payload: KnownPayload,
    choice: ModelChoice,
    cutoff_hz: float | None,
) -> TorqueFactors:
    """Return the factors of the joints' readings by a recording with a known payload."""
    robot, log, plain = recordings.robot, recordings.log, choice._replace(coupled=(), tried=())
    cutoff = chosen_cutoff_hz(cutoff_curve(robot, log, plain)) if cutoff_hz is None else cutoff_hz
    unloaded = _posed(robot, log, plain, cutoff, instruments=False)
    return factors_by_payload(unloaded, _posed_like(unloaded, recordings, loaded), payload)


def _factor_parts(recordings: Recordings, factors: TorqueFactors) -> list[TorqueFactorPart]:
    return [
        TorqueFactorPart(
            joint=joint, factor=value if known else None, sigma=sigma if np.isfinite(sigma) else None
        )
        for joint, value, sigma, known in zip(
            recordings.robot.chain.serials, *(part.tolist() for part in factors), strict=True
        )
    ]


def _chosen(
    robot: UrdfRobot,
    log: JointLog,
    choice: ModelChoice,
    *,
    cutoff_hz: float | None,
    instruments: bool,
    checked: bool,
    progress: Callable[[str], None],
) -> tuple[Problem, tuple[CutoffPoint, ...], tuple[Trial, ...]]:
    """Choose the low-pass, the friction of each joint, and with that the low-pass once more.

    Raises:
        DataFileError: if `checked`, torques that are not what they should be.
    """
    progress("choose the low-pass")
    joints = len(robot.bodies)
    with_pairs = choice._replace(coupled=choice.coupled or pairs(choice, joints))
    curve = cutoff_curve(robot, log, with_pairs) if cutoff_hz is None else ()
    extra = candidates(choice, joints)
    cutoff = chosen_cutoff_hz(curve) if cutoff_hz is None else cutoff_hz
    posed = _posed(robot, log, choice._replace(extra=extra), cutoff, instruments)
    if checked and (texts := list(wrong_torques(posed.with_drives(lambda d: d not in extra), log))):
        raise DataFileError("\n".join(texts))
    progress("choose the friction of each joint")
    posed, trials = choose_drives(posed)
    if cutoff_hz is None and any(trial.kept for trial in trials):
        curve = cutoff_curve(robot, log, posed.choice)
        posed = _posed(robot, log, posed.choice, chosen_cutoff_hz(curve), instruments)
    return posed, curve, trials


def _name(source: str | Path | UrdfRobot | JointLog) -> str:
    if isinstance(source, UrdfRobot):
        return str(source.path)
    return "a recording in memory" if isinstance(source, JointLog) else str(source)


def _posed(robot: UrdfRobot, log: JointLog, choice: ModelChoice, cutoff: float, instruments: bool) -> Problem:
    count = max_samples(len(robot.bodies))
    if not instruments:
        return problem(robot, filtered_log(log, cutoff, count), choice)
    one, again = (filtered_log(half, cutoff, count) for half in in_two(log))
    return problem(robot, one, choice, again)


def _posed_like(posed: Problem, recordings: Recordings, data: Source) -> Problem:
    """Pose another recording with the cut-off and the top speeds of the first one."""
    other = read_other(recordings, data)
    try:
        log = filtered_log(other, posed.log.cutoff_hz, max_samples(len(posed.robot.bodies)))
    except UsageError as error:
        raise UsageError(f"{_name(data)}: {error}") from None
    return problem(posed.robot, log, posed.choice, top_rad_s=posed.log.top_rad_s)
