"""Batch refinement of a robot from its motion windows: rigid first, then with compliant links and base.

Base motion and link compliance are estimated in turn; each needs an approximate chain.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.batch_estimation.estimator import Refinement, refine_chain
from coordinator.batch_estimation.imu_intrinsics import DELAY
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.batch_estimation.link_compliance import (
    LinkLoad,
    compliance_jacobian,
    hinge_slopes,
    joined,
    loads_of,
    turns_under,
    with_hinges_moved,
)
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


def refine_robot(
    chain: Chain,
    kinds: Sequence[ModuleType],
    windows: Sequence[Window],
    prior: ImuPrior,
    floor: NoiseFloor | None = None,
) -> Refinement:
    """Refine an approximate chain with all motions of its joints.

    Args:
        chain: n joints.
        kinds: (n,) types of the modules.
        windows: the motions, columns in the order of the chain.
        prior: how well the IMUs are known.
        floor: the noise of the first module's IMU at rest, if that module is bolted to the base by its
            housing: its readings beyond this noise are the base's motion. None: the base rests.

    Raises:
        DataError: as `refine_chain`.
    """
    keep = max(KEEP_EVERY, -(-sum(w.q_rad.size for w in windows) // MAX_IMU_SAMPLES))
    parts = [filtered(one, REFINEMENT_CUTOFF_HZ, floor) for one in windows]
    rigid = refine_chain(chain, thinned(parts, COARSE * keep), prior)
    # The first IMU may have no motion to determine its delay; all IMUs are of one type.
    late_s = float(np.median(rigid.intrinsics.errors[1:, DELAY])) if len(chain.serials) > 1 else 0.0
    steps = encoder_steps(windows)
    parts = [filtered(one, REFINEMENT_CUTOFF_HZ, floor, late_s, steps) for one in windows]
    loads = loads_of(rigid.chain, kinds, parts, RATE_HZ)
    giving, parts = _giving(rigid, parts, joined(loads, COARSE * keep), prior, COARSE * keep)
    if not giving.compliance.size:
        return refine_chain(giving.chain, thinned(parts, keep), prior)._replace(late_s=late_s)
    # The hinges' positions change the torques that turn them: first a coarse estimate, then the final one.
    coarse = thinned(parts, COARSE * keep)
    flex = hinge_slopes(giving.chain, coarse.smooth, joined(loads, COARSE * keep), giving.compliance)
    hinged = refine_chain(giving.chain, coarse, prior, flex)
    links = len(giving.compliance)
    moved, joints = hinged.compliance[links:], flex.links[:links:2]
    loads = with_hinges_moved(loads, joints, moved)
    turns = [turns_under(part, joints, hinged.compliance[:links]) for part in loads]
    loads = loads_of(hinged.chain, kinds, parts, RATE_HZ, turns)
    loads = with_hinges_moved(loads, joints, moved)
    fine = thinned(parts, keep)
    compliance = hinged.compliance[:links]
    flex = hinge_slopes(hinged.chain, fine.smooth, joined(loads, keep), compliance, moved)
    refined = refine_chain(hinged.chain, fine, prior, flex)
    # The last step estimates the change of the hinges' positions.
    return refined._replace(compliance=frozen(refined.compliance + flex.taken), late_s=late_s)


def _giving(
    rigid: Refinement, parts: list[SensorData], loads: Sequence[LinkLoad | None], prior: ImuPrior, keep: int
) -> tuple[Refinement, list[SensorData]]:
    """Refine with compliant links, and with base motion if that reduces the other IMUs' residuals: not if the
    first module's own gears shake the IMU on the base.
    """
    still = [part._replace(base_motion=None) for part in parts]
    resting = thinned(still, keep)
    flex = compliance_jacobian(rigid.chain, resting.smooth, loads)
    at_rest = refine_chain(rigid.chain, resting, prior, flex)
    data = thinned(parts, keep)
    single_module = len(rigid.chain.serials) == 1
    if data.base_motion is None or not data.base_motion.any() or single_module:
        return at_rest, still
    shaken = refine_chain(faced(rigid.chain, data, rigid.estimate.null_basis), data, prior, flex)
    return (shaken, parts) if _misfit(shaken) < _misfit(at_rest) else (at_rest, still)


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
