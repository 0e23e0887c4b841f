"""Columns of the drives: what each adds to a joint's torque, and nothing to the others'."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import ArrayLike

from coordinator.dynamics.drive_model import DriveColumn, drive_columns, drive_regressor, drive_signals
from module_agent.model.chain import Array
from module_agent.signals.torque_terms import DRIVE_TERMS


def matrix(columns: Sequence[DriveColumn], qd: Array, qdd: Array, slow: ArrayLike) -> Array:
    return drive_regressor(columns, drive_signals(columns, qd, qdd, slow), qd.shape[1])


def test_a_motor_that_turns_with_the_sum_of_two_joints_takes_the_power_that_it_loses(rng: Generator) -> None:
    columns = (DriveColumn("viscous", (1, 2)), DriveColumn("coulomb", (1, 2)))
    qd = rng.normal(size=(50, 3))
    torque = matrix(columns, qd, np.zeros_like(qd), np.full(3, 1e-3)) @ np.array([0.3, 0.7])
    speed = qd[:, 1] + qd[:, 2]
    # Speeds are thousands of times the slow one: the hyperbolic tangent is the sign but for a few samples.
    lost = 0.3 * speed**2 + 0.7 * np.abs(speed)
    np.testing.assert_allclose(np.sum(torque * qd, axis=1), lost, atol=1e-3)
    assert not torque[:, 0].any()


def test_a_joint_at_rest_has_no_friction_however_its_encoder_shivers(rng: Generator) -> None:
    shiver = 1e-4 * rng.normal(size=(100, 1))
    columns = drive_columns(1, ["viscous", "coulomb", "curved"])
    torque = matrix(columns, shiver, np.zeros_like(shiver), [0.05])
    # tanh(4 sigma of shiver / slow) is below 0.01, and each parameter is one.
    assert np.abs(torque).max() < 0.01


def test_reflected_inertia_is_torque_per_acceleration_and_an_offset_is_constant(rng: Generator) -> None:
    qd, qdd = rng.normal(size=(2, 9, 2))
    found = matrix(drive_columns(2, ["inertia", "offset"]), qd, qdd, [0.1, 0.1])
    np.testing.assert_array_equal(found[:, 0, 0], qdd[:, 0])
    np.testing.assert_array_equal(found[:, 1, 2], qdd[:, 1])
    np.testing.assert_array_equal(found[:, 0, 1], np.ones(9))
    assert not found[:, 0, 2:].any()
    assert not found[:, 1, :2].any()


def test_every_term_may_be_left_out_and_names_say_which_joints_share_a_drive() -> None:
    names = [column.name for column in drive_columns(2, ["viscous", "offset"], [(0, 1)])]
    assert names == ["Fv1", "offset1", "Fv2", "offset2", "Fv1+2"]
    assert drive_columns(3, []) == ()
    assert len(drive_columns(3, DRIVE_TERMS)) == 3 * len(DRIVE_TERMS)


@pytest.mark.parametrize(
    ("terms", "coupled", "words"),
    [
        (["stiction"], [], "term 'stiction' is unknown or given twice; known are inertia, viscous"),
        (["viscous", "viscous"], [], "term 'viscous' is unknown or given twice"),
        (["viscous"], [(1, 1)], "joints 2 and 2 cannot share a drive; two different joints of 1 to 3"),
        (["viscous"], [(0, 3)], "joints 1 and 4 cannot share a drive"),
    ],
)
def test_terms_and_pairs_that_do_not_exist_are_refused(
    terms: list[str], coupled: list[tuple[int, int]], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        drive_columns(3, terms, coupled)


def test_a_slow_speed_of_zero_is_refused(rng: Generator) -> None:
    qd = rng.normal(size=(5, 2))
    with pytest.raises(ValueError, match="n positive numbers are needed"):
        drive_signals(drive_columns(2), qd, qd, [0.1, 0.0])
    with pytest.raises(ValueError, match=r"signals \(5, 2\) do not fit 8 columns"):
        drive_regressor(drive_columns(2), qd, 2)
