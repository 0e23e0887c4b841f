"""What the springs have to exert along a motion: held against a pendulum on paper and a body in free fall."""

import numpy as np
import pytest

from coordinator.torque_control.feed_forward import (
    feed_forward,
    joint_reference,
    on_module,
    standing,
)
from module_agent.control.motion import effort_at
from module_agent.model.chain import Array, Chain
from module_agent.wire.messages import GoTo, MultiSine, Pattern, Rest, Sine, WindowedSine

G_M_S2 = 9.81
MASS_KG, REACH_M, INERTIA_KG_M2 = 0.7, 0.31, 4e-3


def arm(joints: int, gravity: tuple[float, float, float] = (0.0, 0.0, G_M_S2)) -> Chain:
    """Return parallel axes along y, 0.4 m apart along x: at zero the arm is stretched out level."""
    return Chain(
        serials=tuple(f"J{k}" for k in range(joints)),
        parent=tuple(range(-1, joints - 1)),
        reversed=(False,) * joints,
        axis=np.tile([0.0, 1.0, 0.0], (joints, 1)),
        point=np.array([[0.4 * k, 0.0, 0.0] for k in range(joints)]),
        imu_home=np.tile(np.eye(4), (joints, 1, 1)),
        gravity=np.array(gravity),
    )


def body(x_m: float) -> Array:
    """Return the parameters of a small body on the x axis, about the origin (thesis eq. 25)."""
    inertia = INERTIA_KG_M2 * np.eye(3) + MASS_KG * x_m**2 * np.diag([0.0, 1.0, 1.0])
    return np.concatenate([[MASS_KG, MASS_KG * x_m, 0.0, 0.0], inertia[np.triu_indices(3)]])


SWING = MultiSine(sines=(Sine(amplitude_rad=0.6, frequency_hz=0.8),), duration_s=4.0)


def test_a_pendulum_asks_for_its_weight_and_its_inertia() -> None:
    reference = joint_reference(("J0",), {"J0": SWING}, {"J0": 0.3})
    points = feed_forward(arm(1), body(REACH_M), reference)
    t_s, q = reference.t_s, reference.q_rad[:, 0]
    # Between the tapers the motion is a sine, and so is its acceleration. Turning about +y lowers what is on
    # the x axis, so that the weight helps a positive angle.
    level = (t_s > 0.7) & (t_s < 3.3)
    omega = 2.0 * np.pi * 0.8
    inertia = INERTIA_KG_M2 + MASS_KG * REACH_M**2
    by_hand = -inertia * omega**2 * (q - 0.3) - MASS_KG * REACH_M * G_M_S2 * np.cos(q)
    # The spline through 1 kHz samples is far better than this, which is a ten-thousandth of the torque.
    np.testing.assert_allclose(points.effort_nm[level, 0], by_hand[level], atol=3e-4)


def test_a_joint_that_stands_still_is_asked_to_bear_what_the_others_motion_throws_at_it() -> None:
    chain, phi = arm(2, (0.0, 0.0, 0.0)), np.concatenate([np.zeros(10), body(0.4 + REACH_M)])
    reference = joint_reference(chain.serials, {"J1": SWING}, {"J0": 0.0, "J1": 0.0})
    assert not reference.qd_rad_s[:, 0].any()
    effort = feed_forward(chain, phi, reference).effort_nm
    q, rate, change = (signal[:, 1] for signal in reference[1:])
    # Weightless, the first joint's torque is the moment of the body's momentum's change about its axis:
    # that about the second axis, and 0.4 m times the pull along z.
    pull = MASS_KG * REACH_M * (change * np.cos(q) - rate**2 * np.sin(q))
    np.testing.assert_allclose(effort[:, 0], effort[:, 1] + 0.4 * pull, atol=1e-9)


def test_standing_takes_what_bears_the_weight_and_nothing_else() -> None:
    chain = arm(1)
    moving = joint_reference(("J0",), {"J0": GoTo(target_rad=0.5, max_speed_rad_s=1.0)}, {"J0": 0.0})
    still = standing(moving, -1, 0.2)
    assert len(still.t_s) == 201
    held = feed_forward(chain, body(REACH_M), still).effort_nm
    np.testing.assert_allclose(held, -MASS_KG * REACH_M * G_M_S2 * np.cos(0.5), rtol=1e-9)


def test_what_a_module_plays_is_what_was_calculated() -> None:
    reference = joint_reference(("J0",), {"J0": WindowedSine(amplitude=0.12)}, {"J0": 0.0})
    points = feed_forward(arm(1), body(REACH_M), reference)
    (profile,) = on_module(points)
    assert profile.period_ns == 10_000_000
    played = effort_at(profile, reference.t_s)
    swing = np.ptp(points.effort_nm)
    # Straight lines of 10 ms through 2 Hz and the taper: 0.2 % of the swing for the sine alone.
    assert np.abs(played - points.effort_nm[:, 0]).max() < 5e-3 * swing
    assert played[-1] == pytest.approx(points.effort_nm[-1, 0], rel=1e-6)


@pytest.mark.parametrize(
    ("patterns", "error", "words"),
    [
        ({}, ValueError, "no joint has a pattern"),
        ({"J7": SWING}, KeyError, "a pattern for J7, which is not among the joints J0, J1"),
        (
            {"J0": SWING, "J1": Rest(duration_s=1.0)},
            ValueError,
            "joint J1 ends after 1.000 s and J0 after 4.000 s",
        ),
    ],
)
def test_a_motion_without_efforts_to_calculate_is_refused_in_words(
    patterns: dict[str, Pattern], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        joint_reference(("J0", "J1"), patterns, {"J0": 0.0, "J1": 0.0})


def test_a_joint_of_unknown_place_is_refused() -> None:
    with pytest.raises(KeyError, match="joint J1 has no origin"):
        joint_reference(("J0", "J1"), {"J0": SWING}, {"J0": 0.0})
