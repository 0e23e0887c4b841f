"""Cross-validation: fit one half of a recording, predict the torques of the other.

Both ways, so that every sample is predicted once. Between the halves is a gap, over which the low-pass mixes
them. Errors are given with and without mask, raw and filtered, because masking hides friction at reversals
and filtering hides noise.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.arm_fit.consistent_bodies import URDF_TERMS, consistent_bodies, urdf_drives
from coordinator.arm_fit.problem import Problem
from coordinator.dynamics.torque_prediction import TorqueError, torque_error
from coordinator.parameter_fit.robust_least_squares import WeightedFit, fit_weighted
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.torque_terms import Term

Index = NDArray[np.int64]
Tried = Literal["second half", "first half", "both", "other recording"]
# From the samples to fit and those to test, the predicted torques of the latter.
Predictor = Callable[[slice, slice], Array]

# Parts of a half of which the data-length curve is made.
CURVE_PARTS = (0.25, 0.5, 0.75, 1.0)
# Gauss-Newton steps for friction that grows with the load, until it changes by less.
_MAX_STEPS, _SETTLED = 10, 1e-4


class HeldOutError(NamedTuple):
    """The relative torque error |e| / |tau| of one model on held-out samples."""

    tried_on: Tried
    masked: bool
    raw: bool
    error: TorqueError


class CurvePoint(NamedTuple):
    """The error of a fit to `seconds` of a half on the other half, both ways together."""

    seconds: float
    all_samples: float
    masked: float


class TermGain(NamedTuple):
    """The held-out error, both ways together, of the model without a kind of term."""

    without: str
    all_samples: float
    masked: float


def halves(samples: int, settling: int) -> tuple[slice, slice]:
    """Return both halves of `samples`, with a gap of `settling` between them, over which the low-pass mixes.

    Raises:
        DataError: too few samples to divide.
    """
    middle, gap = samples // 2, -(-settling // 2)
    if middle - gap < 2:
        raise DataError(f"{samples} samples cannot be halved: {2 * gap} between the halves are mixed")
    return slice(0, middle - gap), slice(middle + gap, samples)


def fit_part(problem: Problem, some: slice) -> WeightedFit:
    """Fit to the moving samples of a part of the recording.

    Friction that grows with the load makes the model bilinear; Gauss-Newton steps from no such friction.

    Raises:
        DataError: a joint with too few samples.
    """
    other = None if problem.instruments is None else problem.instruments[some]
    x, loads = np.zeros(len(problem.columns.names)), [column for column, _ in problem.loads]
    for _ in range(_MAX_STEPS):
        slope, shift = problem.linearised(x, problem.regressor[some])
        fit = fit_weighted(
            regressor=slope,
            tau_nm=problem.log.tau_nm[some] + shift,
            scale=problem.columns.scale,
            used=problem.moving[some],
            robust=problem.choice.robust,
            min_correlation=problem.log.rate_hz / (2.0 * problem.log.cutoff_hz),
            instruments=None if other is None else problem.linearised(x, other)[0],
        )
        # The first step only finds the load.
        settled = x.any() and np.abs(fit.parameters[loads] - x[loads]).max(initial=0.0) < _SETTLED
        if settled or not loads:
            break
        x = fit.parameters
    return fit


def fitted(problem: Problem) -> Predictor:
    """Return the predictor that fits all of the problem's columns."""
    return lambda seen, tried: problem.predicted(fit_part(problem, seen).parameters, tried)


def by_consistent_bodies(problem: Problem, prior: Array, trust: float) -> Predictor:
    """Return the predictor that fits physically consistent bodies and drives (`consistent_bodies`)."""

    def predict(seen: slice, tried: slice) -> Array:
        fit = consistent_bodies(problem, fit_part(problem, seen), prior, trust)
        return problem.predicted(np.concatenate([fit.phi, fit.drives]), tried)

    return predict


def by_urdf(problem: Problem, prior: Array, trust: float) -> Predictor:
    """Return the predictor of the URDF that is written of consistent bodies: `urdf_drives` and no more."""

    def predict(seen: slice, tried: slice) -> Array:
        fit = consistent_bodies(problem, fit_part(problem, seen), prior, trust)
        drives = urdf_drives(problem, np.concatenate([fit.phi, fit.drives]), seen)
        return by_given_bodies(problem, fit.phi, drives)(seen, tried)

    return predict


