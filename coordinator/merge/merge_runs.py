"""Merge the torque information of several runs with the same modules in different assemblies.

Each run's whitened rows are transformed from bodies to module parts (`module_parts`) and stacked. For
Gaussian errors this is a sufficient statistic; the order does not matter. The error of a chain belongs to
its run, and moves the parts with their IMUs. The scale of a torque sensor belongs to its module in all runs:
it is one more unknown, whose prior counts once. Every run counts once too; it is recognised by its recording.

The covariance of a run is taken as it is. An offset of a torque sensor that a run fitted as the first moment
of a light body is not in it; the inconsistency with other runs (`inconsistency_sigma`) shows it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from coordinator.merge.information_file import RunInformation
from coordinator.parameter_fit.base_parameters import BaseParameters, Columns, base_parameters, whitened
from coordinator.parameter_fit.module_parts import Part, bodies_from_parts, part_columns, parts_of
from coordinator.parameter_fit.spectrum import ESTIMATED_CHAIN_TOLERANCE, MAX_SIGMA_KG, spectrum
from coordinator.parameter_fit.systematic_errors import body_shifts, whitened_effects
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only

# Simulated torques without noise would have infinite weight.
_MIN_SIGMA_NM = 1e-9


class MergeError(DataError):
    """Runs that cannot be merged, or together determine no more than each by itself."""


class RunShare(NamedTuple):
    """One run by itself, and its share in the merged runs.

    base: the base parameters of the parts by itself. sigma_alone, sigma_merged: (rank,) standard deviations
    of the same combinations by itself and merged. inconsistency_sigma: difference of the merged values from
    its own in its own standard deviations, root mean square; at most 1 by noise alone.
    """

    name: str
    serials: tuple[str, ...]
    base: BaseParameters
    sigma_alone: Array
    sigma_merged: Array
    inconsistency_sigma: float

    @property
    def gain(self) -> float:
        """The median over its combinations of sigma merged over sigma alone."""
        return float(np.median(self.sigma_merged / self.sigma_alone))


class MergedInformation(NamedTuple):
    """All runs merged: the base parameters of `parts`, and every run's share."""

    parts: tuple[Part, ...]
    base: BaseParameters
    runs: tuple[RunShare, ...]

    @property
    def gain(self) -> float:
        """The median over the combinations of all runs of sigma merged over sigma alone."""
        return float(np.median(np.concatenate([run.sigma_merged / run.sigma_alone for run in self.runs])))


def merge_runs(
    runs: Sequence[RunInformation], tolerance: float = ESTIMATED_CHAIN_TOLERANCE
) -> MergedInformation:
    """Return the base parameters of module parts that runs determine together.

    Singular values below the share `tolerance` of the largest count as zero; the default is for chains that
    were themselves estimated.

    Raises:
        MergeError: no runs, the same run twice, or runs with no module in common.
    """
    _check(runs)
    parts = parts_of(run.chain for run in runs)
    columns = part_columns(parts)
    scales = _scale_sigmas(runs)
    rows = [_rows(run, parts, scales) for run in runs]
    merged = _without_scales(rows, len(scales))
    shares = []
    for run, one in zip(runs, rows, strict=True):
        own = _without_scales([one], len(scales))
        base = _base(*own, columns, tolerance)
        _, sigma_alone = _combinations(base, *own)
        value, sigma_merged = _combinations(base, *merged)
        inconsistency_sigma = float(np.sqrt(np.mean(((value - base.value) / base.sigma) ** 2)))
        shares.append(
            RunShare(run.name, run.chain.serials, base, sigma_alone, sigma_merged, inconsistency_sigma)
        )
    return MergedInformation(parts, _base(*merged, columns, tolerance), tuple(shares))


