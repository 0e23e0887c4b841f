"""Observations of joints by IMUs, what a chain predicts of them, residuals and their Jacobian.

Everything is vectorised over observations; the base is body -1, kept in the last place of every array of
bodies. `joint_observation` makes an observation of a module's own estimate, with a sigma that counts its
systematic errors.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.perturbation import adjoint, skew
from module_agent.wire.messages import CircleEstimate, Estimate, RegressionEstimate

# Floors of the sigmas, added in squares to the stated ones, which do not include the sensors' systematic
# errors: an accelerometer's scale is good to 0.5 %, its place in the housing to 0.3 mm, a gyro's axes to 2
# mrad against the housing, and an accelerometer's bias of 5 mg tilts gravity by 5 mrad.
DISTANCE_FLOOR_M = 3e-4
DISTANCE_FLOOR_RELATIVE = 0.005
AXIS_FLOOR_RAD = 2e-3
GRAVITY_FLOOR_RAD = 5e-3

Index = NDArray[np.int64]


class PairObservation(NamedTuple):
    """The circle of one joint in one IMU's frame u, and where all joints stood.

    axis: (3,) unit vector about which the observer turns when the joint's position grows.
    radial_m: (3,) from the joint's axis to the IMU.
    q_rad: (n,) mean positions of all joints during the motion, in the order of the topology.
    """

    joint: str
    observer: str
    axis: Array
    radial_m: Array
    sigma_axis_rad: float
    sigma_distance_m: float
    q_rad: Array


class RestObservation(NamedTuple):
    """Gravity in all IMU frames at rest: specific forces (n, 3) with one sigma, joints at `q_rad` (n,)."""

    specific_force_m_s2: Array
    sigma_m_s2: float
    q_rad: Array


class ChainObservations(NamedTuple):
    """The observations as arrays, ready for a chain of n modules.

    positions: (m, n) distinct joint positions. pose: row of `positions` of each observation.
    across: (p, 3, 2) orthonormal directions across the observed axis, or across the observed gravity.
    """

    positions: Array
    joint: Index
    observer: Index
    pair_pose: Index
    axis: Array
    radial_m: Array
    pair_across: Array
    sigma_axis_rad: Array
    sigma_radial_m: Array
    rest_module: Index
    rest_pose: Index
    gravity: Array
    gravity_across: Array
    sigma_gravity_rad: Array

    @property
    def rows(self) -> int:
        """The number of residuals: per pair two of axis and two of place, per IMU and rest two of gravity."""
        return 4 * self.joint.size + 2 * self.rest_module.size


def pack(
    serials: Sequence[str], pairs: Sequence[PairObservation], rests: Sequence[RestObservation]
) -> ChainObservations:
    """Turn observations into arrays.

    A module's observations of its own joint are left out: the catalogue gives its axis.

    Raises:
        DataError: no rest observation, or one in which an accelerometer reads nothing.
        ValueError: an unknown serial or a wrong shape.
    """
    if not rests:
        raise DataError("no rest observation: the directions to gravity are needed to assemble a chain")
    index = {serial: k for k, serial in enumerate(serials)}
    _check(index, pairs, rests)
    used = [p for p in pairs if p.joint != p.observer]
    stacked = np.array([p.q_rad for p in used] + [r.q_rad for r in rests], dtype=float)
    positions, row = np.unique(stacked, axis=0, return_inverse=True)
    row = row.reshape(-1).astype(np.int64)
    axis = _unit(np.array([p.axis for p in used], dtype=float).reshape(-1, 3))
    radial = np.array([p.radial_m for p in used], dtype=float).reshape(-1, 3)
    force = np.array([r.specific_force_m_s2 for r in rests], dtype=float).reshape(-1, 3)
    sigma_rest = np.repeat([r.sigma_m_s2 for r in rests], len(serials)) / np.linalg.norm(force, axis=1)
    floor = DISTANCE_FLOOR_M + DISTANCE_FLOOR_RELATIVE * np.linalg.norm(radial, axis=1)
    return ChainObservations(
        positions=positions,
        joint=np.array([index[p.joint] for p in used], dtype=np.int64),
        observer=np.array([index[p.observer] for p in used], dtype=np.int64),
        pair_pose=row[: len(used)],
        axis=axis,
        radial_m=radial,
        pair_across=_across(axis),
        sigma_axis_rad=np.hypot([p.sigma_axis_rad for p in used], AXIS_FLOOR_RAD),
        sigma_radial_m=np.hypot([p.sigma_distance_m for p in used], floor),
        rest_module=np.tile(np.arange(len(serials)), len(rests)).astype(np.int64),
        rest_pose=np.repeat(row[len(used) :], len(serials)),
        gravity=_unit(force),
        gravity_across=_across(_unit(force)),
        sigma_gravity_rad=np.hypot(sigma_rest, GRAVITY_FLOOR_RAD),
    )


class Prediction(NamedTuple):
    """What a chain predicts, in the observers' frames: axes, radial vectors (p, 3), unit gravity (g, 3)."""

    axis: Array
    radial_m: Array
    gravity: Array


