"""The inertial parameters from a recording, with as much of the robot's motion as anybody has seen.

Three ways to see the motion are tried: by encoders on a rigid chain at rest, with the base and the links that
give, and with what every IMU reads beyond that. Whichever leaves the least in the torques is used.
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

_SEEN_BY: dict[MotionSource, str] = {
    "encoders": "encoders",
    "structure": "encoders, base and springs of the links",
    "imus": "IMUs",
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
    """What is known of a robot when its inertia is asked for.

    chain: n joints. kinds: (n,) their modules' types. refined: what the refinement has found of links and
    IMUs. covariance: (6 n, 6 n) of the chain's increments. floor: noise of the IMU that rides on the base at
    rest, None if none does. torque: how well the torque sensors are known.
    """

    chain: Chain
    kinds: Sequence[ModuleType]
    refined: Refinement
    covariance: Array
    floor: NoiseFloor | None
    torque: TorqueKind = "uncalibrated"


class Inertia(NamedTuple):
    """Inertial parameters of n bodies.

    seen: parameters, terms and information, of the way of seeing that was best, `eyes`.
    noise_nm: (n,) of every way, what it leaves in the torques. effects: (k_i, j) of every joint: what errors
    of the torques' scale, of the chain, and of offsets do to its rows of `seen.information`. gathered: whose
    the information from encoders is, None if no agent can have been asked.
    """

    seen: InstrumentalFit
    eyes: MotionSource
    noise_nm: Mapping[MotionSource, Array]
    effects: tuple[Array, ...]
    gathered: AgentInformation | None = None

    def summary(self) -> list[str]:
        """Return in lines to read what the motion was seen by, and what torque readings hold besides."""
        fit, terms = self.seen.fit, self.seen.terms
        noise = ", ".join(f"{1e3 * value:.1f}" for value in fit.torque_sigma_nm)
        lines = [f"torques are explained to {noise} mNm, with motion as seen by {_SEEN_BY[self.eyes]}"]
        if self.eyes != "encoders":
            lines[0] += f"; encoders alone leave {self.gain:.2f} times as much"
        for k, term in enumerate(READING_TERMS):
            used = terms.used[:, k]
            if used.any():
                unit, size = _SHOWN[term]
                values = ", ".join(f"{size * value:.3g}" for value in terms.value[used, k])
                lines.append(
                    f"torque readings of {int(used.sum())} joints hold {_NAMES[term]}: {values} {unit}"
                )
        return lines

    @property
    def gain(self) -> float:
        """By how much the torques' noise is smaller than with encoders alone, in the mean over the joints."""
        return float(np.exp(_level(self.noise_nm["encoders"]) - _level(self.noise_nm[self.eyes])))


def find_inertia(robot: Robot, windows: Sequence[Window], agents: Agents | None = None) -> Inertia:
    """Find the inertial parameters from windows of motion.

    `agents` puts what the modules have gathered in the place of the coordinator's rows from encoders; what
    was seen beyond those the coordinator takes off.

    Raises:
        ValueError: too few samples, or motions that say nothing of inertia.
    """
    pieces = [_information(robot, one) for one in windows]
    prior = np.concatenate([parameters(one) for one in module_prior(robot.chain, robot.kinds)])
    found: dict[MotionSource, InstrumentalFit] = {}
    shared: AgentInformation | None = None
    gathered: tuple[JointInformation, ...] = ()
    for eyes in MOTION_SOURCES:
        total = pieces[0][eyes]
        for piece in pieces[1:]:
            total = merge(total, piece[eyes])
        if eyes == "encoders":
            shared = agents(total) if agents is not None else None
            gathered = total = shared.joints if shared is not None else total
        found[eyes] = solve_instrumental_variables(
            total, prior, INDEPENDENT_FRACTION, SCALE_SIGMA[robot.torque]
        )
    noise = {eyes: fit.fit.torque_sigma_nm for eyes, fit in found.items()}
    best: MotionSource = "encoders"
    for eyes in MOTION_SOURCES[1:]:
        if _level(noise[eyes]) < _level(noise[best]) - BETTER_BY:
            best = eyes
    seen, effects = _considered(robot, windows, gathered, found[best], best)
    return Inertia(seen, best, noise, effects, shared)