def _check(runs: Sequence[RunInformation]) -> None:
    if not runs:
        raise MergeError("no runs to merge")
    known: dict[str, str] = {}
    for run in runs:
        if run.session in known:
            raise MergeError(
                f"the runs {known[run.session]} and {run.name} are of the same recording, which counts once: "
                "give each run once"
            )
        known[run.session] = run.name
    if not set.intersection(*(set(run.chain.serials) for run in runs)):
        raise MergeError(f"the runs {', '.join(run.name for run in runs)} have no module in common")


def _scale_sigmas(runs: Sequence[RunInformation]) -> dict[str, float]:
    """Return the prior of every module's torque scale, the smallest sigma that a run was given."""
    sigmas: dict[str, float] = {}
    for run in runs:
        for serial in run.chain.serials:
            sigmas[serial] = min(sigmas.get(serial, np.inf), run.scale_sigma)
    return dict(sorted(sigmas.items()))


def _rows(run: RunInformation, parts: Sequence[Part], scales: Mapping[str, float]) -> Array:
    """Return a run's whitened rows [scales | parts | target]; scales are in standard deviations.

    The reading z0 of the torque r phi = (1 + s) z0 was corrected to z = (1 + v) z0, so that
    z - v z0 = r phi - s z0. In both places z0 is predicted by the run's own parameters: with measured
    readings their noise would bias all scales towards zero.
    """
    sigma = np.maximum(run.sigma_nm, _MIN_SIGMA_NM)
    rows, target = whitened(run.joints, sigma, run.independent_fraction)
    of_chain = whitened_effects(run.effects, sigma, run.independent_fraction)
    of_chain = of_chain + rows @ body_shifts(run.chain, run.directions, run.phi_parts)
    counts = [len(joint.z) for joint in run.joints]
    scale, serials = np.repeat(run.scale, counts), np.repeat(run.chain.serials, counts)
    own = rows @ (bodies_from_parts(run.chain, parts_of([run.chain])) @ run.phi_parts)
    shown = own / (1.0 + scale)
    known = np.diag(list(scales.values()))
    place = {serial: k for k, serial in enumerate(scales)}
    of_scale = -shown[:, None] * known[[place[serial] for serial in serials]]
    over_parts = rows @ bodies_from_parts(run.chain, parts)
    target = target - scale * shown
    return _without(np.column_stack([of_chain, of_scale, over_parts, target]), of_chain.shape[1])


def _without_scales(rows: Sequence[Array], scales: int) -> tuple[Array, Array]:
    """Return rows over the parts and their target, with the common scales of the runs eliminated."""
    reduced = _without(np.vstack(rows), scales)
    return reduced[:, :-1], reduced[:, -1]


def _without(rows: Array, count: int) -> Array:
    """Eliminate the first unknowns, whose priors are 0 +- 1, from rows.

    The priors are further rows; below the rows of the eliminated unknowns QR leaves the information about all
    others (Bierman 1977, Factorization methods for discrete sequential estimation, ch. 6).
    """
    known = np.eye(count, rows.shape[1])
    triangle = qr(np.vstack([known, rows]), mode="r", check_finite=False)[0]
    return np.asarray(triangle[count : rows.shape[1], count:])


def _base(rows: Array, target: Array, columns: Columns, tolerance: float) -> BaseParameters:
    return base_parameters(rows, target, columns, max_sigma=MAX_SIGMA_KG, tolerance=tolerance)


def _combinations(base: BaseParameters, rows: Array, target: Array) -> tuple[Array, Array]:
    """Return values and standard deviations (r,) of the combinations in base parameters by other rows.

    The prior of every parameter is 0 +- `MAX_SIGMA_KG`. Without it, combinations that two runs share up to
    the errors of their chains would be told apart by these errors.
    """
    whole = spectrum(rows * base.columns.scale)
    along = (base.grouping * base.columns.scale) @ whole.directions.T
    square = whole.values**2 + MAX_SIGMA_KG**-2
    sigma = np.linalg.norm(along / np.sqrt(square), axis=1)
    return along @ (whole.values / square * (whole.left.T @ target)), read_only(sigma)