def predict(chain: Chain, observations: ChainObservations) -> Prediction:
    """Return the observations that the chain predicts."""
    return _Geometry(chain, observations).prediction()


def residuals(chain: Chain, observations: ChainObservations) -> Array:
    """Return the weighted residuals (rows,), of unit variance: axes, then radial vectors, then gravity."""
    predicted, across = predict(chain, observations), observations.pair_across
    axis = _into(across, predicted.axis) / observations.sigma_axis_rad[:, None]
    off = predicted.radial_m - observations.radial_m
    place = _into(across, off) / observations.sigma_radial_m[:, None]
    gravity = _into(observations.gravity_across, predicted.gravity) / observations.sigma_gravity_rad[:, None]
    return np.concatenate([axis.ravel(), place.ravel(), gravity.ravel()])


def jacobian(chain: Chain, observations: ChainObservations) -> Array:
    """Return d residuals / d [increment (6 n), tilt of gravity (3)], (rows, 6 n + 3), at the chain as it is.

    The tilt turns the gravity vector about the root frame's axes; about itself that does nothing.
    """
    return _Geometry(chain, observations).jacobian()


class _Geometry:
    """The chain at every observed position: displacements of bodies, poses of observers, lines of joints."""

    def __init__(self, chain: Chain, observations: ChainObservations):
        self.chain, self.observations = chain, observations
        count = len(chain.serials)
        self.parent = np.array(chain.parent)
        self.carrier = np.array([chain.carrier(k) for k in range(count)])
        # The base in the last place is body -1 and never moves.
        self.body = np.tile(np.eye(4), (len(observations.positions), count + 1, 1, 1))
        self.body[:, :-1] = body_displacements(chain, observations.positions)
        self.up = chain.gravity / np.linalg.norm(chain.gravity)
        above = self.body[observations.pair_pose, self.parent[observations.joint]]
        self.axis = np.einsum("pij,pj->pi", above[:, :3, :3], chain.axis[observations.joint])
        self.point = (
            np.einsum("pij,pj->pi", above[:, :3, :3], chain.point[observations.joint]) + above[:, :3, 3]
        )
        self.observer = self._imu(observations.pair_pose, observations.observer)
        self.rest = self._imu(observations.rest_pose, observations.rest_module)

    def prediction(self) -> Prediction:
        turn, place = self.observer[:, :3, :3], self.observer[:, :3, 3]
        off = place - self.point
        radial = off - np.sum(off * self.axis, axis=1, keepdims=True) * self.axis
        return Prediction(
            _into(turn, self.axis), _into(turn, radial), _into(self.rest[:, :3, :3], self.up[None, :])
        )

    def jacobian(self) -> Array:
        observations, width = self.observations, 6 * len(self.chain.serials)
        bodies = self._body_twists()
        line = bodies[observations.pair_pose, self.parent[observations.joint]]
        self._add(line, observations.pair_pose, self.parent[observations.joint], observations.joint)
        imu = self._imu_twists(bodies, observations.pair_pose, observations.observer)
        axis, radial = self._pair_slopes(line - imu)
        rest = self._imu_twists(bodies, observations.rest_pose, observations.rest_module)
        # u sees g turn backwards when u turns: d(R^T g) = R^T (g x omega).
        home = np.swapaxes(self.rest[:, :3, :3], 1, 2)
        gravity = home @ skew(self.up) @ rest[:, :3]
        tilt = -home @ skew(self.up)
        slopes = np.zeros((observations.rows, width + 3))
        slopes[:, :width] = np.concatenate(
            [
                _weighted(observations.pair_across, axis, observations.sigma_axis_rad),
                _weighted(observations.pair_across, radial, observations.sigma_radial_m),
                _weighted(observations.gravity_across, gravity, observations.sigma_gravity_rad),
            ]
        )
        tilts = _weighted(observations.gravity_across, tilt, observations.sigma_gravity_rad)
        slopes[4 * observations.joint.size :, width:] = tilts
        return slopes

    def _imu(self, pose: Index, module: Index) -> Array:
        return np.asarray(self.body[pose, self.carrier[module]] @ self.chain.imu_home[module])

    def _body_twists(self) -> Array:
        """Return (m, n + 1, 6, 6 n): the twist of every displaced body per increment.

        An increment xi of module a makes exp(S_a q_a) into exp(xi) exp(S_a q_a) exp(-xi), which adds
        Ad(D_parent) xi - Ad(D_a) xi to the twists of all that a moves.
        """
        count = len(self.chain.serials)
        twists = np.zeros((*self.body.shape[:2], 6, 6 * count))
        carry = adjoint(self.body)
        for a, parent in enumerate(self.chain.parent):
            twists[:, a] = twists[:, parent]
            twists[:, a, :, 6 * a : 6 * a + 6] += carry[:, parent] - carry[:, a]
        return twists

    def _imu_twists(self, bodies: Array, pose: Index, module: Index) -> Array:
        twists: Array = bodies[pose, self.carrier[module]]
        self._add(twists, pose, self.carrier[module], module)
        return twists

    def _add(self, twists: Array, pose: Index, body: Index, module: Index) -> None:
        """Add to `twists` (p, 6, 6 n), fresh from indexing, what the own increment of each `module` does."""
        columns = 6 * module[:, None] + np.arange(6)
        each = np.arange(module.size)[:, None, None]
        twists[each, np.arange(6)[None, :, None], columns[:, None, :]] += adjoint(self.body[pose, body])

    def _pair_slopes(self, relative: Array) -> tuple[Array, Array]:
        """Return d axis and d radial (p, 3, 6 n) as the observer sees them, from the line's twist."""
        home = np.swapaxes(self.observer[:, :3, :3], 1, 2)
        axis, off = self.axis, self.point - self.observer[:, :3, 3]
        d_axis = -skew(axis) @ relative[:, :3]
        d_point = relative[:, 3:] - skew(self.point) @ relative[:, :3]
        along = np.sum(off * axis, axis=1)[:, None, None]
        keep = np.eye(3) - axis[:, :, None] * axis[:, None, :]
        d_radial = -keep @ d_point + along * d_axis + axis[:, :, None] * (off[:, None, :] @ d_axis)
        return home @ d_axis, home @ d_radial


