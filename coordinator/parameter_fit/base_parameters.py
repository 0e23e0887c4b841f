"""Base parameters: the combinations of parameters that torques determine, with their names and frames.

The torques depend on the parameters x through the row space of the regressor. r of its columns are chosen as
independent; all others are linear combinations of those, so that their parameters only appear added to those
of the chosen columns (Gautier and Khalil 1990, Direct calculation of minimum set of inertial parameters):
beta_i = x_i + sum_j g_ij x_j. Any choice of the columns gives the same information.

Combinations are shortest in frames with z along the body's joint axis and x towards the next joint
(`joint_frames`). Most base parameters are single parameters then, because the distance that lumps the masses
beyond lies along the common normal of two axes (Khalil and Dombre 2002, Modeling, identification and control
of robots, section 3.2).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, qr, solve_triangular

from coordinator.dynamics.pseudo_inertia import parameter_scale, parameter_transform
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE, spectrum
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only, read_only
from module_agent.model.regressor import PER_BODY

# A column with a smaller share of its length outside the span of the columns chosen before is passed over, so
# that coefficients do not exceed the reciprocal and a combination is named by its largest member. With
# motions that determine all base parameters, any value between 0.05 and 0.25 chooses the same columns.
INDEPENDENT_ABOVE = 0.25

# Of a parameter's own scale. Geometry that was itself estimated tilts the groupings by about its errors.
NEGLIGIBLE = 2e-3

_MOMENTS = ("xx", "xy", "xz", "yy", "yz", "zz")
# Within a body the parameters that its own joint determines come first, and those that are lumped into the
# body below come last (Khalil and Dombre 2002, Modeling, identification and control of robots, section 9.4.2,
# z along the axis): Izz, first moments, the other moments, then Iyy, the first moment along the axis, the
# mass.
_WITHIN_BODY = (9, 1, 2, 4, 5, 6, 8, 7, 3, 0)


class Columns(NamedTuple):
    """The columns of a regressor: their names, the common size of each parameter, and the order of choice.

    scale: (p,) by which a parameter is counted, so that those of different units have one common size: the
        regressor's columns are multiplied by it. preferred: (p,) the order in which they are tried as the
        independent ones.
    """

    names: tuple[str, ...]
    scale: Array
    preferred: NDArray[np.int64]

    def append(self, names: Sequence[str], scale: ArrayLike = 1.0) -> "Columns":
        """Return these columns with further ones appended, which are chosen first.

        Friction and offsets are to be base parameters by themselves; inertias are lumped instead.
        """
        added = np.broadcast_to(np.asarray(scale, dtype=float), len(names))
        size = len(self.names)
        order = np.concatenate([np.arange(size, size + len(names)), self.preferred])
        return Columns((*self.names, *names), np.concatenate([self.scale, added]), order)


class BaseParameters(NamedTuple):
    """The r base parameters of p columns, beta = grouping @ x; arrays are read-only.

    columns: what the regressor's columns are. independent: (r,) the columns that each base parameter starts
        with. grouping: (r, p), 1 there. value: (r,) their estimates. covariance: (r, r).
    share: (p,) squared length of a parameter's projection onto the row space: 1 if it is determined by
        itself, 0 if it has no effect.
    condition: largest over smallest singular value that was kept, of the scaled regressor.
    """

    columns: Columns
    independent: NDArray[np.int64]
    grouping: Array
    value: Array
    covariance: Array
    share: Array
    condition: float

    @property
    def rank(self) -> int:
        """The number of base parameters."""
        return len(self.independent)

    @property
    def sigma(self) -> Array:
        """Standard deviations (r,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def relative_sigma(self) -> Array:
        """Standard deviations over values (r,); infinite for a value of zero."""
        size = np.abs(self.value)
        return np.asarray(np.divide(self.sigma, size, out=np.full(self.rank, np.inf), where=size > 0.0))

    def lumped(self, i: int) -> tuple[int, ...]:
        """Return the columns whose parameters are in base parameter `i`, its independent one first."""
        of_scale = self.grouping[i] * self.columns.scale / self.columns.scale[self.independent[i]]
        others = np.flatnonzero(np.abs(of_scale) > NEGLIGIBLE)
        return (int(self.independent[i]), *(int(j) for j in others if j != self.independent[i]))

    def summary(self, i: int) -> str:
        """Return base parameter `i` as a combination of named parameters, "m2 c2x + 0.225 (m3 + m4)"."""
        groups: dict[tuple[bool, str], list[str]] = {}
        for j in self.lumped(i):
            factor = float(self.grouping[i, j])
            groups.setdefault((factor < 0.0, f"{abs(factor):.3g}"), []).append(self.columns.names[j])
        terms = [_term(*factor, names) for factor, names in groups.items()]
        return " ".join(terms).removeprefix("+ ")


def inertial_columns(joints: int) -> Columns:
    """Return the columns of `torque_regressor` for n joints; body 1 is the first of the chain.

    "m2" is the mass of body 2, "m2 c2x" its first moment along x, "I2xy" its inertia about the frame's
    origin. Sizes are those of `parameter_scale`.
    """
    names: list[str] = []
    for b in range(1, joints + 1):
        names += [f"m{b}", *(f"m{b} c{b}{x}" for x in "xyz"), *(f"I{b}{pair}" for pair in _MOMENTS)]
    order = [PER_BODY * b + k for b in range(joints) for k in _WITHIN_BODY]
    return Columns(tuple(names), parameter_scale(joints), np.array(order, dtype=np.int64))


def inertial_units(joints: int) -> tuple[str, ...]:
    """Return the units of the parameters of `inertial_columns`."""
    return ("kg", *("kg m",) * 3, *("kg m^2",) * 6) * joints


def into_frames(triangle: ArrayLike, homes: ArrayLike) -> Array:
    """Transform rows (k, p) over parameters in the root frame to parameters in the bodies' own frames.

    Args:
        triangle: its first 10 n columns are `torque_regressor`'s; any further ones stay.
        homes: (n, 4, 4) poses of the bodies' frames in the root frame at q = 0. With z along the joint's axis
            (`joint_frames`) the groupings are those of the literature.
    """
    rows = np.array(triangle, dtype=float)
    poses = np.asarray(homes, dtype=float)
    size = PER_BODY * len(poses)
    rows[:, :size] = rows[:, :size] @ block_diag(*(parameter_transform(pose) for pose in poses))
    return rows


def whitened(
    information: Sequence[JointInformation], sigma_nm: ArrayLike, independent_fraction: float = 1.0
) -> tuple[Array, Array]:
    """Return the whitened rows (k, p) and target (k,) of all joints: divided by their noise.

    Args:
        information: per joint.
        sigma_nm: (n,) noise of the joints' torques, as `InertialFit.torque_sigma_nm`.
        independent_fraction: independent samples per sample, below 1 after a low-pass.

    Raises:
        DataError: noise that is not positive, or not one per joint.
        ValueError: a fraction out of range.
    """
    sigma = np.asarray(sigma_nm, dtype=float)
    if sigma.shape != (len(information),) or not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise DataError(f"sigma_nm must be {len(information)} positive numbers, one per joint; got {sigma}")
    if not 0.0 < independent_fraction <= 1.0:
        raise ValueError(f"independent_fraction is {independent_fraction}; it must be above 0 and at most 1")
    weight = np.sqrt(independent_fraction) / sigma
    rows = np.vstack([w * piece.r for w, piece in zip(weight, information, strict=True)])
    return rows, np.concatenate([w * piece.z for w, piece in zip(weight, information, strict=True)])


def base_parameters(
    triangle: ArrayLike,
    target: ArrayLike,
    columns: Columns,
    sigma: float = 1.0,
    max_sigma: float = np.inf,
    common_errors: ArrayLike | None = None,
    tolerance: float = RANK_TOLERANCE,
) -> BaseParameters:
    """Return the base parameters of rows whose noise is white.

    The rank is the number of singular values above the tolerance. The independent columns are chosen by QR
    with pivoting within the row space, in the order that `columns` prefers as long as they are well apart.

    Args:
        triangle: (k, p) the regressor, or any rows with the same R^T R, of `whitened` for example.
        target: (k,) the rows times the true parameters, with noise.
        columns: names, sizes and order of the p columns.
        sigma: standard deviation of the noise of `target`; 1 of rows that are `whitened`.
        max_sigma: directions with a larger standard deviation, in `columns.scale`, are not determined
            (`MAX_SIGMA_KG`); inf keeps all that rounding allows.
        common_errors: (k, j) systematic errors of the target, each column one of one standard deviation
            (`systematic_errors`). They widen the covariance, and count towards `max_sigma`: two axes nearly
            parallel show parameters only by the angle between them, which may be no larger than its error.
        tolerance: singular values that are smaller shares of the largest count as zero.

    Raises:
        DataError: rows of zeros, or values that are not finite.
        ValueError: shapes that do not fit.
    """
    rows, measured = np.asarray(triangle, dtype=float), np.asarray(target, dtype=float)
    common = np.zeros((len(rows), 0)) if common_errors is None else np.asarray(common_errors, dtype=float)
    _check(rows, measured, common, len(columns.names), sigma)
    whole = spectrum(rows * columns.scale)
    error = np.hypot(sigma, np.linalg.norm(whole.left.T @ common, axis=1))
    kept = whole.determined(tolerance) & (whole.values > error / max_sigma)
    values, space = whole.values[kept], whole.directions[kept]
    chosen = _independent(space, columns.preferred)
    # x = scale * y and y = space^T (space y): beta in units of scale is (space[:, chosen])^-1 space y.
    triangular = qr(space[:, chosen])
    back = solve_triangular(triangular[1], triangular[0].T)
    inverse = back / values @ whole.left[:, kept].T
    # The covariances of noise and systematic errors add.
    spread = np.hstack([back / values * sigma, inverse @ common])
    own = columns.scale[chosen]
    grouping = own[:, None] * (back @ space) / columns.scale
    grouping[:, chosen] = np.eye(len(chosen))
    base = BaseParameters(
        columns=columns,
        independent=chosen,
        grouping=grouping,
        value=own * (inverse @ measured),
        covariance=own[:, None] * (spread @ spread.T) * own,
        share=np.sum(space**2, axis=0),
        condition=whole.condition(kept),
    )
    make_read_only(base)
    return base


def _check(rows: Array, measured: Array, common: Array, size: int, sigma: float) -> None:
    if rows.ndim != 2 or rows.shape[1] != size or measured.shape != rows.shape[:1]:
        raise ValueError(f"rows {rows.shape} and target {measured.shape} do not fit {size} named columns")
    if common.ndim != 2 or len(common) != len(rows) or not np.isfinite(common).all():
        raise ValueError(f"common errors {common.shape} must be finite, {len(rows)} rows of them")
    if not (np.isfinite(rows).all() and np.isfinite(measured).all() and sigma > 0.0):
        raise DataError("the rows or the target hold a value that is not finite, or sigma is not positive")


def _independent(space: Array, preferred: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return r independent columns (r,) of orthonormal rows (r, p), preferred ones where far enough apart."""
    rest = space.copy()
    chosen: list[int] = []

    def take(column: int) -> None:
        direction = rest[:, column] / np.linalg.norm(rest[:, column])
        rest[:] -= np.outer(direction, direction @ rest)
        chosen.append(column)

    for column in preferred:
        if np.linalg.norm(rest[:, column]) > INDEPENDENT_ABOVE:
            take(int(column))
    while len(chosen) < len(space):
        take(int(np.argmax(np.linalg.norm(rest, axis=0))))
    return np.array(sorted(chosen), dtype=np.int64)


def _term(negative: bool, size: str, names: Sequence[str]) -> str:
    sign = "-" if negative else "+"
    if size == "1":
        return " ".join(f"{sign} {name}" for name in names)
    return f"{sign} {size} {names[0]}" if len(names) == 1 else f"{sign} {size} ({' + '.join(names)})"


# For axes closer to parallel the direction of the common normal is not determined by an estimate.
_PARALLEL_BELOW = np.sin(np.radians(10.0))
# Below this distance there is no direction: estimates of axes that intersect pass each other by a few
# millimetres on either side.
_APART_M = 5e-3


def joint_frames(chain: Chain) -> Array:
    """Return the frames (n, 4, 4) at q = 0 in the root frame, read-only.

    z is the axis. If the body carries a joint, the first one counts: the origin is where the axis is nearest
    to that joint's, and x along their common normal towards it. Otherwise, and for joints on one line, the
    origin is nearest to the module's IMU and x points to it.
    """
    frames = np.tile(np.eye(4), (len(chain.serials), 1, 1))
    for i, frame in enumerate(frames):
        axis, point = chain.axis[i], chain.point[i]
        child = next(iter(chain.children(i)), None)
        normal = None if child is None else _towards(axis, point, chain.axis[child], chain.point[child])
        if normal is None:
            normal = _normal_towards(axis, point, chain.imu_home[i, :3, 3]) or (_any_normal(axis), point)
        x, origin = normal
        frame[:3, :3] = np.column_stack([x, np.cross(axis, x), axis])
        frame[:3, 3] = origin
    return read_only(frames)


def _towards(axis: Array, point: Array, other: Array, there: Array) -> tuple[Array, Array] | None:
    """Return the direction of the common normal, from the axis to another, and its foot."""
    normal = np.cross(axis, other)
    size = float(np.linalg.norm(normal))
    if size < _PARALLEL_BELOW:
        return _normal_towards(axis, point, there)
    normal = normal / size
    # point + s axis + h normal = there + t other.
    along, _, apart = np.linalg.solve(np.column_stack([axis, -other, normal]), there - point)
    return (-normal if apart < -_APART_M else normal), point + along * axis


def _normal_towards(axis: Array, point: Array, place: Array) -> tuple[Array, Array] | None:
    """Return the normal of the axis towards a place, and its foot on the axis; None for a place on it."""
    foot = point + axis * (axis @ (place - point))
    distance = float(np.linalg.norm(place - foot))
    return ((place - foot) / distance, foot) if distance > _APART_M else None


def _any_normal(axis: Array) -> Array:
    """Return a direction across an axis: along the root frame's axis that is the most across."""
    nearest = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = nearest - axis * (axis @ nearest)
    return np.asarray(across / np.linalg.norm(across))
