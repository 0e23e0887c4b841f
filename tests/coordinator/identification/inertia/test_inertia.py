"""A signal appended to rows that were gathered before gives the same as a column gathered with them."""

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from coordinator.identification.inertia.inertia import ProjectedRows
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation, compress, merge_joint

COLUMNS, EFFECTS = 14, 3


@pytest.fixture
def rng() -> Generator:
    return default_rng(3)


def stretch(rng: Generator, samples: int) -> tuple[Array, Array, Array, Array]:
    """Rows of which three columns are sums of others and one is zero; torques, departures, effects."""
    rows = rng.normal(size=(samples, COLUMNS)) * 10.0 ** rng.uniform(-3.0, 1.0, COLUMNS)
    rows[:, 9:12] = rows[:, :3] + rows[:, 3:6]
    rows[:, 13] = 0.0
    torque, departure = rng.normal(size=(2, samples))
    return rows, torque, 0.1 * departure, rng.normal(size=(samples, EFFECTS))


def gathered(rows: Array, torque: Array) -> JointInformation:
    return compress(rows[:, None], torque[:, None])[0]


def fit(rows: Array, target: Array) -> Array:
    """What the rows tell of their columns: the smallest solution, columns of one size."""
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(rows / size, target, rcond=1e-9)[0])


def test_estimates_and_what_errors_do_to_them_are_those_of_all_samples(rng: Generator) -> None:
    parts = [stretch(rng, samples) for samples in (60, 45)]
    total = merge_joint(*(gathered(rows, torque) for rows, torque, *_ in parts))
    projected = ProjectedRows(total)
    for part in parts:
        projected.add(*part)
    found = projected.rows()
    rows, torque, departure, effects = (np.concatenate(each) for each in zip(*parts, strict=True))
    own, target = found.r[:, :COLUMNS], found.z
    np.testing.assert_allclose(fit(own, target), fit(rows, torque - departure), rtol=1e-8, atol=1e-10)
    for k in range(EFFECTS):
        moved = fit(own, found.r[:, COLUMNS + k])
        np.testing.assert_allclose(moved, fit(rows, effects[:, k]), rtol=1e-8, atol=1e-10)
    # And what no parameters explain.
    misfit = torque - departure - rows @ np.linalg.lstsq(rows, torque - departure, rcond=1e-9)[0]
    left = target - own @ np.linalg.lstsq(own, target, rcond=1e-9)[0]
    assert left @ left + found.rest == pytest.approx(misfit @ misfit, rel=1e-8)


def test_with_nothing_projected_them_rows_are_as_they_were(rng: Generator) -> None:
    rows, torque, _, effects = stretch(rng, 40)
    before = gathered(rows, torque)
    projected = ProjectedRows(before)
    projected.add(rows, torque, np.zeros(40), effects[:, :0])
    found = projected.rows()
    np.testing.assert_array_equal(found.r, before.r)
    np.testing.assert_array_equal(found.z, before.z)
    assert found.rest == pytest.approx(before.rest, rel=1e-9)