def _weighted(across: Array, slopes: Array, sigma: Array) -> Array:
    """Return the slopes (p, 3, k) of directions `across` (p, 3, 2), in sigmas (p,), as rows (2 p, k)."""
    return np.asarray(np.swapaxes(across, 1, 2) @ slopes / sigma[:, None, None]).reshape(-1, slopes.shape[2])


def _check(index: dict[str, int], pairs: Sequence[PairObservation], rests: Sequence[RestObservation]) -> None:
    for serial in (serial for pair in pairs for serial in (pair.joint, pair.observer)):
        if serial not in index:
            raise ValueError(f"{serial} is not in the topology, which knows {', '.join(index)}")
    for q_rad in [p.q_rad for p in pairs] + [r.q_rad for r in rests]:
        if np.shape(q_rad) != (len(index),):
            raise ValueError(f"q_rad has shape {np.shape(q_rad)}, ({len(index)},) is needed")
    for shape in (np.shape(rest.specific_force_m_s2) for rest in rests):
        if shape != (len(index), 3):
            raise ValueError(
                f"specific forces have shape {shape}, ({len(index)}, 3) is needed: one row for every module"
            )
    for rest in rests:
        silent = [serial for serial, k in index.items() if not np.any(rest.specific_force_m_s2[k])]
        if silent:
            raise DataError(
                f"the accelerometer of {', '.join(silent)} reads nothing at rest: gravity is needed of each"
            )


def _into(frame: Array, vectors: Array) -> Array:
    """Return the components of `vectors` (p, 3) along the columns of `frame` (p, 3, c)."""
    return np.asarray(np.einsum("pij,pi->pj", frame, np.broadcast_to(vectors, (frame.shape[0], 3))))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _across(directions: Array) -> Array:
    """Return (p, 3, 2) orthonormal pairs across unit vectors (p, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = _unit(np.cross(directions, helper))
    return np.stack([first, np.cross(directions, first)], axis=2)


def circle_observation(estimate: Estimate, q_rad: Array) -> PairObservation | None:
    """Return the circle point analysis of an estimate as an observation; None without one.

    Args:
        estimate: by the module `serial`, of `joint`.
        q_rad: (n,) mean positions of all joints meanwhile.
    """
    return _observation(estimate, estimate.circle, q_rad)


def joint_observation(estimate: Estimate, q_rad: Array) -> PairObservation | None:
    """Return the best fit of an estimate as an observation, mostly the regression; None without one."""
    return _observation(estimate, estimate.best, q_rad)


def _observation(
    estimate: Estimate, fit: RegressionEstimate | CircleEstimate | None, q_rad: Array
) -> PairObservation | None:
    """Return a fit as an observation.

    An IMU that turned by more or by less than the joint was also moved by something else, mostly by compliant
    held joints between the two. The sigmas of axis and distance grow by that share.
    """
    if fit is None:
        return None
    excess = abs(estimate.rate_ratio - 1.0)
    return PairObservation(
        estimate.joint,
        estimate.serial,
        np.array(fit.axis),
        np.array(fit.radial_m),
        fit.sigma_axis_rad + excess,
        fit.sigma_distance_m + excess * fit.distance_m,
        q_rad,
    )
