"""One batch refinement of a chain over all motions at once, from all IMUs and all encoders.

The circle point analysis assumes that only one joint moves, but held joints give on their springs: distal
IMUs turn by up to 50 % more near a resonance, which biases the circles. Here every IMU sample is predicted
from the measured motion of all joints (docs/theory.md, "The chain").
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coordinator.batch_estimation.imu_calibration import (
    CalibrationInformation,
    ImuCalibration,
    catalogued,
    information_between,
)
from coordinator.batch_estimation.imu_intrinsics import ImuIntrinsics, read
from coordinator.batch_estimation.imu_jacobian import displaced_readings, kernel_displacements, kernel_motion
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.link_compliance import ComplianceJacobian, rigid
from coordinator.batch_estimation.normal_equations import (
    Expected,
    NormalEquations,
    Problem,
    State,
    normal_equations,
)
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.kinematics.chain_estimate import ChainEstimate
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import BIASES_ONLY, ImuPrior
from module_agent.model.perturbation import apply_perturbation
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import samples_per_independent

ITERATIONS = 20
# The last step in standard deviations: smaller ones cost time and tell nothing.
CONVERGED_SIGMAS = 0.03
# Fits from which others start lack what those add, links that give or hinges in their places: how often they
# step at most, and their last step.
COARSE_ITERATIONS, COARSE_SIGMAS = 8, 0.1
# How much larger the last step may be along what only the base's motion tells: nothing is claimed of that.
UNCLAIMED = 3.0
# Directions with a larger sigma (rad or m) count as unresolved: a turn of 6 deg, a tenth of a metre.
UNKNOWN_ABOVE = 0.1
# Largest step (rad, m) along directions that only the motion of the base resolves.
MAX_STEP = 0.3
# Finer than any sensor resolves (rad/s, m/s^2). Smaller weights would drown the biases' prior in rounding.
MIN_RMS = 1e-6
# Samples, 50 a second.
MAX_LAG = 100
# Residuals that are larger than this many standard deviations of the noise are the model's errors: they
# follow the motion, so that all samples of a motion count as one. As of 2026-11-22 those of healthy arms, the
# tubes of which ring, are below 7; links of 2000 Nm/rad leave 17, of 1000 Nm/rad 60.
SYSTEMATIC = 10.0

Mask = NDArray[np.bool_]


class Refinement(NamedTuple):
    """A refined chain of n modules and what was estimated along with it; arrays read-only.

    noise_covariance: (6 n, 6 n) as `estimate.covariance`, by the sensors' noise alone: without the model's
        systematic errors, which two sessions with the same motions share.
    residual_gyro_rad_s, residual_accel_m_s2: (n,) rms per axis.
    residuals: (2, k, n) the same of gyro [rad/s] and accelerometer [m/s^2] in each of k motions.
    intrinsics: the IMUs' own errors; the prior's mean where no observation resolves them.
    calibration_prior, calibration: of the IMUs, before and by the samples; their errors are `intrinsics`.
    compliance, compliance_sigma: of the links, in the order and units of `ComplianceJacobian`.
    encoder_scale, encoder_scale_sigma: (n,) true motion over measured, less 1, as far as estimated; the
        chain takes the encoders as they are unless their scales were free.
    late_s: delay common to all IMUs, in addition to their own delays in `intrinsics`.
    columns: (2, 2, k, n, 3) of gyro and accelerometer in each of k motions the rms of the residuals of every
        axis, and the standard deviation of its readings.
    """

    estimate: ChainEstimate
    noise_covariance: Array
    residual_gyro_rad_s: Array
    residual_accel_m_s2: Array
    residuals: Array
    intrinsics: ImuIntrinsics
    calibration_prior: ImuCalibration
    calibration: ImuCalibration
    compliance: Array
    compliance_sigma: Array
    encoder_scale: Array
    encoder_scale_sigma: Array
    late_s: float = 0.0
    columns: Array = frozen(np.zeros((2, 2, 0, 0, 3)))

    @property
    def chain(self) -> Chain:
        """The refined chain, with the IMUs where the catalogue has them in their housings."""
        return self.estimate.chain

    @property
    def placement(self) -> Array:
        """Every IMU's turn [rad] and displacement [m], (n, 6), against its place by the catalogue."""
        return self.calibration.placement

    @property
    def placement_sigma(self) -> Array:
        """The standard deviations of `placement`, (n, 6)."""
        return self.calibration.placement_sigma

    @property
    def calibration_information(self) -> CalibrationInformation:
        """What the samples alone tell of the IMUs."""
        return information_between(self.calibration_prior, self.calibration)


