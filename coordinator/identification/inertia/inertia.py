"""Identify the inertial parameters from a recording, with the motion source that explains the torques best.

There are three motion sources: encoders with a rigid chain on a fixed base; additionally the motion of the
base and the compliance of the links; additionally the residual of every IMU. The one with the smallest torque
residual is used.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, get_args

import numpy as np

from coordinator.batch_estimation.estimator import Refinement
from coordinator.batch_estimation.sensor_data import NoiseFloor
from coordinator.dynamics.body_regressor import track_regressor
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.identification.inertia.agent_information import AgentInformation
from coordinator.identification.inertia.body_motion import (
    MotionSource,
    Readings,
    body_motion_tracks,
    readings,
)
from coordinator.identification.inertia.projected_rows import ProjectedRows
from coordinator.parameter_fit.instrumental_variables import (
    InstrumentalFit,
    solve_instrumental_variables,
    without_used,
)
from coordinator.parameter_fit.systematic_errors import chain_effects, scale_effects
from coordinator.parameter_fit.torque_sensor_scale import OFFSET_SHARE, SCALE_SIGMA, scaled
from coordinator.synchronisation.motion_windows import (
    INDEPENDENT_FRACTION,
    RATE_HZ,
    Window,
    filtered_window,
)
from module_agent.model.catalogue import ModuleType, TorqueKind
from module_agent.model.chain import Array, Chain
from module_agent.model.information import JointInformation, compress, merge
from module_agent.model.regressor import torque_regressor
from module_agent.signals.filtering import DYNAMIC_CUTOFF_HZ, JointMotion
from module_agent.signals.torque_terms import READING_TERMS, Term, term_columns

MOTION_SOURCES: tuple[MotionSource, ...] = get_args(MotionSource)
# Of the torques' noise, in the mean over the joints: less is chance.
BETTER_BY = 0.01

_SOURCE_NAMES: dict[MotionSource, str] = {
    "encoders": "the encoders",
    "structure": "encoders, base motion and link compliance",
    "imus": "encoders, base motion, link compliance and IMUs",
}
_NAMES: dict[Term, str] = {
    "lag": "a lag",
    "offset": "an offset",
    "viscous": "viscous friction",
    "coulomb": "Coulomb friction",
}
_SHOWN: dict[Term, tuple[str, float]] = {
    "lag": ("ms", 1e3),
    "offset": ("mNm", 1e3),
    "viscous": ("Nm s/rad", 1.0),
    "coulomb": ("Nm", 1.0),
}

Agents = Callable[[tuple[JointInformation, ...]], AgentInformation]


class Robot(NamedTuple):
    """The robot whose inertia is to be identified.

    chain: n joints. kinds: (n,) their modules' types. refined: the refinement of links and IMUs. covariance:
    (6 n, 6 n) of the chain's perturbation. floor: noise at rest of the IMU on the base, None without one.
    torque: whether the torque sensors are calibrated.
    """

    chain: Chain
    kinds: Sequence[ModuleType]
    refined: Refinement
    covariance: Array
    floor: NoiseFloor | None
    torque: TorqueKind = "uncalibrated"


class Inertia(NamedTuple):
    """Inertial parameters of n bodies.

    instrumental: parameters, terms and information with the best motion source, `motion_source`.
    noise_nm: (n,) torque residual with every motion source. effects: (k_i, j) of every joint: the effects of
    errors of the torques' scale, of the chain, and of offsets on its rows of `instrumental.information`.
    gathered: the modules' agents' information from encoders, None if no agent was asked.
    """

    instrumental: InstrumentalFit
    motion_source: MotionSource
    noise_nm: Mapping[MotionSource, Array]
    effects: tuple[Array, ...]
    gathered: AgentInformation | None = None

    def summary(self) -> list[str]:
        """Return lines about the torque residual, the motion source and the terms of the torque readings."""
        fit, terms = self.instrumental.fit, self.instrumental.terms
        noise = ", ".join(f"{1e3 * value:.1f}" for value in fit.torque_sigma_nm)
        lines = [f"torque residual {noise} mNm, motion measured by {_SOURCE_NAMES[self.motion_source]}"]
        if self.motion_source != "encoders":
            lines[0] += f"; with encoders alone it is {self.gain:.2f} times as large"
        for k, term in enumerate(READING_TERMS):
            used = terms.used[:, k]
            if used.any():
                unit, size = _SHOWN[term]
                values = ", ".join(f"{size * value:.3g}" for value in terms.value[used, k])
                lines.append(
                    f"torque readings of {int(used.sum())} joints have {_NAMES[term]}: {values} {unit}"
                )
        return lines

    @property
    def gain(self) -> float:
        """The torque residual with encoders alone over that with the best source, mean over the joints."""
        return float(np.exp(_level(self.noise_nm["encoders"]) - _level(self.noise_nm[self.motion_source])))


def find_inertia(robot: Robot, windows: Sequence[Window], agents: Agents | None = None) -> Inertia:
    """Identify the inertial parameters from windows of motion.

    Args:
        robot: chain, types and refinement.
        windows: stretches of motion without a gap.
        agents: replaces the coordinator's rows from encoders by those that the modules have gathered; the
            effects of the other motion sources are subtracted by the coordinator.

    Raises:
        DataError: too few samples, or motions that do not determine any inertia.
    """
    pieces = [_information(robot, one) for one in windows]
    prior = np.concatenate([parameters(one) for one in module_prior(robot.chain, robot.kinds)])
    fits: dict[MotionSource, InstrumentalFit] = {}
    shared: AgentInformation | None = None
    gathered: tuple[JointInformation, ...] = ()
    for source in MOTION_SOURCES:
        total = pieces[0][source]
        for piece in pieces[1:]:
            total = merge(total, piece[source])
        if source == "encoders":
            shared = agents(total) if agents is not None else None
            gathered = total = shared.joints if shared is not None else total
        fits[source] = solve_instrumental_variables(
            total, prior, INDEPENDENT_FRACTION, SCALE_SIGMA[robot.torque]
        )
    noise = {source: fit.fit.torque_sigma_nm for source, fit in fits.items()}
    best: MotionSource = "encoders"
    for source in MOTION_SOURCES[1:]:
        if _level(noise[source]) < _level(noise[best]) - BETTER_BY:
            best = source
    chosen, effects = _considered(robot, windows, gathered, fits[best], best)
    return Inertia(chosen, best, noise, effects, shared)


def without_terms(one: Window, fit: InstrumentalFit) -> JointMotion:
    """Return the motion of a window by encoders, with the terms of the readings taken off the torques."""
    motion = filtered_window(one)
    columns = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    torque = (1.0 + fit.scale.value) * motion.tau_nm - np.einsum("mnk,nk->mn", columns, fit.terms.value)
    torque.flags.writeable = False
    return motion._replace(tau_nm=torque)


def _information(robot: Robot, one: Window) -> dict[MotionSource, tuple[JointInformation, ...]]:
    motion = filtered_window(one)
    rigid = torque_regressor(robot.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    terms = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    information: dict[MotionSource, tuple[JointInformation, ...]] = {
        "encoders": compress(np.concatenate([rigid, terms], axis=2), motion.tau_nm)
    }
    read = readings(one, robot.refined, DYNAMIC_CUTOFF_HZ)
    for source in MOTION_SOURCES[1:]:
        apart = _regressor(robot, read, source) - rigid
        information[source] = compress(np.concatenate([rigid, terms, apart], axis=2), motion.tau_nm)
    return information


def _considered(
    robot: Robot,
    windows: Sequence[Window],
    gathered: Sequence[JointInformation],
    fit: InstrumentalFit,
    source: MotionSource,
) -> tuple[InstrumentalFit, tuple[Array, ...]]:
    """Return the fit with the rows gathered from encoders, and the effects of errors of chain and scale.

    The torque of the motion that encoders do not measure is subtracted from the torques, as far as it is in
    the range of the rows.
    """
    size = fit.informed_phi.size
    offsets_nm = _offsets_nm(robot, fit)
    joints = [ProjectedRows(scaled(piece, one)) for piece, one in zip(gathered, fit.scale.value, strict=True)]
    for one in windows:
        motion = filtered_window(one)
        rigid = torque_regressor(robot.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
        rows = np.concatenate([rigid, term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)], axis=2)
        effects = chain_effects(robot.chain, robot.covariance, fit.informed_phi, motion)
        omitted = np.broadcast_to(np.diag(offsets_nm), (len(motion.t_ns), *np.diag(offsets_nm).shape))
        effects = np.concatenate([effects, omitted], axis=2)
        departure = np.zeros_like(motion.tau_nm)
        if source != "encoders":
            apart = _regressor(robot, readings(one, robot.refined, DYNAMIC_CUTOFF_HZ), source) - rigid
            departure = apart @ fit.informed_phi
        torque = (1.0 + fit.scale.value) * motion.tau_nm
        for i, joint in enumerate(joints):
            joint.add(rows[:, i], torque[:, i], departure[:, i], effects[:, i])
    left = [
        without_used(joint.rows(), size, used) for joint, used in zip(joints, fit.terms.used, strict=True)
    ]
    bodies = tuple(piece._replace(r=piece.r[:, :size]) for piece in left)
    scale = scale_effects(bodies, fit.scale)
    chain = [piece.r[:, size:] for piece in left]
    return fit._replace(information=bodies), tuple(map(np.hstack, zip(scale, chain, strict=True)))


def _offsets_nm(robot: Robot, fit: InstrumentalFit) -> Array:
    """Return the standard deviation (n,) of the offsets that are not among the used terms [Nm]."""
    offset = READING_TERMS.index("offset")
    largest = np.array([kind.max_effort_nm for kind in robot.kinds])
    likely = OFFSET_SHARE[robot.torque] * largest
    by_torques = fit.terms.spread[:, offset]
    with np.errstate(divide="ignore"):
        either = 1.0 / np.sqrt(likely**-2.0 + by_torques**-2.0)
    return np.where(fit.terms.used[:, offset] | (likely == 0.0), 0.0, either)


def _regressor(robot: Robot, seen: Readings, source: MotionSource) -> Array:
    tracks = body_motion_tracks(
        chain=robot.chain,
        kinds=robot.kinds,
        refined=robot.refined,
        floor=robot.floor,
        measured=seen,
        imus=source == "imus",
    )
    return track_regressor(tracks)


def _level(noise_nm: Array) -> float:
    return float(np.log(np.maximum(noise_nm, 1e-9)).mean())
