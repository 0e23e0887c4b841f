"""Compliant links turn as hinges do under their loads, and their compliance is estimated."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import refine_chain
from coordinator.batch_estimation.imu_prediction import (
    LinkTurn,
    acceleration_at,
    body_motions,
    given,
    imu_readings,
    readings_on,
    turned,
)
from coordinator.batch_estimation.link_compliance import (
    LINK_MASS_KG,
    LINK_MASS_KG_M,
    UNIT_RAD_NM,
    LinkLoad,
    compliance_jacobian,
    hinge_slopes,
    joined,
    link_ends,
    link_loads,
    rigid,
)
from coordinator.batch_estimation.sensor_data import SensorData
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import inverse_dynamics
from tests.random_chains import displaced

RATE_HZ = 250.0


def _swing(joints: int, seconds: float = 6.0) -> tuple[Array, Array, Array]:
    """Slow and fast swings of all joints, (m, n) each at 250 Hz."""
    t = np.arange(0, seconds, 1 / RATE_HZ)[:, None]
    phase = np.arange(joints) * 1.3
    slow, fast = 1.5 + 0.2 * phase, 11.0 + phase
    q = 0.4 * np.sin(slow * t + phase) + 0.1 * np.sin(fast * t + phase)
    qd = 0.4 * slow * np.cos(slow * t + phase) + 0.1 * fast * np.cos(fast * t + phase)
    return q, qd, -0.4 * slow**2 * np.sin(slow * t + phase) - 0.1 * fast**2 * np.sin(fast * t + phase)


def _forward(robots: Any, seed: int, joints: int) -> tuple[Chain, list[ModuleType]]:
    chain, types = robots.random(seed, joints, serial=True)
    up = np.array(chain.gravity)
    homes = np.array(chain.imu_home)
    return robots.build(list(chain.parent), [False] * joints, homes, types, up), types


def test_a_turn_of_a_link_is_that_of_a_joint_in_it(robots: Any) -> None:
    """Put a joint into the link: to first order its small turns are what a `LinkTurn` predicts."""
    chain, _ = _forward(robots, 3, 3)
    axis, place = np.array([0.6, 0.0, 0.8]), np.array([0.05, -0.1, 0.2])
    q, qd, qdd = _swing(3, 1.0)
    size = 1e-4
    angle, rate, acceleration = (size * signal[:, 0] for signal in _swing(1, 1.0))
    # The extra joint's own module carries no IMU that is looked at.
    wide = Chain(
        ("M00", "M01", "hinge", "M02"),
        (-1, 0, 1, 2),
        (False,) * 4,
        np.insert(chain.axis, 2, axis, axis=0),
        np.insert(chain.point, 2, place, axis=0),
        np.insert(chain.imu_home, 2, np.eye(4), axis=0),
        chain.gravity,
    )
    both = [
        np.insert(own, 2, turn, axis=1)
        for own, turn in zip((q, qd, qdd), (angle, rate, acceleration), strict=True)
    ]
    exact = imu_readings(wide, *both)
    turns = {2: [LinkTurn(place, np.stack([np.outer(axis, s) for s in (angle, rate, acceleration)]))]}
    found = readings_on(chain, body_motions(chain, q, qd, qdd, turns=turns), turns)
    rigid = imu_readings(chain, q, qd, qdd)
    for mine, right, stiff in zip(found, exact, rigid, strict=True):
        # The turn changes the readings, as predicted but for terms with its square.
        assert np.abs(right[:, 3] - stiff[:, 2]).max() > size
        np.testing.assert_allclose(mine[:, 2], right[:, 3], atol=100 * size**2)


def test_compiled_turns_are_those_of_the_formula_one_after_the_other(robots: Any) -> None:
    """Beyond a joint that stands at zero the body moves as the end of the link below it does."""
    chain, _ = robots.random(11, 5, serial=False)
    rng = np.random.default_rng(2)
    q, qd, qdd = (rng.normal(size=(40, 5)) for _ in range(3))
    turns = {k: [LinkTurn(*_turn(rng)), LinkTurn(*_turn(rng))] for k in chain.linked[1:]}
    for k in chain.linked:
        for signal in (q, qd, qdd):
            signal[:, k] = 0.0
    bodies = body_motions(chain, q, qd, qdd, turns=turns)
    for k in chain.linked:
        beyond = given(bodies[chain.parent[k]], turns.get(k, ()))
        for compiled, formula in zip(bodies[k], beyond, strict=True):
            np.testing.assert_allclose(compiled, formula, atol=1e-12)


def _turn(rng: np.random.Generator) -> tuple[Array, Array]:
    return 0.3 * rng.normal(size=3), 0.1 * rng.normal(size=(3, 3, 40))


def test_the_moment_about_a_joint_is_that_of_newton_and_euler(robots: Any) -> None:
    """Modules and links as point masses, by the independent regressor: the torque about a joint."""
    chain, types = _forward(robots, 5, 3)
    q, qd, qdd = _swing(3, 2.0)
    bodies = body_motions(chain, q, qd, qdd)
    loads = link_loads(chain, types, bodies, q, RATE_HZ)
    # Link 2 hangs on body 1, which carries nothing but that link and module 2, both as point masses.
    home, com = chain.imu_home[2], np.array(types[2].com_xyz) - np.array(types[2].imu_xyz)
    begin, end = link_ends(chain, types, 2)
    link_kg = LINK_MASS_KG + LINK_MASS_KG_M * float(np.linalg.norm(end - begin))
    masses = ((types[2].mass_kg, home[:3, :3] @ com + home[:3, 3]), (link_kg, 0.5 * (begin + end)))
    phi = np.zeros((3, 10))
    for mass_kg, place in masses:
        own = mass_kg * (np.eye(3) * (place @ place) - np.outer(place, place))
        phi[1] += [mass_kg, *(mass_kg * place), *own[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]]
    torque = inverse_dynamics(chain, phi, q, qd, qdd)
    load = loads[2]
    assert load is not None
    force = -sum(mass_kg * acceleration_at(bodies[1], place[:, None]) for mass_kg, place in masses)
    np.testing.assert_allclose(load.force[0], force, atol=1e-12)
    about_joint = load.moved(chain.point[1] - load.hinge).moment[0]
    np.testing.assert_allclose(-chain.axis[1] @ about_joint, torque[:, 1], atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_at_rest_a_link_carries_the_weight_of_all_modules_and_links_beyond(robots: Any, seed: int) -> None:
    """Trees with modules that are mounted reversed: masses at their places, at zero."""
    chain, types = robots.random(seed, 6, serial=False)
    still = np.zeros((20, 6))
    loads = link_loads(chain, types, body_motions(chain, still, still, still), still, RATE_HZ)
    for link in chain.linked:
        load = loads[link]
        assert load is not None
        force, moment = np.zeros(3), np.zeros(3)
        for k in chain.descendants(link):
            begin, end = link_ends(chain, types, k)
            own = np.array(types[k].com_xyz) - np.array(types[k].imu_xyz)
            place = chain.imu_home[k, :3, :3] @ own + chain.imu_home[k, :3, 3]
            link_kg = LINK_MASS_KG + LINK_MASS_KG_M * float(np.linalg.norm(end - begin))
            for mass_kg, at in ((types[k].mass_kg, place), (link_kg, 0.5 * (begin + end))):
                force -= mass_kg * chain.gravity
                moment -= mass_kg * np.cross(at - load.hinge, chain.gravity)
        np.testing.assert_allclose(load.force[0], np.tile(force, (20, 1)).T, atol=1e-9)
        np.testing.assert_allclose(load.moment[0], np.tile(moment, (20, 1)).T, atol=1e-9)
        assert np.abs(load.moment[1:]).max() < 1e-9


@pytest.mark.parametrize("seed", [4, 5])
def test_loads_and_readings_of_moving_trees_are_those_of_the_formulas(robots: Any, seed: int) -> None:
    """Modules mounted reversed, links that turn below any of them; body by body, without compiled code."""
    chain, types = robots.random(seed, 6, serial=False)
    rng = np.random.default_rng(seed)
    q, *others = 1.5 * rng.normal(size=(40, 6)), *rng.normal(size=(2, 40, 6))
    turns = {k: [LinkTurn(*_turn(rng))] for k in range(6)}
    assert any(chain.reversed)
    bodies = body_motions(chain, q, *others, turns=turns)
    loads = link_loads(chain, types, bodies, q, RATE_HZ, turns)
    ideal = readings_on(chain, bodies, turns)
    forces = [np.zeros((3, 40)) for _ in range(6)]
    for k in reversed(range(6)):
        home = chain.imu_home[k]
        beyond = given(bodies[chain.parent[k]], turns[k])
        own = bodies[k] if chain.reversed[k] else beyond
        np.testing.assert_allclose(ideal.gyro_rad_s[:, k], own.omega.T @ home[:3, :3], atol=1e-12)
        force = acceleration_at(own, home[:3, 3, None]).T @ home[:3, :3]
        np.testing.assert_allclose(ideal.accel_m_s2[:, k], force, atol=1e-11)
        com = home[:3, :3] @ (np.array(types[k].com_xyz) - np.array(types[k].imu_xyz)) + home[:3, 3]
        weight = -types[k].mass_kg * acceleration_at(own, com[:, None])
        if chain.reversed[k]:
            forces[k] = forces[k] + weight
        load = loads[k]
        if load is None:
            assert k not in chain.linked
            continue
        begin, end = link_ends(chain, types, k)
        link_kg = LINK_MASS_KG + LINK_MASS_KG_M * float(np.linalg.norm(end - begin))
        below = turned(chain.axis[k], q[:, k], forces[k])
        below -= link_kg * acceleration_at(beyond, (0.5 * (begin + end))[:, None])
        if not chain.reversed[k]:
            below += weight
        np.testing.assert_allclose(load.force[0], below, atol=1e-10)
        forces[chain.parent[k]] = forces[chain.parent[k]] + below


def test_where_a_hinge_is_hardly_changes_with_the_direction_of_its_link(robots: Any) -> None:
    """What one fit finds of it is used with the chain of the next. Links along all axes, and any other."""
    any_one = next(load for load in _still_loads(robots) if load is not None)
    rng = np.random.default_rng(1)
    for along in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
        shifts = []
        for change in rng.normal(size=(10, 3)) * 1e-6:
            direction = along + change
            shifts.append(any_one._replace(along=direction / np.linalg.norm(direction), length_m=1.0).shifts)
        assert np.ptp(shifts, axis=0).max() < 1e-4
        np.testing.assert_allclose(shifts[0] @ shifts[0].T, np.eye(3), atol=1e-12)


def _still_loads(robots: Any) -> list[LinkLoad | None]:
    chain, types = robots.random(1, 3, serial=True)
    still = np.zeros((20, 3))
    return link_loads(chain, types, body_motions(chain, still, still, still), still, RATE_HZ)


def test_loads_change_as_their_derivatives_say(robots: Any) -> None:
    chain, types = _forward(robots, 5, 4)
    q, qd, qdd = _swing(4)
    load = link_loads(chain, types, body_motions(chain, q, qd, qdd), q, RATE_HZ)[2]
    assert load is not None
    moment, rate, acceleration = load.moment[..., 50:-50]
    by_differences = np.gradient(moment, 1 / RATE_HZ, axis=1)
    np.testing.assert_allclose(by_differences[:, 1:-1], rate[:, 1:-1], rtol=0.02, atol=0.05)
    np.testing.assert_allclose(
        np.gradient(rate, 1 / RATE_HZ, axis=1)[:, 1:-1], acceleration[:, 1:-1], rtol=0.02, atol=1.0
    )


def _bent(chain: Chain, types: list[ModuleType], compliance: float, seed: int) -> tuple[SensorData, Array]:
    """What a robot reads whose links all bend; and the loads' thinned samples."""
    joints = _swing(len(types), 12.0)
    bodies = body_motions(chain, *joints)
    loads = joined([link_loads(chain, types, bodies, joints[0], RATE_HZ)], 5)
    few = tuple(signal[::5] for signal in joints)
    turns = {k: load.turns(compliance * UNIT_RAD_NM, 0.0) for k, load in enumerate(loads) if load is not None}
    seen = readings_on(chain, body_motions(chain, *few, turns=turns), turns)
    rng = np.random.default_rng(seed)
    gyro, accel = (true + rng.normal(0, s, true.shape) for true, s in zip(seen, (5e-4, 1e-2), strict=True))
    return SensorData(*few, gyro, accel), loads  # type: ignore[call-arg]