def refine_chain(
    chain: Chain,
    data: SensorData,
    prior: ImuPrior = BIASES_ONLY,
    flex: ComplianceJacobian | None = None,
    calibration: ImuCalibration | None = None,
    noise: Array | None = None,
    begin: Refinement | None = None,
    coarse: bool = False,
) -> Refinement:
    """Refine a chain that is roughly right (within about 0.2 rad and 0.1 m).

    Args:
        chain: where to start.
        data: m samples of all sensors.
        prior: of the IMUs.
        flex: how the readings change with the links' compliances; None for rigid links.
        calibration: prior of the IMUs where some were measured before, in the order of the chain.
        noise: (2, k, n) noise of gyro and accelerometer in each of k motions, rms per axis, where it is
            known: residuals far beyond it are systematic.
        begin: a former fit, from whose IMUs and compliances, the first of `flex`, this one starts; None for
            the prior's.
        coarse: whether another fit starts from this one, which need not be as accurate then.

    Raises:
        DataError: fewer samples than parameters.
        ValueError: the prior leaves delays free, but `data` has no rates of the readings.
    """
    if prior.delay_s > 0.0 and data.imu_rates is None:
        raise ValueError("the IMUs' delays cannot be refined without the rates of their readings (imu_rates)")
    count = len(chain.serials)
    if 6 * data.q_rad.shape[0] < 12 * count:
        raise DataError(f"{data.q_rad.shape[0]} samples are too few to refine a chain of {count} modules")
    before = calibration if calibration is not None else catalogued(chain.serials, prior)
    flex = flex if flex is not None else rigid(len(data.q_rad))
    problem = Problem(data, flex, kernel_displacements(flex.carried), before, before.information()[0])
    state = _start(problem, chain, begin)
    shape = (len(data.motions), count)
    sigmas = [np.full(shape, 0.01), np.full(shape, 0.1)]
    iterations, converged = (COARSE_ITERATIONS, COARSE_SIGMAS) if coarse else (ITERATIONS, CONVERGED_SIGMAS)
    settled = False
    for used in range(1, iterations + 1):
        expected = _expected(problem, state)
        if used > 1 or begin is not None:
            sigmas = [_spread(data, residual) for residual in expected.residuals]
        state, last, by_shaking = _stepped(problem, state, expected, sigmas, settled)
        # The first two steps are by weights that are guessed, or of a state that is far off.
        settled = used > 2 and by_shaking < UNCLAIMED * converged
        if settled and last < converged:
            break
    return _concluded(problem, state, noise, coarse)


def _start(problem: Problem, chain: Chain, begin: Refinement | None) -> State:
    """Return the state that the iteration starts from."""
    compliance = np.zeros(len(problem.flex.links))
    if begin is None:
        return State(chain, problem.calibration.mean, compliance)
    compliance[: len(begin.compliance)] = begin.compliance
    return State(chain, begin.calibration.mean, compliance)


