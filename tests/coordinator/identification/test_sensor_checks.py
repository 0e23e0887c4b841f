"""Sensors that contradict the catalogue or the others are named; healthy ones of random robots never are."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.imu_intrinsics import (
    ACCEL_BIAS,
    FORCE,
    GYRO_BIAS,
    ImuIntrinsics,
    error_name,
)
from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.identification.finding import SensorError
from coordinator.identification.robot_refinement import sick_imus
from coordinator.identification.sensor_checks import (
    Travel,
    changed_since_rest,
    check_encoder_signs,
    check_encoder_travels,
    check_opposed,
    effort_signs,
    encoder_signs,
    misfits,
    poor_imus,
)
from coordinator.topology.topology import MotionObservation
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import CALIBRATED, UNCALIBRATED
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import JointMotion
from module_agent.wire.feedback_rows import ROW, Rows
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain


def _seen(robots: Any, chain: Chain, sign: Array) -> dict[tuple[str, str], MotionObservation]:
    q = np.tile(robots.positions(chain, 0)[0], (len(chain.serials), 1))
    sense = dict(zip(chain.serials, sign.tolist(), strict=True))
    return {
        (one.joint, one.observer): MotionObservation(True, 1.0, sense[one.joint] * one.axis)
        for one in robots.observe(chain, q)
    }


@pytest.mark.parametrize("seed", range(8))
def test_an_encoder_that_counts_backwards_is_named(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=4, serial=True)
    count = len(chain.serials)
    force = robots.rest(chain, robots.positions(chain, 0)[0]).specific_force_m_s2
    topology = robots.topology(chain)
    check_encoder_signs(encoder_signs(topology, _seen(robots, chain, np.ones(count)), force))
    for joint in range(count - 1):
        # The base joint sees gravity alone, and an axis across gravity tells no sign.
        if chain.reversed[joint] or (joint == 0 and abs(chain.gravity[2]) < 2.5):
            continue
        sign = np.ones(count)
        sign[joint] = -1.0
        signs = encoder_signs(topology, _seen(robots, chain, sign), force)
        assert signs[chain.serials[joint]][0] == pytest.approx(-1.0)
        with pytest.raises(SensorError, match=rf"^{chain.serials[joint]}: the encoder's sign is -1 [^;]*$"):
            check_encoder_signs(signs)


def _swing(robots: Any) -> tuple[Chain, list[ModuleType], JointMotion]:
    chain, types = robots.random(4, joints=3, serial=True)
    t = np.linspace(0.0, 4.0, 400)[:, None]
    q = 0.5 * np.sin(2.0 * t * np.array([1.0, 1.7, 2.3]))
    qd, qdd = np.gradient(q, 4.0 / 399, axis=0), np.zeros_like(q)
    phi = np.concatenate([parameters(body) for body in module_prior(chain, types)])
    # Bodies a third heavier than the catalogue's.
    tau = 1.3 * inverse_dynamics(chain, phi, q, qd, qdd)
    return chain, types, JointMotion(np.arange(400), q, qd, qdd, tau)


def test_an_effort_that_opposes_its_load_is_named(robots: Any) -> None:
    chain, types, motion = _swing(robots)
    assert effort_signs(chain, types, motion) == []
    (finding,) = effort_signs(chain, types, motion._replace(tau_nm=motion.tau_nm * [-1.0, 1.0, 1.0]))
    assert (finding.serial, finding.measured) == ("M00", pytest.approx(-1.3))
    # Where gyros tell the encoder's sign it is the effort's, and the chain holds.
    check_opposed([finding], {"M00": (1.0, 0.05)})
    with pytest.raises(SensorError, match=r"M00: effort over load is -1.3"):
        check_opposed([finding], {})


def _travels(turned: dict[str, dict[str, float]]) -> list[Travel]:
    return [Travel(joint, "slow", 0.6, by_encoder) for joint, by_encoder in turned.items()]


HEALTHY = {
    "A": {"A": 0.6, "B": 0.02, "C": 0.01},
    "B": {"A": -0.02, "B": 0.5, "C": 0.04},
    "C": {"A": 0.0, "B": 0.0, "C": 0.7},
}


def test_encoders_that_turn_with_each_others_joints_are_named() -> None:
    check_encoder_travels(_travels(HEALTHY))
    exchanged = {joint: {"A": t["B"], "B": t["A"], "C": t["C"]} for joint, t in HEALTHY.items()}
    with pytest.raises(SensorError, match=r"the encoders of A and B are exchanged \(moving A turned"):
        check_encoder_travels(_travels(exchanged))


def test_a_joint_that_is_stuck_is_not_an_exchanged_encoder() -> None:
    check_encoder_travels(_travels(HEALTHY | {"B": {"A": 0.2, "B": 0.0, "C": 0.01}}))


def test_an_encoder_that_runs_against_its_command_is_named() -> None:
    with pytest.raises(
        SensorError, match=r"B: its encoder turned by -0.5 rad in its slow motion, 0.6 rad were"
    ):
        check_encoder_travels(_travels(HEALTHY | {"B": {"A": 0.0, "B": -0.5, "C": 0.01}}))


def test_residuals_far_beyond_the_noise_are_named_by_serial_and_motion() -> None:
    noise = np.stack([np.full((2, 3), 2e-4), np.full((2, 3), 3e-3)])
    factor = np.full((2, 2, 3), 6.0)
    # The second IMU's gyro in the first motion, and less so its accelerometer; the third's is just not named.
    factor[0, 0, 1], factor[1, 1, 1], factor[1, 0, 2] = 30.0, 20.0, 9.9
    # All axes vary, so that none is stuck.
    varying = np.ones((2, 2, 2, 3, 3))
    refined: Any = SimpleNamespace(
        chain=SimpleNamespace(serials=("A", "B", "C")), residuals=factor * noise, columns=varying
    )
    (finding,) = misfits(refined, noise, ["the slow motion of A", "the fast motion of A"])
    assert (finding.serial, finding.motion) == ("B", "the slow motion of A")
    assert (finding.measured, finding.expected) == (pytest.approx(6e-3), pytest.approx(2e-4))
    text = "B: the residual of its gyro is 0.006 rad/s in the slow motion of A, 0.0002 rad/s is expected (29 "
    assert finding.summary.startswith(text)


@pytest.mark.parametrize(("sensor", "kind"), [(0, "gyro_contradicts"), (1, "accelerometer_contradicts")])
@pytest.mark.parametrize(("left", "serious"), [(0.2, False), (0.4, True)])
def test_an_imu_most_of_which_is_unexplained_is_sick_whatever_gives(
    sensor: int, kind: str, left: float, serious: bool
) -> None:
    """Links that bend leave a fifth at the most; the IMU of another module leaves half."""
    noise = np.stack([np.full((2, 2), 2e-4), np.full((2, 2), 3e-3)])
    read = np.zeros((2, 2, 2, 3))
    # The first IMU is on the base and reads nothing; the second one half of it all in the first motion.
    read[:, 0, 1], read[:, 1, 1] = 0.5, 0.1
    residual = np.full(read.shape, 1e-4)
    residual[sensor, 0, 1] = left * read[sensor, 0, 1]
    columns = np.stack([residual, read], axis=1)
    refined: Any = SimpleNamespace(
        chain=SimpleNamespace(serials=("A", "B")), residuals=residual.max(axis=-1), columns=columns
    )
    (finding,) = misfits(refined, noise, ["the fast motion of A", "the slow motion of A"])
    assert (finding.serial, finding.kind, finding.serious) == ("B", kind, serious)


@pytest.mark.parametrize(
    ("moved", "left", "serious"), [(1e-3, 0.04, True), (1e-3, 0.005, False), (0.03, 0.04, False)]
)
def test_an_imu_that_is_off_by_more_than_anything_moves_has_changed(
    moved: float, left: float, serious: bool
) -> None:
    """In a motion that no IMU sees there is nothing that could give; a drift of some mrad/s is usual."""
    noise = np.stack([np.full((2, 2), 2e-4), np.full((2, 2), 3e-3)])
    read = np.full((2, 2, 2, 3), 1e-4)
    read[:, 0, 1], read[0, 1] = 0.5, moved
    residual = np.full(read.shape, 1e-4)
    residual[0, 1, 1] = left
    columns = np.stack([residual, read], axis=1)
    refined: Any = SimpleNamespace(
        chain=SimpleNamespace(serials=("A", "B")), residuals=residual.max(axis=-1), columns=columns
    )
    (finding,) = misfits(refined, noise, ["the motion of A", "the motion of B"])
    assert (finding.serial, finding.motion, finding.serious) == ("B", "the motion of B", serious)


REST_Q = np.array([0.1, -0.4, 0.7])
BIASES = np.array([[0.02, -0.01, 0.0], [-0.03, 0.01, 0.02], [0.0, 0.0, 0.01]])


def at_rest(sinks_rad_s: float = 0.0) -> tuple[Any, list[Rows]]:
    """Return the fit of an arm, and what its IMUs read in a second of rest, or while its shoulder sinks."""
    chain, errors = true_chain(load_robot("a2085_03")), np.zeros((3, 34))
    errors[:, GYRO_BIAS] = BIASES
    refined = SimpleNamespace(chain=chain, placement=np.zeros((3, 6)), intrinsics=ImuIntrinsics(errors))
    rate, rng = np.array([0.0, sinks_rad_s, 0.0]), np.random.default_rng(1)
    seen = readings_on(chain, body_motions(chain, REST_Q[None], rate[None], np.zeros((1, 3))))
    rests = [np.zeros(250, ROW) for _ in range(3)]
    for k, rows in enumerate(rests):
        rows["t_ns"] = 4_000_000 * np.arange(250)
        rows["position_rad"] = REST_Q[k] + rate[k] * 0.004 * (np.arange(250) - 124.5)
        rows["gyro_rad_s"] = seen.gyro_rad_s[0, k] + BIASES[k] + 1e-3 * rng.normal(size=(250, 3))
        rows["accel_m_s2"] = seen.accel_m_s2[0, k] + 0.02 * rng.normal(size=(250, 3))
    return refined, rests


def test_imus_that_read_at_rest_what_the_motions_say_have_not_changed() -> None:
    refined, rests = at_rest()
    assert changed_since_rest(refined, REST_Q, rests) == []
    for rows in rests:
        rows["gyro_rad_s"] += 0.005
        rows["accel_m_s2"] += 0.3
    assert changed_since_rest(refined, REST_Q, rests) == []


def test_an_arm_that_still_swings_when_it_should_rest_has_no_other_imus() -> None:
    refined, rests = at_rest()
    for rows in rests:
        # Of 3.3 swings a second the last third of one is left.
        rows["gyro_rad_s"][:, 2] += 0.2 * np.sin(2.0 * np.pi * 3.3 * np.arange(250) / 250.0)
    assert changed_since_rest(refined, REST_Q, rests) == []


def test_an_arm_that_sinks_as_its_joints_cannot_hold_it_has_no_other_imus() -> None:
    refined, rests = at_rest(sinks_rad_s=0.05)
    assert changed_since_rest(refined, REST_Q, rests) == []
    # Without its encoder, which stands, that would be another IMU.
    rests[1]["position_rad"] = REST_Q[1]
    assert {one.kind for one in changed_since_rest(refined, REST_Q, rests)} == {"gyro_contradicts"}


@pytest.mark.parametrize("since", [0, 90])
def test_imus_exchanged_after_or_during_the_rest_are_named_by_their_biases(since: int) -> None:
    """Two IMUs that hang alike, exchanged: gravity is where it was, and all motions fit another robot."""
    refined, (first, second, third) = at_rest()
    gyros = first["gyro_rad_s"].copy(), second["gyro_rad_s"].copy()
    first["gyro_rad_s"][since:], second["gyro_rad_s"][since:] = gyros[1][since:], gyros[0][since:]
    found = changed_since_rest(refined, REST_Q, [first, second, third])
    assert [(one.serial, one.kind, one.serious) for one in found] == [
        (serial, "gyro_contradicts", True) for serial in refined.chain.serials[:2]
    ]
    assert found[0].expected == pytest.approx(0.02)
    assert found[0].summary.endswith("in the motions it was another IMU, or the robot did not rest")


def test_an_imu_that_hangs_otherwise_at_rest_is_named_by_gravity() -> None:
    refined, rests = at_rest()
    rests[2]["accel_m_s2"] *= -1.0
    (found,) = changed_since_rest(refined, REST_Q, rests)
    assert (found.serial, found.kind) == (refined.chain.serials[2], "accelerometer_contradicts")


def test_an_imu_whose_errors_no_make_has_is_named() -> None:
    errors = np.zeros((3, 34))
    # Of calibrated IMUs 0.02 m/s^2 are usual: 7 sigmas may be links that give, 16 are not.
    errors[1, ACCEL_BIAS], errors[2, ACCEL_BIAS] = 0.14, (0.1, -0.318, 0.0)
    refined: Any = SimpleNamespace(
        chain=SimpleNamespace(serials=("A", "B", "C")), intrinsics=ImuIntrinsics(errors)
    )
    (finding,) = poor_imus(refined, CALIBRATED)
    assert (finding.serial, finding.kind, finding.serious) == ("C", "imu_error", True)
    assert finding.summary.startswith("C: the bias of its accelerometer is -0.318 m/s^2 in its exploration")
    # As delivered, 0.2 m/s^2 are usual.
    assert poor_imus(refined, UNCALIBRATED) == []


def test_a_gyro_that_answers_to_force_may_sit_on_a_link_that_bends() -> None:
    errors = np.zeros((2, 34))
    errors[:, FORCE] = 0.1
    errors[1, ACCEL_BIAS] = 0.3
    refined: Any = SimpleNamespace(
        chain=SimpleNamespace(serials=("A", "B")), intrinsics=ImuIntrinsics(errors)
    )
    bends, sick = poor_imus(refined, CALIBRATED)
    assert (bends.serial, bends.serious, sick.serious) == ("A", False, True)
    assert "the bias of its accelerometer" in sick.summary


def test_every_error_of_an_imu_has_a_name() -> None:
    assert len({error_name(index) for index in range(34)}) == 6


def test_an_imu_is_sick_whose_scale_is_surely_far_off_and_no_other() -> None:
    """Of arms that bend, scales were 0.2 % off, 17 % but uncertain, or 90 %; of a sick IMU 5 %."""
    off, sigma = np.zeros((5, 40)), np.full((5, 40), 1e-3)
    off[:, 4], sigma[:, 4] = (0.05, 0.002, 0.17, 0.9, 0.0), (0.003, 0.0002, 0.04, 0.05, 0.003)
    own: Any = SimpleNamespace(calibration=SimpleNamespace(mean=off, sigma=sigma))
    known: Any = SimpleNamespace(mean=np.zeros((5, 40)), sigma=np.full((5, 40), 1e-4))
    assert sick_imus(own, known) == (0,)
    # As delivered, 1 % is usual: of 3 % nothing is said.
    known.sigma[:], off[0, 4] = 0.01, 0.03
    assert sick_imus(own, known) == ()
