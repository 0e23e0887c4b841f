"""Fit a recording, test the fit on held-out samples and put everything into the report."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.arm_fit.consistent_bodies import (
    USUAL_TRUST,
    ConsistentBodies,
    NoPriorError,
    consistent_bodies,
    lacking,
    urdf_prior,
)
from coordinator.arm_fit.cross_validation import (
    HeldOutError,
    Predictor,
    by_consistent_bodies,
    by_given_bodies,
    by_urdf,
    errors_elsewhere,
    fit_part,
    fitted,
    gain_of_terms,
    held_out_errors,
    length_curve,
    mean_torque,
)
from coordinator.arm_fit.cutoff import CutoffPoint
from coordinator.arm_fit.data_file import JointLog
from coordinator.arm_fit.drive_choice import Trial
from coordinator.arm_fit.payload import Baseline, added_payload, information_part
from coordinator.arm_fit.predictions import Predictions, predictions
from coordinator.arm_fit.problem import Problem, joined
from coordinator.arm_fit.report import (
    ArmParameterPart,
    CutoffPart,
    DataPart,
    ErrorPart,
    FitPart,
    FitReport,
    JointNoisePart,
    LengthPart,
    LinkBodyPart,
    Model,
    TermGainPart,
    TermPart,
    TrialPart,
)
from coordinator.parameter_fit.base_parameters import (
    BaseParameters,
    base_parameters,
    inertial_units,
    into_frames,
)
from coordinator.parameter_fit.identifiability import body_summary, identifiabilities, precision
from coordinator.parameter_fit.physically_consistent import NotSolvedError
from coordinator.parameter_fit.report_parts import base_parameter_parts, body_part, finite
from coordinator.parameter_fit.robust_least_squares import WeightedFit
from coordinator.parameter_fit.significance import SIGNIFICANT_CHANCE, chance_of, f_statistic
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY

_ROUNDING = 1e-9

Step = Callable[[str], None]
# Of `fit_dynamics`: reading, filtering, choosing and the four of `fit_and_test`.
STEPS = 7


class FitResult(NamedTuple):
    """The report, the consistent bodies with the drives (None where there are none), and details."""

    report: FitReport
    consistent: ConsistentBodies | None
    base: BaseParameters
    torques: Predictions


class Elsewhere(NamedTuple):
    """Another recording of the same robot, by its name, which is only predicted."""

    data: str
    problem: Problem


def fit_and_test(
    problem: Problem,
    log: JointLog,
    curve: Sequence[CutoffPoint],
    trials: Sequence[Trial],
    *,
    urdf_name: str,
    data_name: str,
    step: Step,
    trust: float = USUAL_TRUST,
    elsewhere: Elsewhere | None = None,
    baseline: Baseline | None = None,
) -> FitResult:
    """Fit a recording, and test the fit on samples that were held out.

    Args:
        problem: the recording as a least-squares problem. log: the same as recorded. curve: of the choice of
            the low-pass, empty if it was given. trials: of the choice of friction terms.
        urdf_name, data_name: names of the files for the report.
        step: is called with a sentence before each of the steps.
        trust: weight of the URDF's inertias for the consistent bodies (`consistent_bodies`).
        elsewhere: another recording to predict, posed with the top speeds of this one.
        baseline: an earlier fit of the arm without the payload that it carries in this recording.

    Raises:
        DataError: too few samples for the parameters.
    """
    step("fit to the whole recording")
    fit = fit_part(problem, slice(0, len(problem.log.tau_nm)))
    bodies, note = _consistent(problem, fit, trust)
    step("fit to each half, tried on the other")
    try:
        held_out = _held_out(problem, elsewhere, None if bodies is None else trust)
    except NotSolvedError as error:
        bodies, note = None, str(error)
        held_out = _held_out(problem, elsewhere, None)
    step("fit to ever longer parts")
    lengths = [
        LengthPart(seconds=p.seconds, all=p.all_samples, masked=p.masked) for p in length_curve(problem)
    ]
    step("fit without each kind of term")
    gains = [
        TermGainPart(without=g.without, all=g.all_samples, masked=g.masked) for g in gain_of_terms(problem)
    ]
    report = FitReport(
        urdf=urdf_name,
        data=data_name,
        held_out_data=None if elsewhere is None else elsewhere.data,
        recording=_data_part(log, curve, problem),
        held_out=held_out,
        lengths=lengths,
        gains=gains,
        fit=_fit_part(problem, fit, bodies, note),
        trials=[TrialPart(**trial._asdict()) for trial in trials],
        information=information_part(problem, fit),
        payload=None if baseline is None else added_payload(baseline, problem, fit),
    )
    return FitResult(report, bodies, named(problem, fit), predictions(problem, fit.parameters))


def named(problem: Problem, fit: WeightedFit) -> BaseParameters:
    """Return what a fit knows as base parameters in the frames of the URDF's links.

    Their covariance counts how alike the residuals are (`WeightedFit.covariance`).
    """
    homes = problem.robot.homes
    base = base_parameters(into_frames(fit.rows, homes), fit.target, problem.columns)
    in_root = into_frames(base.grouping, np.linalg.inv(homes))
    covariance = in_root @ fit.covariance @ in_root.T
    covariance.flags.writeable = False
    return base._replace(covariance=covariance)


def _consistent(problem: Problem, fit: WeightedFit, trust: float) -> tuple[ConsistentBodies | None, str]:
    try:
        return consistent_bodies(problem, fit, urdf_prior(problem.robot), trust), ""
    except (NoPriorError, NotSolvedError) as error:
        return None, str(error)


def _predictors(problem: Problem, trust: float | None) -> list[tuple[Model, tuple[Problem, Predictor]]]:
    tried: list[tuple[Model, tuple[Problem, Predictor]]] = [("fitted", (problem, fitted(problem)))]
    if trust is not None:
        prior = urdf_prior(problem.robot)
        tried.append(("bodies", (problem, by_consistent_bodies(problem, prior, trust))))
        tried.append(("fitted_urdf", (problem, by_urdf(problem, prior, trust))))
    if problem.robot.phi is not None:
        robot = problem.robot
        tried.append(("urdf", (problem, by_given_bodies(problem, problem.robot.phi, robot.drives))))
    if problem.drives:
        alone = problem.with_drives(lambda drive: drive.term != "load", bodies=False)
        tried.append(("drives_only", (alone, fitted(alone))))
    return [*tried, ("mean", (problem, mean_torque(problem)))]


def _held_out(problem: Problem, elsewhere: Elsewhere | None, trust: float | None) -> list[ErrorPart]:
    tests = [(name, held_out_errors(*tried)) for name, tried in _predictors(problem, trust)]
    if elsewhere is not None:
        both, seen = joined(problem, elsewhere.problem), len(problem.log.tau_nm)
        tests += [(name, errors_elsewhere(*tried, seen)) for name, tried in _predictors(both, trust)]
    return [_error_part(name, error) for name, errors in tests for error in errors]


def _error_part(model: Model, tested: HeldOutError) -> ErrorPart:
    return ErrorPart(
        model=model,
        tried_on=tested.tried_on,
        torque="raw" if tested.raw else "filtered",
        samples="masked" if tested.masked else "all",
        overall=finite(tested.error.overall),
        per_joint=[finite(float(e)) for e in tested.error.per_joint],
    )


def _data_part(log: JointLog, curve: Sequence[CutoffPoint], problem: Problem) -> DataPart:
    return DataPart(
        joints=list(problem.robot.chain.serials),
        duration_s=log.duration_s,
        recorded_hz=log.rate_hz,
        resampled=log.resampled,
        repeated_rows=log.repeated,
        bridged_holes=log.bridged,
        pieces=len(log.breaks) + 1,
        held=problem.robot.held,
        dropped_s=problem.log.dropped_s,
        cutoff_curve=[
            CutoffPart(cutoff_hz=point.cutoff_hz, filtered=point.filtered, raw=point.raw) for point in curve
        ],
        cutoff_hz=problem.log.cutoff_hz,
        kept_hz=problem.log.rate_hz,
        samples=len(problem.log.tau_nm),
        noise=problem.log.noise,
        mask_rad_s=[float(v) for v in problem.choice.mask_part * problem.log.top_rad_s],
    )


def _fit_part(problem: Problem, fit: WeightedFit, bodies: ConsistentBodies | None, note: str) -> FitPart:
    base = named(problem, fit)
    names = problem.robot.chain.serials
    return FitPart(
        parameters=len(problem.columns.names),
        rank=fit.rank,
        condition=fit.condition,
        robust=problem.choice.robust,
        instruments=problem.instruments is not None,
        terms=list(dict.fromkeys(drive.term for drive in problem.drives)),
        coupled=[[names[i], names[j]] for i, j in problem.choice.coupled or ()],
        independent_samples=fit.independent_samples,
        base_parameters=_base_parts(problem, base),
        bodies=_bodies(problem, base, bodies),
        bodies_note=note,
        not_in_urdf=list(lacking(problem)),
        drives=[_term_part(problem, fit, base, k, bodies) for k in range(len(problem.drives))],
        residuals=[
            JointNoisePart(
                joint=name,
                sigma_nm=float(fit.sigma_nm[i]),
                correlation=float(fit.correlation[i]),
                samples=int(fit.samples[i]),
                downweighted=float(fit.downweighted[i]),
            )
            for i, name in enumerate(names)
        ],
    )


def _bodies(problem: Problem, base: BaseParameters, bodies: ConsistentBodies | None) -> list[LinkBodyPart]:
    robot = problem.robot
    units = (*inertial_units(len(robot.bodies)), *(drive.unit for drive in problem.drives))
    results = identifiabilities(base, units)
    return [
        LinkBodyPart(
            link=link,
            joint=joint,
            summary=body_summary(results[PER_BODY * i : PER_BODY * (i + 1)]),
            rigid_body=None if bodies is None else body_part(bodies.bodies[i]),
            urdf_mass_kg=None if robot.phi is None else float(robot.phi[PER_BODY * i]),
        )
        for i, (link, joint) in enumerate(zip(robot.bodies, robot.chain.serials, strict=True))
    ]


def _base_parts(problem: Problem, base: BaseParameters) -> list[ArmParameterPart]:
    claims = _claims(problem, base)

    def of_drives_alone(i: int) -> bool:
        return min(base.lumped(i)) >= problem.inertial

    return [
        ArmParameterPart(
            **dict(part),
            urdf=None if claims is None or of_drives_alone(i) else float(claims[i]),
            identifiability=precision(float(base.relative_sigma[i])),
        )
        for i, part in enumerate(base_parameter_parts(base))
    ]


def _claims(problem: Problem, base: BaseParameters) -> Array | None:
    """Return the base parameters by the URDF (r,), None if it has no inertias."""
    if problem.robot.phi is None:
        return None
    bodies = slice(0, problem.inertial)
    in_root = into_frames(base.grouping[:, bodies], np.linalg.inv(problem.robot.homes))
    claims: Array = in_root @ problem.robot.phi
    # Groupings have rounding where they are zero.
    size = np.abs(base.grouping[:, bodies]) @ np.abs(problem.columns.scale[bodies])
    return np.where(np.abs(claims) > _ROUNDING * size, claims, 0.0)


def _term_part(
    problem: Problem, fit: WeightedFit, base: BaseParameters, k: int, bodies: ConsistentBodies | None
) -> TermPart:
    """Test a parameter of a drive: the F of the model without it is (value / sigma)^2 for a single one."""
    drive, column = problem.drives[k], problem.inertial + k
    # A drive's columns are tried first, so in most cases one begins its own group; else it is within others.
    groups = [i for i in range(base.rank) if column in base.lumped(i)]
    own = min(groups, key=lambda i: base.independent[i] != column)
    others = [base.columns.names[j] for j in base.lumped(own) if j != column]
    value, sigma = float(base.value[own]), float(base.sigma[own])
    f = float(f_statistic(value, sigma))
    chance = chance_of(f, fit.independent_samples - fit.rank)
    return TermPart(
        name=drive.name,
        term=drive.term,
        joints=[problem.robot.chain.serials[j] for j in drive.joints],
        unit=drive.unit,
        value=value,
        sigma=sigma,
        with_bodies=None if bodies is None else float(bodies.drives[k]),
        f=f,
        chance=chance,
        significant=chance < SIGNIFICANT_CHANCE and not others,
        lumped_with=", ".join(others),
    )