def _stepped(
    problem: Problem, state: State, expected: Expected, sigmas: Sequence[Array], settled: bool
) -> tuple[State, float, float]:
    """Return the state after one step, and the sizes of that step in standard deviations: along what the
    motions of joints resolve, and along what the base's motion does, zero if that is `settled`.
    """
    normal = normal_equations(problem, state, expected, expected.still, sigmas)
    poses, spectrum, through = _solve(normal)
    size, by_shaking = float(np.abs(spectrum.in_sigmas(poses)).max(initial=0.0)), 0.0
    if expected.shaken is not None and not spectrum.known.all() and not settled:
        shaken = normal_equations(problem, state, expected, expected.shaken, sigmas)
        unknown, by_shaking = _along_unknown(shaken, spectrum)
        poses = poses + unknown
    nuisance = through[:, -1] - through[:, :-1] @ poses
    step = np.concatenate([np.zeros(6), poses, nuisance])
    return _moved(problem, state, step, normal.own_step(step)), size, by_shaking


def _concluded(problem: Problem, state: State, noise: Array | None, coarse: bool) -> Refinement:
    """Return the estimate and what the residuals tell of it; if `coarse`, noise is not told apart."""
    data, expected = problem.data, _expected(problem, state)
    white = [_spread(data, residual) for residual in expected.residuals]
    # Systematic errors repeat with the motion: their samples are not independent.
    believed = [
        spread * _repeats(data, residual) for spread, residual in zip(white, expected.residuals, strict=True)
    ]
    scale = 1.0
    if noise is not None:
        if any((spread > SYSTEMATIC * size).any() for spread, size in zip(white, noise, strict=True)):
            scale = max(_pull(problem, state), 1.0)
        whole = np.sqrt([samples.stop - samples.start for samples in data.motions])[:, None]
        believed = [
            np.where(spread > SYSTEMATIC * size, spread * whole, wide)
            for spread, size, wide in zip(white, noise, believed, strict=True)
        ]
    normal = normal_equations(problem, state, expected, expected.still, believed)
    told = normal if coarse else normal_equations(problem, state, expected, expected.still, white)
    by_noise = _reduced(told)[0]
    rms = [_rms(residual) for residual in expected.residuals]
    refined = _report(problem, state, normal, by_noise, rms, white, scale)
    return refined._replace(columns=_columns(data, expected.residuals))


def with_placement(chain: Chain, placement: Array) -> Chain:
    """Return the chain with every IMU turned about itself and displaced, (n, 6) in its own axes.

    Of `Refinement.placement` this is the chain that predicts the IMUs' readings.
    """
    if not placement.any():
        return chain
    moved = np.tile(np.eye(4), (len(placement), 1, 1))
    # A copy: scipy takes no read-only arrays.
    moved[:, :3, :3] = Rotation.from_rotvec(np.array(placement[:, :3])).as_matrix()
    moved[:, :3, 3] = placement[:, 3:]
    return chain._replace(imu_home=frozen(chain.imu_home @ moved))


def _pull(problem: Problem, state: State) -> float:
    """Return the rms of the links' estimates, in standard deviations of their priors.

    Where residuals are systematic, what the model lacks goes also into lengths and compliances, and the
    residuals do not show that part. Estimates that contradict their priors do: this is the Birge ratio
    (Birge 1932, Physical Review 40, 207) of the priors, by which the standard deviations are scaled.
    """
    flex = problem.flex
    pulls = (state.compliance + flex.taken) / flex.sigmas
    return float(np.sqrt(np.mean(pulls**2))) if pulls.size else 0.0


def _shared_covariance(normal: NormalEquations, spectrum: "_Spectrum") -> Array:
    """Return the covariance of all poses (6 n), gravity and links; zero along what is unknown."""
    inverse = np.linalg.inv(normal.nuisance)
    kept = spectrum.vectors[:, spectrum.known] * spectrum.sigmas[spectrum.known]
    by_poses = -inverse @ (normal.cross.T @ kept)
    half = np.concatenate([np.zeros((6, kept.shape[1])), kept, by_poses])
    covariance = half @ half.T
    rest = slice(6 + len(kept), None)
    covariance[rest, rest] += inverse
    return np.asarray(covariance)


def _posterior(problem: Problem, state: State, own: Array) -> ImuCalibration:
    """Return the IMUs as estimated; the prior's covariance, which is zero, where they are not free."""
    before = problem.calibration
    rows = np.flatnonzero(np.tile(problem.free, len(before.serials)))
    covariance = np.zeros(before.covariance.shape)
    covariance[np.ix_(rows, rows)] = own
    return ImuCalibration(before.serials, frozen(state.own), frozen(covariance))


