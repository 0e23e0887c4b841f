"""How the readings of an IMU change with the chain: the derivatives of `imu_prediction`.

A perturbation xi of module a makes the turn exp(S q) of its joint into exp(xi) exp(S q) exp(-xi). So all that
lies beyond the joint is displaced by xi in the frame of the body below, and by -xi in that of the body
beyond; the module's own IMU is displaced by xi in the frame of its carrier. All that is needed is the change
of one IMU's readings when it is displaced, together with everything between, by a twist in the frame of some
body that carries it: a constant one, or, of links and joints that turn more than they should, one that
changes with time.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.batch_estimation.imu_kernel import LANES, KernelDisplacements, Path, fill_slopes
from coordinator.batch_estimation.imu_prediction import BodyMotion, stacked
from module_agent.model.chain import Array, Chain

Index = NDArray[np.int64]

# Places whose slopes by a hundred parameters, one MB, stay in a core's cache.
BLOCK = 4 * LANES


class ImuJacobian(NamedTuple):
    """Slopes of one IMU's readings [gyro (3), specific force (3)] in its own frame.

    modules: k modules on whose perturbations it depends, in the order of the chain. poses: (6 k, 6, m) slopes
    by the perturbations (`apply_perturbation`) of those modules. gravity: (3, 6, m) slopes by
    `chain.gravity`. placement: (6, 6, m) slopes by the IMU's own turn and displacement in its own frame.
    """

    modules: tuple[int, ...]
    poses: Array
    gravity: Array
    placement: Array


class Displacements(NamedTuple):
    """Small displacements that change with time, each of everything beyond a link or a joint.

    modules: (p,) the modules of these links and joints. of_joint: (p,) whether it is the joint: the housing
    that a link carries moves with the link, and only with the joint if it is mounted reversed.
    maps: (p, 6, 6) from six signals of its cause to turn [rad] and shift [m] in the frame of the body below.
    cause: (p,) which one that is. causes: (s, 18, m) the signals of all, their first and their second time
    derivatives.
    """

    modules: tuple[int, ...]
    of_joint: tuple[bool, ...]
    maps: Array
    cause: tuple[int, ...]
    causes: Array

    @classmethod
    def by_twists(
        cls, modules: tuple[int, ...], of_joint: tuple[bool, ...], twists: Array
    ) -> "Displacements":
        """Return displacements by themselves: (p, 18, m) turns and shifts with their derivatives."""
        alike = np.tile(np.eye(6), (len(modules), 1, 1))
        return cls(modules, of_joint, alike, tuple(range(len(modules))), twists)

    def joined(self, other: "Displacements") -> "Displacements":
        """Return these and then the others."""
        return Displacements(
            self.modules + other.modules,
            self.of_joint + other.of_joint,
            np.concatenate([self.maps, other.maps]),
            self.cause + tuple(len(self.causes) + one for one in other.cause),
            np.concatenate([self.causes, other.causes]),
        )


class SeenDisplacements(NamedTuple):
    """Those displacements that one IMU sees: their numbers, from the root on, and `fill_slopes`'s `first`."""

    numbers: Index
    first: Index


class Motion(NamedTuple):
    """The motion of a chain as the kernels take it: m' samples, a multiple of theirs, the last one repeated.

    bodies: (n + 1, 9, m'). signals: (3, n, m') sine and cosine of the joints' positions, and their rates.
    """

    bodies: Array
    signals: Array


def kernel_motion(bodies: Sequence[BodyMotion], q_rad: Array, qd_rad_s: Array) -> Motion:
    """Return bodies (`body_motions`) and joints (m, n) as the kernels take them."""
    signals = np.stack([np.sin(q_rad.T), np.cos(q_rad.T), qd_rad_s.T])
    return Motion(padded(stacked(bodies)), padded(signals))


def padded(signals: Array) -> Array:
    """Return signals (..., m) as the kernels take them, the last sample repeated to a multiple of theirs."""
    samples = signals.shape[-1]
    missing = -samples % LANES
    return np.concatenate([signals, np.repeat(signals[..., -1:], missing, axis=-1)], axis=-1)


