"""Batch refinement of a robot from its motion windows: rigid first, then with compliant links and base.

Base motion and link compliance are estimated in turn; each needs an approximate chain.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from coordinator.batch_estimation.encoder_scale import with_encoder_scales
from coordinator.batch_estimation.estimator import Refinement, refine_chain
from coordinator.batch_estimation.imu_calibration import ImuCalibration, catalogued
from coordinator.batch_estimation.imu_intrinsics import DELAY, GYRO_BIAS, beyond
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.link_compliance import (
    ComplianceJacobian,
    LinkLoad,
    compliance_jacobian,
    hinge_slopes,
    joined,
    loads_of,
    turns_under,
    with_hinges_moved,
)
from coordinator.batch_estimation.link_compliance import rigid as without_links
from coordinator.batch_estimation.sensor_data import NoiseFloor, SensorData
from coordinator.kinematics.null_space import name_null_space
from coordinator.synchronisation.motion_windows import RATE_HZ, Window, encoder_steps, filtered, thinned
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import ImuPrior
from module_agent.model.perturbation import apply_perturbation
from module_agent.model.read_only import frozen
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ

# Half the time constant of the low-pass: about the number of independent samples.
KEEP_EVERY = 5
# IMU samples that the refinement works on at most: its cost grows with them and with the modules squared.
MAX_IMU_SAMPLES = 40_000
# All steps but the last use a quarter of them.
COARSE = 4
# Errors in standard deviations: from the first on the catalogue is doubted, from the second on it is wrong.
# In a larger robot more healthy IMUs' errors are that large by chance: the first grows, so that at most the
# third share of healthy robots is doubted.
SUSPICIOUS, SIGNIFICANT, DOUBTED_SHARE = 3.0, 4.0, 0.2
# By how much base motion must reduce the mean log residual. On rigid bases the difference is up to 0.0015 of
# either sign, and the IMU's noise as base motion biases accelerometers by two sigma; compliant bases make 2.
MIN_SHAKING = 0.005
# Prior of the place of an IMU whose module's type may be another; smallest difference in scale that counts.
ANYWHERE_M, MIN_SCALE = 0.05, 5e-4
# Prior of scale and axes of an IMU that may be sick. As delivered, IMUs are off by 1 %. What links that bend
# are taken for is smaller, or beyond reason, or less certain than this many standard deviations.
SICK_SCALE, SICK_FROM, SICK_TO, CERTAIN = 0.05, 0.02, 0.2, 8.0


class Suspects(NamedTuple):
    """Sensors of n modules that may contradict the catalogue: what is free of them beyond the prior.

    imus: modules whose IMUs may sit anywhere in their housings. encoders: joints whose encoders may be off
    in scale. scale: (n,) by how much these are off as far as it is known, true motion over measured, less 1.
    sick: modules whose IMUs may have any scale and axes.
    """

    imus: tuple[int, ...]
    encoders: tuple[int, ...]
    scale: Array
    sick: tuple[int, ...] = ()

    def freed(self, known: ImuCalibration) -> ImuCalibration:
        """Return what is known of the IMUs if these may sit anywhere, or read anything."""
        return known.widened(self.imus, ANYWHERE_M).with_any_scale(self.sick, SICK_SCALE)


def refine_checked(
    chain: Chain,
    kinds: Sequence[ModuleType],
    windows: Sequence[Window],
    prior: ImuPrior,
    floor: NoiseFloor | None = None,
    calibration: ImuCalibration | None = None,
    noise: Array | None = None,
    doubted: Sequence[int] = (),
) -> tuple[Refinement, Suspects]:
    """Refine as `refine_robot`; what contradicts the catalogue is free, so that the claim covers it.

    The scales of `doubted` encoders are free in any case. If errors of IMUs or scales of encoders are
    outliers, the last fit is repeated with all IMUs anywhere and all scales free, and with the IMUs' own
    errors free instead. What is significant then, in the one that explains more, stays free in the fit that
    is returned.
    """
    known = calibration if calibration is not None else catalogued(chain.serials, prior)
    count = len(chain.serials)
    suspects = Suspects((), tuple(doubted), np.zeros(count))
    fitted = _fitted(chain, kinds, windows, prior, floor, known, suspects, noise)
    refined = fitted.refined
    if count == 1 or _outlier(refined, prior, known) < suspicious_beyond(count, prior):
        return refined, suspects
    everyone = tuple(range(count))
    freed = Suspects(everyone, everyone, suspects.scale)
    anywhere = known.widened(everyone, ANYWHERE_M)
    free = _with_encoders(fitted.last, fitted.data, prior, fitted.flex, anywhere, freed, noise, coarse=True)
    any_errors = known.with_any_scale(everyone, SICK_SCALE)
    own = _with_encoders(
        fitted.last, fitted.data, prior, fitted.flex, any_errors, suspects, noise, coarse=True
    )
    sick = sick_imus(own, known)
    if sick and _misfit(own) < _misfit(free):
        suspects = suspects._replace(sick=sick)
        return _repeated(fitted, own, prior, known, suspects, noise), suspects
    moved = free.placement - known.placement
    away = np.abs(moved / np.hypot(free.placement_sigma, known.placement_sigma))[:, 3:].max(axis=1)
    off = _scale_sigmas(free) > SIGNIFICANT
    off[list(doubted)] = True
    imus, encoders = (tuple(np.flatnonzero(some).tolist()) for some in (away > SIGNIFICANT, off))
    if not imus and not encoders:
        return refined, suspects
    suspects = Suspects(imus, encoders, np.where(off, free.encoder_scale, 0.0))
    # Housings that are elsewhere, or other motions of joints: loads and deflections change with them.
    return refine_robot(free.chain, kinds, windows, prior, floor, known, suspects, noise), suspects


def suspicious_beyond(count: int, prior: ImuPrior) -> float:
    """Return how large the largest error of `count` modules' sensors must be to doubt the catalogue [sigma].

    Sidak's correction for as many normal deviates as are estimated of the IMUs (Sidak 1967, J. Am. Stat.
    Assoc. 62, 626).
    """
    errors = count * int(np.count_nonzero(prior.sigmas))
    alone = -math.expm1(math.log1p(-DOUBTED_SHARE) / errors) if errors else 1.0
    return max(SUSPICIOUS, float(-ndtri(0.5 * alone)))


def _outlier(refined: Refinement, prior: ImuPrior, known: ImuCalibration) -> float:
    """Return the largest error of an IMU, its place included, or of an encoder, in standard deviations."""
    moved = np.abs((refined.placement - known.placement)[:, 3:])
    placed = (moved / known.placement_sigma[:, 3:]).max() if prior.place_m else 0.0
    return float(max(placed, beyond(refined.intrinsics, prior).max(), _scale_sigmas(refined).max()))


def sick_imus(own: Refinement, known: ImuCalibration) -> tuple[int, ...]:
    """Return the IMUs whose scale or axes are surely not what is known of them."""
    matrices = slice(0, GYRO_BIAS.start)
    off = np.abs(own.calibration.mean - known.mean)[:, matrices]
    measured, before = own.calibration.sigma[:, matrices], known.sigma[:, matrices]
    certain = (off > CERTAIN * measured) & (off > SIGNIFICANT * np.hypot(measured, before))
    sick = (certain & (off > SICK_FROM)).any(axis=1) & (off < SICK_TO).all(axis=1)
    return tuple(np.flatnonzero(sick).tolist())


def _scale_sigmas(refined: Refinement) -> Array:
    """Return how far the encoders' scales (n,) are from 1, in standard deviations."""
    return np.asarray(np.abs(refined.encoder_scale / np.maximum(refined.encoder_scale_sigma, MIN_SCALE)))


