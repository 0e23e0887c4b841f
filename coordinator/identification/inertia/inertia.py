"""Identify the inertial parameters from a recording, with the motion source that explains the torques best.

There are three motion sources: encoders with a rigid chain on a fixed base; additionally the motion of the
base and the compliance of the links; additionally the residual of every IMU. The one with the smallest torque
residual is used.
"""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple, get_args

import numpy as np

from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.dynamics.body_regressor import track_regressor
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.identification.inertia.agent_information import (
    AgentInformation,
    Answers,
    Products,
    compared,
    products,
)
from coordinator.identification.inertia.body_motion import MotionSource, Robot, body_motion_tracks, readings
from coordinator.parameter_fit.instrumental_variables import (
    InstrumentalFit,
    solve_instrumental_variables,
    without_used,
)
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.spectrum import ESTIMATED_CHAIN_TOLERANCE
from coordinator.parameter_fit.systematic_errors import chain_effects, scale_effects
from coordinator.parameter_fit.torque_sensor_scale import OFFSET_SHARE, SCALE_SIGMA, scaled
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION, RATE_HZ, Window, filtered_window
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation, compress, merge
from module_agent.model.regressor import torque_regressor
from module_agent.signals.filtering import DYNAMIC_CUTOFF_HZ, JointMotion
from module_agent.signals.torque_terms import READING_TERMS, Term, term_columns

MOTION_SOURCES: tuple[MotionSource, ...] = get_args(MotionSource)
# Of the torques' noise, in the mean over the joints: less is chance.
BETTER_BY = 0.01
# Directions with a smaller share of the rows are rounding; no fit uses them.
_ROUNDING = 1e-10
_MIN_NM = 1e-9

_SOURCE_NAMES: dict[MotionSource, str] = {
    "encoders": "the encoders",
    "structure": "encoders, base motion and link compliance",
    "imus": "encoders, base motion, link compliance and IMUs",
}
# How terms are shown: their name, their unit, and the factor to it from SI units.
_SHOWN: dict[Term, tuple[str, str, float]] = {
    "lag": ("a lag", "ms", 1e3),
    "offset": ("an offset", "mNm", 1e3),
    "viscous": ("viscous friction", "Nm s/rad", 1.0),
    "coulomb": ("Coulomb friction", "Nm", 1.0),
}


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
                name, unit, size = _SHOWN[term]
                values = ", ".join(f"{size * value:.3g}" for value in terms.value[used, k])
                lines.append(f"torque readings of {int(used.sum())} joints have {name}: {values} {unit}")
        return lines

    @property
    def gain(self) -> float:
        """The torque residual with encoders alone over that with the best source, mean over the joints."""
        return float(np.exp(_level(self.noise_nm["encoders"]) - _level(self.noise_nm[self.motion_source])))


def find_inertia(robot: Robot, windows: Sequence[Window], asked: Answers | None = None) -> Inertia:
    """Identify the inertial parameters from windows of motion.

    Args:
        robot: chain, types and refinement.
        windows: stretches of motion without a gap.
        asked: the agents' answers, which replace the coordinator's rows from encoders where they agree with
            them; the effects of the other motion sources are subtracted by the coordinator.

    Raises:
        DataError: too few samples, or motions that do not determine any inertia.
    """
    by_encoders, shared = _by_encoders(robot, windows, asked)
    pieces = [_information(robot, one) for one in windows]
    prior = np.concatenate([parameters(one) for one in module_prior(robot.chain, robot.kinds)])
    fits: dict[MotionSource, InstrumentalFit] = {}
    for source in MOTION_SOURCES:
        own = source == "encoders"
        total = by_encoders if own else reduce(merge, (piece[source] for piece in pieces))
        scale_sigma = SCALE_SIGMA[robot.torque]
        fits[source] = solve_instrumental_variables(total, prior, INDEPENDENT_FRACTION, scale_sigma)
    noise = {source: fit.fit.torque_sigma_nm for source, fit in fits.items()}
    best: MotionSource = "encoders"
    for source in MOTION_SOURCES[1:]:
        if _level(noise[source]) < _level(noise[best]) - BETTER_BY:
            best = source
    chosen, effects = _considered(robot, windows, by_encoders, fits[best], best)
    sure = _without_unsure(chosen, effects, prior)
    if sure.fit.rank < chosen.fit.rank:
        # The effects of the chain's errors were those on bodies that are not believed any more.
        chosen, effects = _considered(robot, windows, by_encoders, sure, best)
        chosen = _without_unsure(chosen, effects, prior)
    return Inertia(chosen, best, noise, effects, shared)


def without_terms(one: Window, fit: InstrumentalFit) -> JointMotion:
    """Return the motion of a window by encoders, with the terms of the readings taken off the torques."""
    motion = filtered_window(one)
    columns = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    torque = (1.0 + fit.scale.value) * motion.tau_nm - np.einsum("mnk,nk->mn", columns, fit.terms.value)
    torque.flags.writeable = False
    return motion._replace(tau_nm=torque)


