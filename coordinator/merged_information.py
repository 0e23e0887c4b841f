"""What several runs with the same modules say together, however the modules were put together for each.

Every run's rows, in standard deviations of what they err by, are taken from its bodies to the parts that
those are made of (`dynamics.parts`) and stacked: of Gaussian errors that is all that there is to know, in any
order. An error of a chain is one of its run; and so are errors of the torque sensors' scales taken to be.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from coordinator.dynamics.base_parameters import BaseParameters, Columns, base_parameters, whitened
from coordinator.dynamics.common_errors import whitened_effects
from coordinator.dynamics.identification import ESTIMATED_CHAIN_TOLERANCE, MAX_SIGMA_KG
from coordinator.dynamics.parts import Part, bodies_from_parts, part_columns, parts_of
from coordinator.information_file import RunInformation
from module_agent.dynamics.chain import Array

# Torques without noise, as a simulation may have them, would weigh infinitely.
_LEAST_SIGMA_NM = 1e-9


class RunShare(NamedTuple):
    """One run by itself and within the whole.

    base: what it tells of the parts by itself. sigma_alone, sigma_merged: (rank,) standard deviations of the
    same combinations by itself and by all runs together. strain: by how many of the run's own standard
    deviations what all say of them is off from what it says, root mean square. Noise alone makes at most 1.
    """

    name: str
    serials: tuple[str, ...]
    base: BaseParameters
    sigma_alone: Array
    sigma_merged: Array
    strain: float

    @property
    def gain(self) -> float:
        """The median over its combinations of sigma merged over sigma alone."""
        return float(np.median(self.sigma_merged / self.sigma_alone))


class _Spectrum(NamedTuple):
    """All rows: singular values (k,), right singular vectors (k, p), the target along the left ones (k,)."""

    values: Array
    directions: Array
    along: Array


class MergedInformation(NamedTuple):
    """All runs together: base parameters of `parts`, and every run's share."""

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
    """Return what runs say together of the parts that their robots were made of.

    Args:
        runs: at least one, each a robot of some of the modules.
        tolerance: singular values below this share of the largest are not told by the torques; the default is
            for chains that were themselves estimated.

    Raises:
        ValueError: no runs, or runs with no module in common: together they say no more than each by itself.
    """
    if not runs:
        raise ValueError("no runs to merge")
    shared = set.intersection(*(set(run.chain.serials) for run in runs))
    if not shared:
        raise ValueError(f"the runs {', '.join(run.name for run in runs)} have no module in common")
    parts = parts_of(run.chain for run in runs)
    columns = part_columns(parts)
    rows = [_rows(run, parts) for run in runs]
    together = np.vstack([row for row, _ in rows]), np.concatenate([target for _, target in rows])
    whole, spectrum = _base(*together, columns, tolerance), _spectrum(*together, columns)
    shares = [
        _share(run, _base(*own, columns, tolerance), _spectrum(*own, columns), spectrum)
        for run, own in zip(runs, rows, strict=True)
    ]
    return MergedInformation(parts, whole, tuple(shares))


def _rows(run: RunInformation, parts: Sequence[Part]) -> tuple[Array, Array]:
    """Return the rows of a run over the parts, and their target, with errors that are white."""
    sigma = np.maximum(run.sigma_nm, _LEAST_SIGMA_NM)
    rows, target = whitened(run.joints, sigma, run.independent_fraction)
    effects = whitened_effects(run.effects, sigma, run.independent_fraction)
    # Noise and the errors that come as a whole: I + E E^T = L L^T, and L^-1 makes them white.
    lower = cholesky(np.eye(len(rows)) + effects @ effects.T, lower=True)
    white = solve_triangular(lower, np.column_stack([rows, target]), lower=True)
    return white[:, :-1] @ bodies_from_parts(run.chain, parts), white[:, -1]


def _base(rows: Array, target: Array, columns: Columns, tolerance: float) -> BaseParameters:
    return base_parameters(rows, target, columns, max_sigma=MAX_SIGMA_KG, tolerance=tolerance)


def _spectrum(rows: Array, target: Array, columns: Columns) -> _Spectrum:
    left, values, directions = np.linalg.svd(rows * columns.scale, full_matrices=False)
    return _Spectrum(values, directions, left.T @ target)


def _share(run: RunInformation, own: BaseParameters, alone: _Spectrum, whole: _Spectrum) -> RunShare:
    sums = own.grouping * own.columns.scale
    _, sigma_alone = _of(sums, alone)
    value, sigma_merged = _of(sums, whole)
    strain = float(np.sqrt(np.mean(((value - own.value) / own.sigma) ** 2)))
    return RunShare(run.name, run.chain.serials, own, sigma_alone, sigma_merged, strain)


def _of(sums: Array, told: _Spectrum) -> tuple[Array, Array]:
    """Return values and standard deviations of sums (r, p) of parameters in kg.

    Every parameter is zero to `MAX_SIGMA_KG` beforehand. Sums that two runs have in common, but for errors of
    their chains, would otherwise be told apart by those.
    """
    along = sums @ told.directions.T
    square = told.values**2 + MAX_SIGMA_KG**-2
    sigma = np.linalg.norm(along / np.sqrt(square), axis=1)
    sigma.flags.writeable = False
    return along @ (told.values / square * told.along), sigma