@pytest.mark.parametrize("seed", range(3))
def test_links_that_bend_come_out_as_long_as_they_are(robots: Any, seed: int) -> None:
    chain, types = _forward(robots, 20 + seed, 4)
    data, loads = _bent(chain, types, 4.0, seed)
    stiff = refine_chain(chain, data)
    flex = compliance_jacobian(loads, len(data.q_rad))
    found = refine_chain(chain, data, flex=flex)
    apart = [np.abs(one.chain.imu_home[:, :3, 3] - chain.imu_home[:, :3, 3]).max() for one in (stiff, found)]
    assert apart[1] < 0.2 * apart[0]
    # The bending of loaded links is observable; the last one's load is a module of 0.3 kg.
    bending = found.compliance[0::2]
    np.testing.assert_allclose(bending[:2], 4.0, atol=1.0)
    # And none of them twists.
    assert np.abs(found.compliance[1::2]).max() < 5.0


def test_where_a_link_bends_is_a_share_of_its_length(robots: Any) -> None:
    """Readings of links that bend at their clamps differ from the model's by the hinges' slopes."""
    chain, types = _forward(robots, 21, 3)
    data, loads = _bent(chain, types, 4.0, 0)
    flex = compliance_jacobian(loads, len(data.q_rad))
    known = hinge_slopes(loads, len(data.q_rad), np.full(len(flex.links), 4.0))
    assert known.links[len(flex.links) :] == (1, 1, 1, 2, 2, 2)
    still = readings_on(chain, body_motions(chain, *data.joints))
    load = loads[1]
    assert load is not None
    # Four units of bending and of twisting; the hinge 7 % of the length further, 8 mm to one side.
    share, aside_m = 0.07, 0.008
    there = load.moved(share * load.shifts[0] + aside_m * load.shifts[1])
    turns = {1: there.turns(4.0 * UNIT_RAD_NM, 4.0 * UNIT_RAD_NM)}
    moved = readings_on(chain, body_motions(chain, *data.joints, turns=turns), turns)
    amounts = np.zeros(len(known.links))
    amounts[:2], amounts[len(flex.links) : len(flex.links) + 2] = 4.0, (share, aside_m)
    by_slopes = displaced(chain, data.joints, known.carried, amounts)[:, 3:]
    np.testing.assert_allclose(
        # What goes with the squares of turn and shift is left out: some hundredths of the shifts' share.
        (moved.accel_m_s2 - still.accel_m_s2).transpose(1, 2, 0),
        by_slopes,
        atol=1e-2 * float(np.abs(by_slopes).max()),
    )