def _encoder_rows(robot: Robot, one: Window) -> tuple[JointMotion, Array, Array]:
    """Return a window's motion, its rigid-body regressor, and this with the columns of the torque terms."""
    motion = filtered_window(one)
    rigid = torque_regressor(robot.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    terms = term_columns(motion, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    return motion, rigid, np.concatenate([rigid, terms], axis=2)


def _by_encoders(
    robot: Robot, windows: Sequence[Window], asked: Answers | None
) -> tuple[tuple[JointInformation, ...], AgentInformation | None]:
    """Return the information from encoders: the agents', where it agrees with the rows, or from the rows."""
    good: dict[int, JointInformation] = {}
    shared: AgentInformation | None = None
    if asked is not None:
        probed: dict[int, Products] = {}
        for one in windows if asked.joints else ():
            motion, _, rows = _encoder_rows(robot, one)
            for k in asked.joints:
                part = products(rows[:, k], motion.tau_nm[:, k])
                probed[k] = probed[k].plus(part) if k in probed else part
        good, shared = compared(asked, probed, robot.chain.serials)
    missing = [k for k in range(len(robot.kinds)) if k not in good]
    if missing:
        parts: list[tuple[JointInformation, ...]] = []
        for one in windows:
            motion, _, rows = _encoder_rows(robot, one)
            parts.append(compress(rows[:, missing], motion.tau_nm[:, missing]))
        own = reduce(merge, parts)
        good |= dict(zip(missing, own, strict=True))
    return tuple(good[k] for k in range(len(robot.kinds))), shared


def _information(robot: Robot, one: Window) -> dict[MotionSource, tuple[JointInformation, ...]]:
    """Return a window's information from every motion source but the encoders."""
    motion, rigid, rows = _encoder_rows(robot, one)
    information = {}
    read = readings(one, robot.refined, DYNAMIC_CUTOFF_HZ)
    for source in MOTION_SOURCES[1:]:
        apart = _regressor(robot, read, source) - rigid
        information[source] = compress(np.concatenate([rows, apart], axis=2), motion.tau_nm)
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
    offsets_nm = np.diag(_offsets_nm(robot, fit))
    joints = [ProjectedRows(scaled(piece, one)) for piece, one in zip(gathered, fit.scale.value, strict=True)]
    for one in windows:
        motion, rigid, rows = _encoder_rows(robot, one)
        effects = chain_effects(robot.chain, robot.covariance, fit.informed_phi, motion)
        omitted = np.broadcast_to(offsets_nm, (len(motion.t_ns), *offsets_nm.shape))
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


def _without_unsure(fit: InstrumentalFit, effects: Sequence[Array], prior_phi: Array) -> InstrumentalFit:
    """Return the fit without the combinations that the chain's or the sensors' errors hide.

    Two axes that are nearly parallel show a parameter by the angle between them alone. The noise of the
    torques may be small enough for it where the angle is not known.
    """
    noise = fit.fit.torque_sigma_nm
    weights = 1.0 / np.maximum(noise, 1e-3 * max(float(noise.max()), _MIN_NM))
    by_torques, informed = (
        solve_information(
            fit.information,
            weights,
            prior,
            independent_fraction=INDEPENDENT_FRACTION,
            tolerance=ESTIMATED_CHAIN_TOLERANCE,
            effects=effects,
        )
        for prior in (None, prior_phi)
    )
    if by_torques.rank == fit.fit.rank:
        return fit
    return fit._replace(fit=by_torques, informed_phi=informed.phi)


def _offsets_nm(robot: Robot, fit: InstrumentalFit) -> Array:
    """Return the standard deviation (n,) of the offsets that are not among the used terms [Nm]."""
    offset = READING_TERMS.index("offset")
    largest = np.array([kind.max_effort_nm for kind in robot.kinds])
    likely = OFFSET_SHARE[robot.torque] * largest
    by_torques = fit.terms.spread[:, offset]
    with np.errstate(divide="ignore"):
        either = 1.0 / np.sqrt(likely**-2.0 + by_torques**-2.0)
    return np.where(fit.terms.used[:, offset] | (likely == 0.0), 0.0, either)


def _regressor(robot: Robot, seen: SensorData, source: MotionSource) -> Array:
    return track_regressor(body_motion_tracks(robot, seen, imus=source == "imus"))


def _level(noise_nm: Array) -> float:
    return float(np.log(np.maximum(noise_nm, 1e-9)).mean())


class ProjectedRows:
    """The information of one joint in p columns; signals of its samples are added stretch by stretch.

    Of the rows A of a joint and its torques only the factor R of A = Q R and z = Q^T tau are known. The
    projection Q^T c of another signal c of the same samples solves R^T x = A^T c.
    """

    def __init__(self, gathered: JointInformation) -> None:
        self._gathered = gathered
        self._departure: Array = np.zeros(gathered.r.shape[1])
        self._effects: Array | float = 0.0
        self._shared = 0.0

    def add(self, rows: Array, torque_nm: Array, departure_nm: Array, effects_nm: Array) -> None:
        """Add a stretch of samples.

        Args:
            rows: (m, p), those of which `gathered` is the factor.
            torque_nm: (m,) gathered with them.
            departure_nm: (m,) to be subtracted from the torques.
            effects_nm: (m, k) to be appended to the rows.
        """
        self._departure = self._departure + rows.T @ departure_nm
        self._effects = self._effects + rows.T @ effects_nm
        self._shared += float(departure_nm @ (departure_nm - 2.0 * torque_nm))

    def rows(self) -> JointInformation:
        """Return the information in p + k columns, of the torques less the departures."""
        r, z = self._gathered.r, self._gathered.z
        appended = self._projected(np.column_stack([self._departure, self._effects]))
        left = z - appended[:, 0]
        size = float(z @ z) + self._gathered.rest + self._shared
        return self._gathered._replace(
            r=np.hstack([r, appended[:, 1:]]), z=left, rest=max(size - float(left @ left), 0.0)
        )

    def _projected(self, products: Array) -> Array:
        """Return the smallest x with R^T x = products."""
        # Columns of one size, so that the singular values compare.
        size = np.linalg.norm(self._gathered.r, axis=0)
        scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
        left, values, right = np.linalg.svd(self._gathered.r * scale, full_matrices=False)
        kept = values > _ROUNDING * values[0]
        solution = right[kept] @ (scale[:, None] * products) / values[kept, None]
        return np.asarray(left[:, kept] @ solution)