def _expected(problem: Problem, state: State) -> Expected:
    data, base = problem.data, problem.data.base
    chain = with_placement(state.chain, state.placement)
    bodies = body_motions(chain, *data.smooth)
    still = kernel_motion(bodies, *data.smooth[:2])
    shaken = (
        None if base is None else kernel_motion(body_motions(chain, *data.smooth, base), *data.smooth[:2])
    )
    carried = readings_on(chain, body_motions(chain, *data.joints, base))
    flex = problem.flex.carried
    change = displaced_readings(chain, still, flex, problem.displaced, state.compliance)
    change = change[..., : len(data.q_rad)].transpose(2, 0, 1)
    true = carried.gyro_rad_s + change[..., :3], carried.accel_m_s2 + change[..., 3:]
    gyro, accel = read(state.imus, *true, data.imu_rates)
    residuals = data.gyro_rad_s - gyro, data.accel_m_s2 - accel
    return Expected(chain, still, shaken, readings_on(chain, bodies), residuals)


def _rms(residual: Array) -> Array:
    """Return the rms (n,) per axis of residuals (m, n, 3), no smaller than any sensor's resolution."""
    return np.asarray(np.maximum(np.sqrt(np.mean(residual**2, axis=(0, 2))), MIN_RMS))


def _spread(data: SensorData, residual: Array) -> Array:
    """Return the rms of every motion, (motions, n): turning gears shake an IMU more than gears at rest."""
    return np.stack([_rms(residual[samples]) for samples in data.motions])


def _columns(data: SensorData, residuals: Sequence[Array]) -> Array:
    """Return the rms of residuals and the deviation of readings by axis, see `Refinement.columns`."""
    readings = data.gyro_rad_s, data.accel_m_s2
    size = [[np.sqrt(np.mean(one[part] ** 2, axis=0)) for part in data.motions] for one in residuals]
    spread = [[one[part].std(axis=0) for part in data.motions] for one in readings]
    return frozen(np.array([[size[k], spread[k]] for k in range(2)]))


def _repeats(data: SensorData, residual: Array) -> Array:
    """Return the factor (motions, n) by which the correlation of a motion's samples widens their spread."""
    parts = [residual[samples] for samples in data.motions]
    return np.stack([np.sqrt(samples_per_independent(part, MAX_LAG, MIN_RMS)) for part in parts])


class _Spectrum(NamedTuple):
    """Eigenvectors (columns) of the pose information with the nuisance taken out; the sigmas along them."""

    vectors: Array
    sigmas: Array

    @property
    def known(self) -> Mask:
        return self.sigmas <= UNKNOWN_ABOVE

    def in_sigmas(self, poses: Array) -> Array:
        """Return a step of poses (6 n - 6) along what is known, in standard deviations."""
        return np.asarray(self.vectors[:, self.known].T @ poses / self.sigmas[self.known])


def _reduced(normal: NormalEquations) -> tuple[Array, Array, Array]:
    """Eliminate the nuisance: return information and right-hand side of the poses, and the elimination."""
    sides = np.column_stack([normal.cross.T, normal.nuisance_rhs])
    through: Array = np.linalg.solve(normal.nuisance, sides).astype(np.float64)
    information = normal.pose - normal.cross @ through[:, :-1]
    return information, normal.pose_rhs - normal.cross @ through[:, -1], through


def _solve(normal: NormalEquations) -> tuple[Array, _Spectrum, Array]:
    """Return the step of the poses (6 n - 6), zero where unresolved; the spectrum; the elimination."""
    information, rhs, through = _reduced(normal)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    with np.errstate(divide="ignore"):
        sigmas = 1.0 / np.sqrt(np.maximum(values, 0.0))
    spectrum = _Spectrum(vectors[:, ::-1], sigmas[::-1])
    kept = spectrum.vectors[:, spectrum.known]
    return kept @ (spectrum.sigmas[spectrum.known] ** 2 * (kept.T @ rhs)), spectrum, through


