"""Agents' information is taken if it is the factor of the coordinator's rows along a random direction."""

import numpy as np
import pytest

from coordinator.identification.inertia.agent_information import (
    AGREES_BELOW,
    Answers,
    compared,
    difference,
    products,
)
from module_agent.model.information import JointInformation, compress

RNG = np.random.default_rng(5)
# Of two joints: columns of very different sizes, as those of masses and inertias.
ROWS = RNG.standard_normal((400, 2, 24)) * np.logspace(0.0, -3.0, 24)
TORQUE = RNG.standard_normal((400, 2))
FIRST, SECOND = compress(ROWS, TORQUE)
OWN = {k: products(ROWS[:, k], TORQUE[:, k]) for k in range(2)}


def test_a_factor_of_the_rows_agrees_to_rounding_also_when_they_come_in_pieces() -> None:
    assert difference(FIRST, OWN[0]) < 1e-3 * AGREES_BELOW
    pieces = products(ROWS[:150, 0], TORQUE[:150, 0]).plus(products(ROWS[150:, 0], TORQUE[150:, 0]))
    assert difference(FIRST, pieces) < 1e-3 * AGREES_BELOW


@pytest.mark.parametrize(
    "wrong",
    [
        FIRST._replace(r=FIRST.r * (1.0 + 1e-9)),
        FIRST._replace(r=np.where(np.arange(24) == 3, FIRST.r * (1.0 + 1e-6), FIRST.r)),
        FIRST._replace(z=FIRST.z * (1.0 + 1e-9)),
        FIRST._replace(rest=FIRST.rest * (1.0 + 1e-8)),
        FIRST._replace(samples=399),
        FIRST._replace(r=FIRST.r[:, :20]),
        SECOND,
    ],
    ids=["rows", "a column", "torque", "rest", "samples", "fewer columns", "another joint"],
)
def test_another_computation_is_noticed(wrong: JointInformation) -> None:
    assert difference(wrong, OWN[0]) > AGREES_BELOW


def test_what_agrees_is_taken_and_the_rest_is_named() -> None:
    asked = Answers({0: FIRST, 1: FIRST}, ("C: 0 of ? bytes of its answer have come",))
    good, report = compared(asked, OWN, ("A", "B", "C"))
    assert good == {0: FIRST}
    assert report.by_agents == ("A",)
    assert report.difference == pytest.approx(difference(FIRST, OWN[1]))
    assert "B: its own differs by" in report.note
    assert "C: 0 of ? bytes" in report.note
    assert compared(Answers({}, ()), {}, ("A",))[1] == ((), None, "")