def _rescaled(one: Window, scale: Array) -> Window:
    """Return a window whose joints moved by 1 + scale (n,) times as much."""
    return one._replace(q_rad=one.q_rad * (1.0 + scale)) if scale.any() else one


def refine_robot(
    chain: Chain,
    kinds: Sequence[ModuleType],
    windows: Sequence[Window],
    prior: ImuPrior,
    floor: NoiseFloor | None = None,
    calibration: ImuCalibration | None = None,
    suspects: Suspects | None = None,
    noise: Array | None = None,
) -> Refinement:
    """Refine an approximate chain with all motions of its joints.

    Args:
        chain: n joints.
        kinds: (n,) types of the modules.
        windows: the motions, columns in the order of the chain.
        prior: how well the IMUs are known.
        floor: the noise of the first module's IMU at rest, if that module is bolted to the base by its
            housing: its readings beyond this noise are the base's motion. None: the base rests.
        calibration: prior of the IMUs where some were measured before; None for `prior`.
        suspects: what is free beyond the prior; None for nothing.
        noise: of the IMUs in every motion, as for `refine_chain`.

    Raises:
        DataError: as `refine_chain`.
    """
    return _fitted(chain, kinds, windows, prior, floor, calibration, suspects, noise).refined


class _Fitted(NamedTuple):
    """A refined robot, and the last of its fits: estimate, samples, how readings change with the links."""

    refined: Refinement
    last: Refinement
    data: SensorData
    flex: ComplianceJacobian