def _along_unknown(shaken: NormalEquations, spectrum: "_Spectrum") -> tuple[Array, float]:
    """Return the step (6 n - 6,) by the base's motion, along what the joints' motions do not resolve.

    With it comes its size in standard deviations. What the joints' motions resolve is eliminated from these
    equations, whose derivatives are those on the moving base: the base's motion tells of it, too, but in
    terms that hold the noise of the IMU on the base.
    """
    information, rhs, _ = _reduced(shaken)
    hidden = spectrum.vectors[:, ~spectrum.known]
    seen = spectrum.vectors[:, spectrum.known] * spectrum.sigmas[spectrum.known]
    follows = np.linalg.solve(seen.T @ information @ seen, seen.T @ information @ hidden)
    alone = hidden - seen @ follows
    limited = alone.T @ information @ hidden + np.eye(hidden.shape[1]) * MAX_STEP**-2.0
    amounts = np.clip(np.linalg.solve(limited, alone.T @ rhs), -MAX_STEP, MAX_STEP)
    return hidden @ amounts, float(np.sqrt(amounts @ limited @ amounts))


def _moved(problem: Problem, state: State, step: Array, own: Array) -> State:
    """Return the state after a step of poses (6 n), gravity and links, and of the IMUs' own."""
    change = np.zeros_like(state.own)
    change[:, problem.free] = own.reshape(len(change), -1)
    poses, gravity, links = np.split(step, 6 * len(change) + np.array([0, 3]))
    chain = apply_perturbation(state.chain, poses)
    return State(
        chain._replace(gravity=frozen(chain.gravity + gravity)), state.own + change, state.compliance + links
    )


def _report(
    problem: Problem,
    state: State,
    normal: NormalEquations,
    by_noise: Array,
    rms: Sequence[Array],
    by_motion: Sequence[Array],
    scale: float,
) -> Refinement:
    """Return the estimate.

    by_noise: information (6 n - 6,) squared on the poses by the sensors' noise alone. rms, by_motion: of the
    residuals, altogether (n,) and in every motion (k, n), of gyro and accelerometer. scale: of the standard
    deviations of poses and links.
    """
    spectrum = _solve(normal)[1]
    shared = _shared_covariance(normal, spectrum)
    known = spectrum.known
    kept = spectrum.vectors[:, known]
    size = 6 * len(state.chain.serials)
    covariance, noise = np.zeros((size, size)), np.zeros((size, size))
    covariance[6:, 6:] = (kept * (scale * spectrum.sigmas[known]) ** 2) @ kept.T
    noise[6:, 6:] = kept @ np.linalg.solve(kept.T @ by_noise @ kept, kept.T)
    unknown = np.zeros((size, int(np.count_nonzero(~known))))
    unknown[6:] = spectrum.vectors[:, ~known]
    sigmas = spectrum.sigmas[known]
    links = np.diag(shared)[size + 3 :]
    return Refinement(
        estimate=ChainEstimate(
            chain=state.chain,
            covariance=frozen(covariance),
            null_basis=frozen(unknown),
            rank=int(np.count_nonzero(known)),
            condition=float(sigmas.max() / sigmas.min()) if sigmas.size else float("inf"),
        ),
        noise_covariance=frozen(noise),
        residual_gyro_rad_s=frozen(rms[0]),
        residual_accel_m_s2=frozen(rms[1]),
        residuals=frozen(np.stack(by_motion)),
        intrinsics=ImuIntrinsics(frozen(state.imus.errors)),
        calibration_prior=problem.calibration,
        calibration=_posterior(problem, state, normal.own_covariance(shared)),
        compliance=frozen(state.compliance),
        compliance_sigma=frozen(scale * np.sqrt(links)),
        encoder_scale=frozen(np.zeros(len(state.own))),
        encoder_scale_sigma=frozen(np.zeros(len(state.own))),
    )