def test_a_link_leads_from_the_parents_face_to_its_own(robots: Any) -> None:
    """Tubes end where modules begin: a straight link's length is that between the faces."""
    chain, types = robots.random(11, 5, serial=True)
    for module in range(1, 5):
        begin, end = link_ends(chain, types, module)
        parent = chain.parent[module]
        # The parent's distal face lies on its axis, and the child's side of the link on the child's.
        for place, k in ((begin, parent), (end, module)):
            off = place - chain.point[k]
            assert np.linalg.norm(np.cross(chain.axis[k], off)) < 1e-12


def test_a_robot_without_links_has_nothing_that_bends(robots: Any) -> None:
    chain, types = _forward(robots, 1, 1)
    joints = _swing(1, 1.0)
    loads = link_loads(chain, types, body_motions(chain, *joints), joints[0], RATE_HZ)
    assert loads == [None]
    found = compliance_jacobian(loads, len(joints[0]))
    assert found.links == rigid(len(joints[0])).links == ()
    assert found.carried.causes.shape == (0, 18, len(joints[0]))


def test_noise_of_encoders_makes_no_link_shorter_where_the_instrument_is_free_of_it(robots: Any) -> None:
    """Accelerations with a fifth of noise: as regressors they shrink what they multiply by its square."""
    chain, types = _forward(robots, 20, 4)
    data, _ = _bent(chain, types, 0.0, 0)
    noisy = data.qdd_rad_s2 + np.random.default_rng(5).normal(0, 0.2, data.qdd_rad_s2.shape) * (
        data.qdd_rad_s2.std(axis=0)
    )
    read = data._replace(qdd_rad_s2=noisy)
    known = refine_chain(chain, read._replace(instrument=np.concatenate(data.joints, axis=1)))
    blind = refine_chain(chain, read)
    apart, shrunk = (
        np.abs(one.chain.imu_home[:, :3, 3] - chain.imu_home[:, :3, 3]).max() for one in (known, blind)
    )
    assert apart < 0.5 * shrunk