def kernel_displacements(some: Displacements) -> KernelDisplacements:
    """Return displacements as the kernels take them.

    What the kernels work on at a time is in one place: far apart, it takes longer to fetch than to work on.
    """
    causes = padded(some.causes)
    number, rows, places = causes.shape
    grouped = causes.reshape(number, rows, places // LANES, LANES).transpose(2, 0, 1, 3)
    return KernelDisplacements(
        np.ascontiguousarray(grouped), np.array(some.cause, dtype=np.int64), np.array(some.maps)
    )


def imu_path(chain: Chain, module: int) -> Path:
    """Return what one module's IMU depends on."""
    path = np.array(chain.ancestors(module), dtype=np.int64)
    # Copies: kernels are compiled anew for arrays that cannot be written to.
    axis, point, home = (np.array(a) for a in (chain.axis, chain.point, chain.imu_home[module]))
    return Path(path, chain.reversed[module], axis, point, home)


def seen_by(path: Path, modules: Sequence[int], of_joint: Sequence[bool]) -> SeenDisplacements:
    """Return which of some displacements, as in `Displacements`, one IMU sees."""
    own = path.modules[-1]
    each = [
        [
            p
            for p, (other, joint) in enumerate(zip(modules, of_joint, strict=True))
            if other == module and (path.turned or not joint or module != own)
        ]
        for module in path.modules.tolist()
    ]
    first = np.cumsum([0, *map(len, each)]).astype(np.int64)
    return SeenDisplacements(np.array([p for part in each for p in part], dtype=np.int64), first)


def weighted_slopes(
    path: Path,
    motion: Motion,
    displaced: KernelDisplacements,
    seen: SeenDisplacements,
    mixing: Array,
    weight: Array,
    residual: Array,
    at_once: int = BLOCK,
) -> Iterator[tuple[slice, Array, Array]]:
    """Yield the slopes of one IMU's weighted readings, zero beyond the samples, block by block.

    A block stays in the processor's cache while it is worked on; the next one takes its place.

    Args:
        path: of k modules to the IMU.
        motion: of the chain, m' places for m samples.
        displaced: the displacements, p of which the IMU has `seen`.
        mixing: (6, 6) from true rates and forces to readings.
        weight: (2, m) of gyro and accelerometer.
        residual: (6, m) of the readings.
        at_once: places in a block, a multiple of `LANES`.

    Yields:
        which of the m' places; (6 k + 3 + p + 1, 6, places) by the modules' twists, gravity and
        displacements, and in the last row the weighted residual; (6, 6, places) by the placement.
    """
    samples, places = weight.shape[1], motion.bodies.shape[2]
    weights, pulls = np.zeros((2, places)), np.zeros((6, places))
    weights[:, :samples] = weight
    pulls[:, :samples] = residual * np.repeat(weight, 3, axis=0)
    rows, mixed = 6 * len(path.modules) + 3 + len(seen.numbers) + 1, np.array(mixing)
    shared, placed = np.empty((rows, 6, 0)), np.empty((6, 6, 0))
    for begin in range(0, places, at_once):
        block = slice(begin, min(begin + at_once, places))
        if shared.shape[2] != block.stop - begin:
            shared, placed = (np.empty((size, 6, block.stop - begin)) for size in (rows, 6))
        fill_slopes(path, *motion, displaced, *seen, mixed, weights, True, begin, shared, placed)
        shared[-1] = pulls[:, block]
        yield block, shared, placed


def imu_jacobian(
    chain: Chain, motion: Motion, samples: int, module: int, mixing: Array | None = None
) -> ImuJacobian:
    """Differentiate the readings of one module's IMU.

    Args:
        chain: n joints.
        motion: of the chain, in m' places.
        samples: m of these.
        module: the module that the IMU belongs to.
        mixing: (6, 6) from true rates and forces to readings; None of a perfect IMU.
    """
    path = imu_path(chain, module)
    size = 6 * len(path.modules)
    none = Displacements.by_twists((), (), np.empty((0, 18, samples)))
    ones, zeros = np.ones((2, samples)), np.zeros((6, samples))
    mixed = np.eye(6) if mixing is None else mixing
    seen, places = seen_by(path, (), ()), motion.bodies.shape[2]
    ((_, shared, placed),) = weighted_slopes(
        path, motion, kernel_displacements(none), seen, mixed, ones, zeros, at_once=places
    )
    shared, placed = shared[..., :samples], placed[..., :samples]
    return ImuJacobian(tuple(path.modules.tolist()), shared[:size], shared[size:-1], placed)


def displaced_readings(
    chain: Chain, motion: Motion, some: Displacements, displaced: KernelDisplacements, amounts: Array
) -> Array:
    """Return by how much displacements, (p,) times their units, change all IMUs' readings, (n, 6, m').

    motion: in m' places. displaced: `some`, as `kernel_displacements` returns them.
    """
    change = np.zeros((len(chain.serials), 6, motion.bodies.shape[2]))
    if not some.modules:
        return change
    kinds = list(zip(some.modules, some.of_joint, some.cause, strict=True))
    different = sorted(set(kinds))
    maps = np.zeros((len(different), 6, 6))
    for kind, amount, one in zip(kinds, amounts, some.maps, strict=True):
        maps[different.index(kind)] += amount * one
    modules, of_joint, cause = (tuple(column) for column in zip(*different, strict=True))
    summed = KernelDisplacements(displaced.causes, np.array(cause, dtype=np.int64), maps)
    ones, none = np.ones((2, change.shape[2])), np.empty((0, 6, change.shape[2]))
    for k in range(len(chain.serials)):
        path = imu_path(chain, k)
        seen = seen_by(path, modules, of_joint)
        slopes = np.empty((len(seen.numbers), *change.shape[1:]))
        fill_slopes(path, *motion, summed, *seen, np.eye(6), ones, False, 0, slopes, none)
        change[k] = slopes.sum(axis=0)
    return change
