"""What is added to a body whose robot is known is found: where, how heavy, and how surely."""

import numpy as np
import pytest

from coordinator.parameter_fit.payload import Payload, find_payload
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.forward_kinematics import places_on_axes
from module_agent.model.information import JointInformation, gather
from module_agent.model.regressor import inverse_dynamics
from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import loaded

ROBOT = load_robot("a2085_06")
CHAIN = true_chain(ROBOT)
JOINTS = len(CHAIN.serials)
SIGMA_NM = np.array([0.03, 0.03, 0.02, 0.01, 0.01, 0.002])
RATE_HZ = 100.0


def motion(seed: int, duration_s: float) -> tuple[Array, Array, Array]:
    """All joints on sums of two sines each."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(duration_s * RATE_HZ))[:, None] / RATE_HZ
    q, qd, qdd = np.zeros((3, len(t), JOINTS))
    for amplitude in (0.25, 0.12):
        w = 2.0 * np.pi * rng.uniform(0.15, 1.2, JOINTS)
        q += amplitude * np.sin(w * t)
        qd += amplitude * w * np.cos(w * t)
        qdd -= amplitude * w**2 * np.sin(w * t)
    return q, qd, qdd


def said(
    robot: Robot, seed: int, duration_s: float, scale: Array | float = 1.0
) -> tuple[JointInformation, ...]:
    """What the torques of a motion say, with the sensors' noise, and their scales (n,)."""
    moved = motion(seed, duration_s)
    torque = scale * inverse_dynamics(CHAIN, true_inertia(robot).ravel(), *moved)
    torque = torque + SIGMA_NM * np.random.default_rng(seed + 1000).normal(size=torque.shape)
    return gather(CHAIN, *moved, torque)


def carrying(serial: str, mass_kg: float) -> Robot:
    inertia = mass_kg * 5e-4
    payload = FreePose(
        mass_kg=mass_kg, com_xyz_m=(0.05, -0.01, 0.03), inertia=(inertia, inertia, inertia, 0.0, 0.0, 0.0)
    )
    return loaded(ROBOT, serial, payload)


def found(robot: Robot, seed: int = 0) -> Payload:
    return find_payload(said(ROBOT, seed, 30.0), said(robot, seed + 1, 10.0), places_on_axes(CHAIN), SIGMA_NM)


def truth(robot: Robot, carrier: int) -> Array:
    return np.asarray((true_inertia(robot) - true_inertia(ROBOT))[carrier])


@pytest.mark.parametrize("serial", ["wrist-3", "wrist-2", "wrist-1", "elbow"])
def test_a_payload_is_found_on_the_body_that_carries_it(serial: str) -> None:
    robot = carrying(serial, 0.2)
    one = found(robot)
    carrier = CHAIN.serials.index(serial)
    true = truth(robot, carrier)
    assert one.found
    assert one.carrier == carrier
    # The next best body explains less by far more than chance does.
    assert one.gain - one.rival > 25.0
    assert one.mass_kg == pytest.approx(0.2, abs=0.006)
    np.testing.assert_allclose(one.com_m, true[1:4] / true[0], atol=5e-3)


def test_errors_are_as_large_as_their_sigmas_say() -> None:
    robot = carrying("wrist-3", 0.2)
    true = truth(robot, JOINTS - 1)
    off = []
    for seed in range(0, 40, 2):
        one = found(robot, 100 + seed)
        sigma = np.sqrt(np.diagonal(one.com_covariance_m2))
        off.append([(one.mass_kg - 0.2) / one.mass_sigma_kg, *((one.com_m - true[1:4] / true[0]) / sigma)])
    rms = np.sqrt(np.mean(np.square(off)))
    # 80 figures, of which those of one trial hang together: 15 % of scatter.
    assert 0.6 < rms < 1.4


def test_where_nothing_was_added_nothing_is_found() -> None:
    for seed in range(5):
        one = found(ROBOT, 200 + 2 * seed)
        assert not one.found
        # Ten parameters fitted to noise take some ten off, and the best of six carriers a little more.
        assert one.gain < 30.0


