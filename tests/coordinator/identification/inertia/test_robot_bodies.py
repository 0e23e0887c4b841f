"""What a robot's torques and its modules' make say together is what its files and its report may claim."""

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.dynamics.pseudo_inertia import body, pseudo_inertia
from coordinator.identification.inertia.robot_bodies import RobotBodies, robot_bodies
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.physically_consistent import NotSolvedError
from module_agent.model.information import gather
from module_agent.model.regressor import inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

ROBOT = load_robot("a2085_04")


def made() -> RobotBodies:
    """Return the bodies by 2000 samples of positions and rates at random, with 5 mNm of noise."""
    chain, rng = true_chain(ROBOT), default_rng(8)
    signals = rng.uniform(-1.0, 1.0, (3, 2000, 4)) * np.array([3.0, 2.0, 10.0])[:, None, None]
    tau = inverse_dynamics(chain, true_inertia(ROBOT), *signals) + 0.005 * rng.normal(size=(2000, 4))
    information = gather(chain, *signals, tau)  # type: ignore[call-arg]
    return robot_bodies(information, chain, build_tree(ROBOT).types, solve_information(information), 1.0)


@pytest.fixture(scope="module")
def found() -> RobotBodies:
    return made()


def test_base_parameters_are_within_their_deviations_of_the_built_robots(found: RobotBodies) -> None:
    pairs = zip(found.frames, true_inertia(ROBOT), strict=True)
    truth = np.concatenate([in_frame(frame, phi) for frame, phi in pairs])
    pulls = (found.base.value - found.base.grouping @ truth) / found.base.sigma
    assert found.base.rank == 22
    assert np.abs(pulls).max() < 4.0
    for verdict, true in zip(found.identifiabilities, truth, strict=True):
        # An identified parameter is the body's own, not a sum; that of the prior's help is near it.
        if verdict.kind == "identified":
            assert verdict.value is not None
            assert verdict.sigma is not None
            assert abs(verdict.value - true) < 4.0 * verdict.sigma
    kinds = {verdict.kind for verdict in found.identifiabilities}
    assert kinds == {"identified", "weak", "not identifiable"}


def in_frame(home: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return parameters (10,) in the frame at `home`, by the body's own mass, centre and inertia."""
    one = body(pseudo_inertia(phi))
    turn = home[:3, :3]
    centre = turn.T @ (one.com_m - home[:3, 3])
    about = turn.T @ one.inertia_kg_m2 @ turn
    about += one.mass_kg * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[one.mass_kg], one.mass_kg * centre, about[np.triu_indices(3)]])


def test_the_bodies_are_near_those_that_were_built(found: RobotBodies) -> None:
    assert found.fit is not None
    for one, phi in zip(found.bodies, true_inertia(ROBOT), strict=True):
        true = body(pseudo_inertia(phi))
        # Torques leave the share of neighbours open, which the catalogue knows to some tens of percent.
        assert one.mass_kg == pytest.approx(true.mass_kg, rel=0.5, abs=0.01)
        a, b, c = np.linalg.eigvalsh(one.inertia_kg_m2)
        assert 0.0 < a <= b <= c < a + b
    total = sum(one.mass_kg for one in found.bodies)
    assert total == pytest.approx(true_inertia(ROBOT)[:, 0].sum(), rel=0.15)


def test_a_line_says_how_many_sums_are_known_and_one_a_body_which(found: RobotBodies) -> None:
    lines = found.summary()
    assert lines[0].startswith("22 base parameters of 40 parameters, ")
    assert [line.split(":")[0] for line in lines[1:]] == [
        f"body {i + 1}, turned by {serial}" for i, serial in enumerate(ROBOT.serials)
    ]
    # Each of the 40 parameters is named once.
    assert sum(line.count(",") - 1 + len(line.split(";")) for line in lines[1:]) == 40


def test_without_real_bodies_the_rest_is_said_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise NotSolvedError("no real bodies were found")

    monkeypatch.setattr("coordinator.identification.inertia.robot_bodies.fit_physical", fails)
    one = made()
    assert one.fit is None
    assert one.bodies == ()
    assert one.note.startswith("no real bodies were found; the files have the consistent bodies nearest")
    assert one.base.rank == 22
    # Nothing is settled by a prior that was not used.
    assert all(
        verdict.base_parameters == () or verdict.value is not None or verdict.lumped_with
        for verdict in one.identifiabilities
    )
    assert not any("by the prior" in verdict.summary for verdict in one.identifiabilities)