def without_terms(one: Window, seen: InstrumentalFit) -> JointMotion:
    """Return the motion of a window as encoders see it, with the torque of the bodies alone."""
    motion = filtered_window(one)
    columns = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    torque = (1.0 + seen.scale.value) * motion.tau_nm - np.einsum("mnk,nk->mn", columns, seen.terms.value)
    torque.flags.writeable = False
    return motion._replace(tau_nm=torque)


def _information(robot: Robot, one: Window) -> dict[MotionSource, tuple[JointInformation, ...]]:
    motion = filtered_window(one)
    rigid = torque_regressor(robot.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    terms = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    found: dict[MotionSource, tuple[JointInformation, ...]] = {
        "encoders": compress(np.concatenate([rigid, terms], axis=2), motion.tau_nm)
    }
    seen = readings(one, robot.refined, DYNAMIC_CUTOFF_HZ)
    for eyes in MOTION_SOURCES[1:]:
        apart = _regressor(robot, seen, eyes) - rigid
        found[eyes] = compress(np.concatenate([rigid, terms, apart], axis=2), motion.tau_nm)
    return found


def _considered(
    robot: Robot,
    windows: Sequence[Window],
    gathered: Sequence[JointInformation],
    seen: InstrumentalFit,
    eyes: MotionSource,
) -> tuple[InstrumentalFit, tuple[Array, ...]]:
    """Return the fit with the rows gathered from encoders, and what errors of chain and scale do to them.

    What was seen beyond encoders is taken off the torques: of the rows, its projection onto them.
    """
    size = seen.informed_phi.size
    offsets_nm = _offsets_nm(robot, seen)
    beside = [
        ProjectedRows(scaled(piece, one)) for piece, one in zip(gathered, seen.scale.value, strict=True)
    ]
    for one in windows:
        motion = filtered_window(one)
        rigid = torque_regressor(robot.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
        rows = np.concatenate([rigid, term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)], axis=2)
        effects = chain_effects(robot.chain, robot.covariance, seen.informed_phi, motion)
        omitted = np.broadcast_to(np.diag(offsets_nm), (len(motion.t_ns), *np.diag(offsets_nm).shape))
        effects = np.concatenate([effects, omitted], axis=2)
        departure = np.zeros_like(motion.tau_nm)
        if eyes != "encoders":
            apart = _regressor(robot, readings(one, robot.refined, DYNAMIC_CUTOFF_HZ), eyes) - rigid
            departure = apart @ seen.informed_phi
        torque = (1.0 + seen.scale.value) * motion.tau_nm
        for i, joint in enumerate(beside):
            joint.add(rows[:, i], torque[:, i], departure[:, i], effects[:, i])
    left = [
        without_used(joint.rows(), size, used) for joint, used in zip(beside, seen.terms.used, strict=True)
    ]
    bodies = tuple(piece._replace(r=piece.r[:, :size]) for piece in left)
    scale = scale_effects(bodies, seen.scale)
    chain = [piece.r[:, size:] for piece in left]
    return seen._replace(information=bodies), tuple(map(np.hstack, zip(scale, chain, strict=True)))


def _offsets_nm(robot: Robot, seen: InstrumentalFit) -> Array:
    """Return by how much (n,) the offsets may be off that are taken for none [Nm]."""
    offset = READING_TERMS.index("offset")
    largest = np.array([kind.max_effort_nm for kind in robot.kinds])
    likely = OFFSET_SHARE[robot.torque] * largest
    told = seen.terms.spread[:, offset]
    with np.errstate(divide="ignore"):
        either = 1.0 / np.sqrt(likely**-2.0 + told**-2.0)
    return np.where(seen.terms.used[:, offset] | (likely == 0.0), 0.0, either)


def _regressor(robot: Robot, seen: Readings, eyes: MotionSource) -> Array:
    tracks = body_motion_tracks(
        chain=robot.chain,
        kinds=robot.kinds,
        refined=robot.refined,
        floor=robot.floor,
        seen=seen,
        imus=eyes == "imus",
    )
    return track_regressor(tracks)


def _level(noise_nm: Array) -> float:
    return float(np.log(np.maximum(noise_nm, 1e-9)).mean())