def test_two_loads_are_not_taken_for_one() -> None:
    inertia = (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0)
    far = FreePose(mass_kg=0.3, com_xyz_m=(0.0, 0.2, 0.0), inertia=inertia)
    one = found(loaded(carrying("wrist-3", 0.2), "shoulder-lift", far))
    assert one.changed
    assert not one.explains
    assert not one.found


def test_a_load_that_was_taken_off_is_no_payload() -> None:
    before, later = said(carrying("wrist-3", 0.2), 0, 30.0), said(ROBOT, 1, 10.0)
    one = find_payload(before, later, places_on_axes(CHAIN), SIGMA_NM)
    assert one.changed
    assert not one.found
    back = find_payload(later, before, places_on_axes(CHAIN), SIGMA_NM)
    assert back.found
    assert back.mass_kg == pytest.approx(0.2, abs=0.006)


@pytest.mark.parametrize("mass_kg", [0.03, 0.1, 0.8])
def test_what_is_likely_beforehand_does_not_draw_the_mass(mass_kg: float) -> None:
    one = found(carrying("wrist-3", mass_kg))
    assert one.found
    assert abs(one.mass_kg - mass_kg) < 4.0 * one.mass_sigma_kg


def test_a_payload_is_a_body_that_can_exist_however_light() -> None:
    for mass in (0.001, 0.01, 0.2):
        one = found(carrying("wrist-3", mass), 7)
        assert np.linalg.eigvalsh(one.pseudo).min() > 0.0


def test_more_than_the_robot_told_before_is_not_needed() -> None:
    """Motions before that leave some of the robot open do not make the payload wrong, only less certain."""
    robot = carrying("wrist-3", 0.2)
    later = said(robot, 1, 10.0)
    little = find_payload(said(ROBOT, 0, 2.0), later, places_on_axes(CHAIN), SIGMA_NM)
    much = find_payload(said(ROBOT, 0, 60.0), later, places_on_axes(CHAIN), SIGMA_NM)
    assert little.mass_sigma_kg > much.mass_sigma_kg
    assert abs(little.mass_kg - 0.2) < 4.0 * little.mass_sigma_kg


def test_shapes_that_do_not_fit_are_named() -> None:
    known = said(ROBOT, 0, 2.0)
    with pytest.raises(ValueError, match="do not fit"):
        find_payload(known, known, places_on_axes(CHAIN)[:-1], SIGMA_NM)
    with pytest.raises(DataError, match="no body"):
        find_payload(known, known, places_on_axes(CHAIN), SIGMA_NM, carriers=[])


@pytest.mark.parametrize(("mass_kg", "scale_sigma"), [(0.2, 0.02), (0.8, 0.02), (0.8, 0.05)])
def test_a_claimed_mass_counts_the_scales_of_the_torque_sensors(mass_kg: float, scale_sigma: float) -> None:
    """They move the mass by more than noise does, and are no sign of anything but a payload."""
    robot, rng = carrying("wrist-3", mass_kg), np.random.default_rng(5)
    off: dict[float, list[float]] = {0.0: [], scale_sigma: []}
    for k in range(12):
        scale = 1.0 + scale_sigma * rng.normal(size=JOINTS)
        recorded = said(ROBOT, 2 * k, 30.0, scale), said(robot, 2 * k + 1, 10.0, scale)
        for counted, errors in off.items():
            one = find_payload(*recorded, places_on_axes(CHAIN), SIGMA_NM, scale_sigma=counted)
            errors.append((one.mass_kg - mass_kg) / one.mass_sigma_kg)
            assert not counted or (one.found and one.carrier == JOINTS - 1)
    blind, counting = (float(np.sqrt(np.mean(np.square(errors)))) for errors in off.values())
    # Of twelve draws the root mean square of what is normally distributed is beyond 1.6 once in a hundred.
    assert counting < 1.6
    assert blind > 5.0
