"""What several runs with the same modules say together, however the modules were put together for each.

Every run's rows, in standard deviations of what they err by, are taken from its bodies to the parts that
those are made of (`dynamics.parts`) and stacked: of Gaussian errors that is all that there is to know, in any
order. An error of a chain is one of its run, and moves the parts with their IMUs. The scale of a torque
sensor is its module's own in every run, however often that is put together anew: it is one more unknown of
all runs, of which what is known beforehand counts once. So does every run, which its recording is known by.

What a run claims is taken as claimed. An offset of a torque sensor that it took for the first moment of a
light body is not one of these errors; runs that know that body better show it (`inconsistency_sigma`).
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

# Torques without noise, as a simulation may have them, would weigh infinitely.
_MIN_SIGMA_NM = 1e-9


class MergeError(DataError):
    """Runs that cannot be merged, or together determine no more than each by itself."""


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
    inconsistency_sigma: float

    @property
    def gain(self) -> float:
        """The median over its combinations of sigma merged over sigma alone."""
        return float(np.median(self.sigma_merged / self.sigma_alone))


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
        shares.append(_share(run, _base(*own, columns, tolerance), own, merged))
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
    """Return what is known beforehand of every module's torque sensor, by the best that any run was told."""
    sigmas: dict[str, float] = {}
    for run in runs:
        for serial in run.chain.serials:
            sigmas[serial] = min(sigmas.get(serial, np.inf), run.scale_sigma)
    return dict(sorted(sigmas.items()))


def _of_rows(run: RunInformation, of_joints: Array) -> Array:
    """Return for every row what its joint has."""
    return np.asarray(np.repeat(of_joints, [len(piece.z) for piece in run.joints]))


def _rows(run: RunInformation, parts: Sequence[Part], scales: Mapping[str, float]) -> Array:
    """Return a run's rows [scales | parts | target], their errors white; scales are in deviations.

    A sensor that shows z0 of the torque r phi = (1 + s) z0 was taken to show z0 = z / (1 + v), so that
    z - v z0 = r phi - s z0. In both places z0 is what the run's own parameters say that it shows: readings
    would bring their noise along, and all scales come out too small.
    """
    sigma = np.maximum(run.sigma_nm, _MIN_SIGMA_NM)
    rows, target = whitened(run.joints, sigma, run.independent_fraction)
    of_chain = whitened_effects(run.effects, sigma, run.independent_fraction)
    of_chain = of_chain + rows @ body_shifts(run.chain, run.directions, run.phi_parts)
    own = rows @ (bodies_from_parts(run.chain, parts_of([run.chain])) @ run.phi_parts)
    shown = own / (1.0 + _of_rows(run, run.scale))
    known = np.diag(list(scales.values()))
    place = {serial: k for k, serial in enumerate(scales)}
    of_scale = (
        -shown[:, None] * known[[place[serial] for serial in _of_rows(run, np.array(run.chain.serials))]]
    )
    over_parts = rows @ bodies_from_parts(run.chain, parts)
    target = target - _of_rows(run, run.scale) * shown
    return _without(np.column_stack([of_chain, of_scale, over_parts, target]), of_chain.shape[1])


def _without_scales(rows: Sequence[Array], scales: int) -> tuple[Array, Array]:
    """Return rows over the parts and their target of runs whose sensors' scales are the same."""
    reduced = _without(np.vstack(rows), scales)
    return reduced[:, :-1], reduced[:, -1]


def _without(rows: Array, count: int) -> Array:
    """Return rows without their first columns, unknowns of which one deviation is 1.

    What is known of those beforehand are rows more, and QR leaves below their own rows what is told of all
    else whatever they are (Bierman 1977, Factorization methods for discrete sequential estimation, ch. 6).
    """
    known = np.eye(count, rows.shape[1])
    triangle = qr(np.vstack([known, rows]), mode="r", check_finite=False)[0]
    return np.asarray(triangle[count : rows.shape[1], count:])


def _base(rows: Array, target: Array, columns: Columns, tolerance: float) -> BaseParameters:
    return base_parameters(rows, target, columns, max_sigma=MAX_SIGMA_KG, tolerance=tolerance)


def _share(
    run: RunInformation, own: BaseParameters, alone: tuple[Array, Array], merged: tuple[Array, Array]
) -> RunShare:
    """Compare a run's base parameters by its own rows and target with those of all runs."""
    _, sigma_alone = _combinations(own, *alone)
    value, sigma_merged = _combinations(own, *merged)
    inconsistency_sigma = float(np.sqrt(np.mean(((value - own.value) / own.sigma) ** 2)))
    return RunShare(
        name=run.name,
        serials=run.chain.serials,
        base=own,
        sigma_alone=sigma_alone,
        sigma_merged=sigma_merged,
        inconsistency_sigma=inconsistency_sigma,
    )


def _combinations(base: BaseParameters, rows: Array, target: Array) -> tuple[Array, Array]:
    """Return values and standard deviations (r,) of the combinations in base parameters by other rows.

    The prior of every parameter is 0 +- `MAX_SIGMA_KG`. Without it, combinations that two runs share up to
    the errors of their chains would be told apart by these errors.
    """
    whole = spectrum(rows * base.columns.scale)
    along = (base.grouping * base.columns.scale) @ whole.directions.T
    square = whole.values**2 + MAX_SIGMA_KG**-2
    sigma = np.linalg.norm(along / np.sqrt(square), axis=1)
    sigma.flags.writeable = False
    return along @ (whole.values / square * (whole.left.T @ target)), sigma