def _fitted(
    chain: Chain,
    kinds: Sequence[ModuleType],
    windows: Sequence[Window],
    prior: ImuPrior,
    floor: NoiseFloor | None,
    calibration: ImuCalibration | None,
    suspects: Suspects | None,
    noise: Array | None,
) -> _Fitted:
    """Refine as `refine_robot`."""
    count = len(chain.serials)
    suspects = suspects or Suspects((), (), np.zeros(count))
    windows = [_rescaled(one, suspects.scale) for one in windows]
    known = calibration if calibration is not None else catalogued(chain.serials, prior)
    known = suspects.freed(known)
    keep = max(KEEP_EVERY, -(-sum(w.q_rad.size for w in windows) // MAX_IMU_SAMPLES))
    parts = [filtered(one, REFINEMENT_CUTOFF_HZ, floor) for one in windows]
    rigid = refine_chain(chain, thinned(parts, COARSE * keep), prior, None, known, coarse=True)
    # The first IMU may have no motion to determine its delay; all IMUs are of one type.
    late_s = float(np.median(rigid.intrinsics.errors[1:, DELAY])) if len(chain.serials) > 1 else 0.0
    steps = encoder_steps(windows)
    parts = [filtered(one, REFINEMENT_CUTOFF_HZ, floor, late_s, steps) for one in windows]
    loads = loads_of(rigid.chain, kinds, parts, RATE_HZ)
    giving, parts = _giving(rigid, parts, joined(loads, COARSE * keep), prior, COARSE * keep, known)
    if not giving.compliance.size:
        fine = thinned(parts, keep)
        flex = without_links(len(fine.q_rad))
        last = _with_encoders(giving, fine, prior, flex, known, suspects, noise)
        return _Fitted(last._replace(late_s=late_s), last, fine, flex)
    # The hinges' positions change the torques that turn them: first a coarse estimate, then the final one.
    coarse = thinned(parts, COARSE * keep)
    flex = hinge_slopes(joined(loads, COARSE * keep), len(coarse.q_rad), giving.compliance)
    tested = Suspects((), tuple(range(count)), suspects.scale)
    hinged = _with_encoders(giving, coarse, prior, flex, known, tested, coarse=True)
    links = len(giving.compliance)
    moved, joints = hinged.compliance[links:], flex.links[:links:2]
    loads = with_hinges_moved(loads, joints, moved)
    turns = [turns_under(part, joints, hinged.compliance[:links]) for part in loads]
    loads = loads_of(hinged.chain, kinds, parts, RATE_HZ, turns)
    loads = with_hinges_moved(loads, joints, moved)
    fine = thinned(parts, keep)
    compliance = hinged.compliance[:links]
    flex = hinge_slopes(joined(loads, keep), len(fine.q_rad), compliance, moved)
    # The hinges' places are in the loads already.
    begin = hinged._replace(compliance=compliance)
    last = _with_encoders(begin, fine, prior, flex, known, suspects, noise)
    refined = _complete(last, flex, suspects, hinged._replace(late_s=late_s))
    return _Fitted(refined, last, fine, flex)


def _complete(
    last: Refinement, flex: ComplianceJacobian, suspects: Suspects, before: Refinement
) -> Refinement:
    """Return the last fit with what it has not estimated itself: the delay, and scales that were not free.

    What it estimates of the hinges is a change of their places.
    """
    refined = last._replace(compliance=frozen(last.compliance + flex.taken), late_s=before.late_s)
    if suspects.encoders:
        return refined
    return refined._replace(
        encoder_scale=before.encoder_scale, encoder_scale_sigma=before.encoder_scale_sigma
    )


def _repeated(
    fitted: _Fitted,
    begin: Refinement,
    prior: ImuPrior,
    known: ImuCalibration,
    suspects: Suspects,
    noise: Array | None,
) -> Refinement:
    """Repeat the last fit, from one of the same samples, with any scale and axes of IMUs that are sick.

    The loads of the links, which follow from where the modules are, stay.
    """
    last = _with_encoders(begin, fitted.data, prior, fitted.flex, suspects.freed(known), suspects, noise)
    return _complete(last, fitted.flex, suspects, fitted.refined)


def _with_encoders(
    begin: Refinement,
    data: SensorData,
    prior: ImuPrior,
    flex: ComplianceJacobian,
    calibration: ImuCalibration,
    suspects: Suspects,
    noise: Array | None = None,
    coarse: bool = False,
) -> Refinement:
    """Refine with the scales of suspected encoders free, which are taken out of the compliances."""
    links = len(flex.links)
    flex = with_encoder_scales(flex, begin.chain, data.smooth, suspects.encoders)
    refined = refine_chain(begin.chain, data, prior, flex, calibration, noise, begin, coarse)
    scale, sigma = suspects.scale.copy(), np.zeros(len(suspects.scale))
    scale[list(suspects.encoders)] += refined.compliance[links:]
    sigma[list(suspects.encoders)] = refined.compliance_sigma[links:]
    return refined._replace(
        compliance=frozen(refined.compliance[:links]),
        compliance_sigma=frozen(refined.compliance_sigma[:links]),
        encoder_scale=frozen(scale),
        encoder_scale_sigma=frozen(sigma),
    )


def _giving(
    rigid: Refinement,
    parts: list[SensorData],
    loads: Sequence[LinkLoad | None],
    prior: ImuPrior,
    keep: int,
    calibration: ImuCalibration,
) -> tuple[Refinement, list[SensorData]]:
    """Refine with compliant links, and with base motion if that reduces the other IMUs' residuals: not if the
    base is rigid, or the first module's own gears shake the IMU on it.
    """
    still = [part._replace(base_motion=None) for part in parts]
    resting = thinned(still, keep)
    flex = compliance_jacobian(loads, len(resting.q_rad))
    at_rest = refine_chain(rigid.chain, resting, prior, flex, calibration, coarse=True)
    data = thinned(parts, keep)
    single_module = len(rigid.chain.serials) == 1
    if data.base_motion is None or not data.base_motion.any() or single_module:
        return at_rest, still
    facing = faced(rigid.chain, data, rigid.estimate.null_basis)
    shaken = refine_chain(facing, data, prior, flex, calibration, begin=at_rest, coarse=True)
    return (shaken, parts) if _misfit(shaken) < _misfit(at_rest) - MIN_SHAKING else (at_rest, still)


def _misfit(fit: Refinement) -> float:
    """Return the mean log residual of the IMUs that are not fixed to the base."""
    residuals = np.concatenate([fit.residual_gyro_rad_s[1:], fit.residual_accel_m_s2[1:]])
    return float(np.log(residuals).mean())


def faced(chain: Chain, data: SensorData, null_basis: Array) -> Chain:
    """Return the chain with every unresolved heading estimated from the base's motion in `data`.

    No motion of joints resolves the heading of a branch beyond an axis that is parallel to gravity, but the
    direction of the base's shaking, as all IMUs measure it, does. It is needed to subtract the shaking; no
    uncertainty of it is claimed. The correlation of the gyros' readings with the predicted rates of the base
    is c0 + c1 cos + c2 sin of the heading; three headings give its maximum.
    """
    if data.base_motion is None or not data.base_motion.any():
        return chain
    for item in name_null_space(chain, null_basis):
        if item.kind == "rotation_about_axis":
            twist = item.directions[:, 0]
            ahead, aside, behind = (
                _agreement(apply_perturbation(chain, heading * twist), data)
                for heading in (0.0, 0.5 * np.pi, np.pi)
            )
            middle = 0.5 * (ahead + behind)
            heading = np.arctan2(aside - middle, ahead - middle)
            chain = apply_perturbation(chain, heading * twist)
    return chain


def _agreement(chain: Chain, data: SensorData) -> float:
    """Return the sum of products of the gyros' measured and predicted rates by the base's motion."""
    resting = readings_on(chain, body_motions(chain, *data.joints)).gyro_rad_s
    shaken = readings_on(chain, body_motions(chain, *data.joints, data.base)).gyro_rad_s
    seen = data.gyro_rad_s - resting
    return float(np.sum((seen - seen.mean(axis=0)) * (shaken - resting)))