def by_given_bodies(problem: Problem, phi: Array, drives: Array) -> Predictor:
    """Return the predictor of given bodies (10 n,) and drives (n, 3) of a URDF."""
    x = np.zeros(len(problem.columns.names))
    x[: problem.inertial] = phi
    for k, drive in enumerate(problem.drives):
        if drive.term in URDF_TERMS and not drive.joints[1:]:
            x[problem.inertial + k] = drives[drive.joints[0], URDF_TERMS.index(drive.term)]
    return lambda _, tried: problem.predicted(x, tried)


def mean_torque(problem: Problem) -> Predictor:
    """Return the predictor of constant torques."""
    tau = problem.log.tau_nm
    return lambda seen, tried: np.broadcast_to(tau[seen].mean(axis=0), tau[tried].shape)


def held_out_errors(problem: Problem, predictor: Predictor) -> tuple[HeldOutError, ...]:
    """Test a predictor on either half and on both together: filtered and raw, all samples and masked.

    Raises:
        DataError: too few samples, see `halves` and `fit_part`.
    """
    parts = list(_predictions(problem, predictor))
    parts.append(
        ("both", np.concatenate([at for _, at, _ in parts]), np.concatenate([said for *_, said in parts]))
    )
    return _errors(problem, parts)


def errors_elsewhere(both: Problem, predictor: Predictor, seen: int) -> tuple[HeldOutError, ...]:
    """Test a predictor fitted to the first `seen` samples of two recordings (`joined`) on the second one.

    Raises:
        DataError: too few samples, see `fit_part`.
    """
    samples = len(both.log.tau_nm)
    predicted = predictor(slice(0, seen), slice(seen, samples))
    return _errors(both, [("other recording", np.arange(seen, samples), predicted)])


def _errors(problem: Problem, parts: Sequence[tuple[Tried, Index, Array]]) -> tuple[HeldOutError, ...]:
    return tuple(
        HeldOutError(name, masked, raw, _error(problem, at, predicted, masked, raw))
        for (name, at, predicted), masked, raw in product(parts, (False, True), (False, True))
    )


def length_curve(problem: Problem) -> Iterator[CurvePoint]:
    """Yield the held-out error by the length that was fitted, without lengths that are too short.

    The part of a half next to the gap is fitted, so that all lengths are equally near to the tested half.
    """
    for part in CURVE_PARTS:
        try:
            errors = held_out_errors(problem, _shortened(problem, part))
        except DataError:
            continue
        first = halves(len(problem.log.tau_nm), problem.log.settling)[0]
        yield CurvePoint(part * (first.stop - first.start) / problem.log.rate_hz, *overall(errors))


def gain_of_terms(problem: Problem) -> Iterator[TermGain]:
    """Yield the held-out error of the model without each kind of term.

    Raises:
        DataError: too few samples.
    """
    for term in dict.fromkeys(drive.term for drive in problem.drives):
        lacking = _without(problem, term)
        yield TermGain(term, *overall(held_out_errors(lacking, fitted(lacking))))
    if problem.choice.coupled:
        lacking = problem.with_drives(lambda drive: len(drive.joints) == 1)
        yield TermGain("coupling", *overall(held_out_errors(lacking, fitted(lacking))))


def _without(problem: Problem, term: Term) -> Problem:
    return problem.with_drives(lambda drive: drive.term != term)


def overall(errors: tuple[HeldOutError, ...]) -> tuple[float, float]:
    """Return the errors of both halves and all joints together, filtered: of all samples, and masked."""
    by_mask = {e.masked: e.error.overall for e in errors if e.tried_on == "both" and not e.raw}
    return by_mask[False], by_mask[True]


def _predictions(problem: Problem, predictor: Predictor) -> Iterator[tuple[Tried, Index, Array]]:
    samples = len(problem.log.tau_nm)
    first, second = halves(samples, problem.log.settling)
    yield "second half", np.arange(samples)[second], predictor(first, second)
    yield "first half", np.arange(samples)[first], predictor(second, first)


def _shortened(problem: Problem, part: float) -> Predictor:
    def predict(seen: slice, tried: slice) -> Array:
        count = max(1, round(part * (seen.stop - seen.start)))
        near = (
            slice(seen.stop - count, seen.stop)
            if seen.stop <= tried.start
            else slice(seen.start, seen.start + count)
        )
        return fitted(problem)(near, tried)

    return predict


def _error(problem: Problem, at: Index, predicted: Array, masked: bool, raw: bool) -> TorqueError:
    tau = (problem.log.tau_raw_nm if raw else problem.log.tau_nm)[at]
    # The constant mean is a predictor of its own here.
    return torque_error(tau, predicted, np.zeros(tau.shape[1]), problem.moving[at] if masked else None)
