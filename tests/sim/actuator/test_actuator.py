import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from module_agent.model.catalogue import CAPACITIES_J_K, RESISTANCES_K_W, ModuleType, module_type
from sim.actuator.actuator import SPRING_LOSS_S, Actuators
from sim.actuator.thermal import Windings, heat_flow
from sim.imperfections.noise_profile import NoiseProfile, noise_profile, switched

DT = 1e-3
X5 = ("X5-1", "X5-4", "X5-9")
IDEAL = noise_profile("ideal")


class Bench:
    """One actuator, a flywheel and a constant load torque, integrated as the physics engine does."""

    def __init__(
        self,
        kind: ModuleType,
        inertia: float,
        load: float = 0.0,
        dt: float = DT,
        profile: NoiseProfile = IDEAL,
    ):
        self.actuator = Actuators([kind], dt, profile)
        self.inertia, self.load, self.dt = inertia, load, dt
        self.q = self.qd = np.zeros(1)

    def run(self, pwm: float, seconds: float) -> None:
        for _ in range(round(seconds / self.dt)):
            mass, bias = np.array([[self.inertia]]), np.array([self.load])
            torque, _ = self.actuator.step(np.array([pwm]), self.q, self.qd, mass, bias)
            self.qd = self.qd + self.dt * (torque - self.load) / self.inertia
            self.q = self.q + self.dt * self.qd


@pytest.mark.parametrize(("name", "published_nm"), [("X5-1", 2.66), ("X5-4", 7.45), ("X5-9", 17.0)])
def test_a_blocked_output_feels_the_published_stall_torque(name: str, published_nm: float) -> None:
    # Slowly, or the rotor's swing would wind the spring up further and friction would keep it there.
    bench = Bench(module_type(name), inertia=1e9)
    for pwm in np.append(np.linspace(0.0, 0.5, 1000), np.full(1000, 0.5)):
        bench.run(pwm, DT)
    assert bench.actuator.state.torque_nm[0] == pytest.approx(published_nm, rel=0.10)


@pytest.mark.parametrize("name", X5)
def test_the_free_speed_balances_back_emf_and_friction(name: str) -> None:
    kind = module_type(name)
    m, gear = kind.motor, kind.gear_ratio
    bench = Bench(kind, inertia=1e-4)
    bench.run(1.0, 0.5)
    # eff Kt N (V - Ke N w)/R = Tc + b w
    torque = m.efficiency * m.back_emf_v_s_rad * gear / m.resistance_ohm
    expected = (24.0 * torque - m.coulomb_nm) / (m.viscous_nm_s_rad + torque * m.back_emf_v_s_rad * gear)
    assert bench.qd[0] == pytest.approx(expected, rel=1e-6)
    assert expected > kind.max_speed_rad_s


def test_half_the_firmwares_pwm_is_full_duty_at_24_volts() -> None:
    half, full = Bench(module_type("X5-4"), 0.1), Bench(module_type("X5-4"), 0.1)
    half.run(0.5, 0.2)
    full.run(1.0, 0.2)
    assert half.actuator.state.duty[0] == full.actuator.state.duty[0] == 1.0
    assert half.q[0] == full.q[0]


@pytest.mark.parametrize("name", X5)
def test_a_motor_sticks_until_its_torque_beats_friction(name: str) -> None:
    kind = module_type(name)
    motor = kind.motor
    # Duty at which eff Kt N V / R equals the Coulomb friction.
    breakaway = motor.coulomb_nm / (
        motor.efficiency * motor.back_emf_v_s_rad * kind.gear_ratio * 24.0 / motor.resistance_ohm
    )
    for share, moves in ((0.97, False), (1.03, True)):
        bench = Bench(kind, inertia=0.01)
        bench.run(share * breakaway / 2.0, 0.3)
        assert (bench.actuator.state.motor_rad[0] > 0.0) == moves


def test_a_gear_at_rest_holds_a_load_between_driving_and_being_driven_back() -> None:
    # The motor's torque i Kt N drives loads up to eff times it and yields to loads above all of it.
    kind = module_type("X5-1")
    pwm = 0.3
    ideal = 2.0 * pwm * 24.0 / kind.motor.resistance_ohm * kind.motor.back_emf_v_s_rad * kind.gear_ratio
    ends = []
    for share in (0.55, 0.85, 1.10):
        bench = Bench(kind, inertia=0.02, load=share * ideal)
        bench.actuator.reset(bench.q, np.array([bench.load]))
        before = bench.actuator.state.motor_rad[0]
        bench.run(pwm, 0.3)
        ends.append(float(bench.actuator.state.motor_rad[0] - before))
    assert ends[0] > 1e-3
    assert abs(ends[1]) < 1e-12
    assert ends[2] < -1e-3


@pytest.mark.parametrize("name", X5)
@pytest.mark.parametrize("inertia", [0.002, 0.01])
def test_a_driven_joint_follows_the_continuous_equations(name: str, inertia: float) -> None:
    kind = module_type(name)
    m, gear, k = kind.motor, kind.gear_ratio, kind.spring_nm_rad
    per_amp = m.efficiency * m.back_emf_v_s_rad * gear
    rotor = gear**2 * m.rotor_inertia_kg_m2

    def flow(_: float, y: np.ndarray) -> list[float]:
        q, qd, th, thd = y
        spring = k * (th - q) + SPRING_LOSS_S * k * (thd - qd)
        amps = (24.0 - m.back_emf_v_s_rad * gear * thd) / m.resistance_ohm
        # Driven at full voltage from rest the motor never turns back, so friction keeps its sign.
        accel = (per_amp * amps - m.viscous_nm_s_rad * thd - m.coulomb_nm - spring) / rotor
        return [qd, spring / inertia, thd, accel]

    times = np.linspace(0.01, 0.5, 50)
    exact = solve_ivp(flow, (0.0, 0.5), np.zeros(4), "DOP853", t_eval=times, rtol=1e-10, atol=1e-12).y
    assert exact[3].min() > 0.0

    def worst(dt: float) -> float:
        bench, errors = Bench(kind, inertia, dt=dt), []
        for state in exact.T:
            bench.run(1.0, 0.01)
            errors += [abs(bench.q[0] - state[0]), abs(bench.actuator.state.motor_rad[0] - state[2])]
        return max(errors)

    # The velocities of a leapfrog live half a tick before the positions, so a voltage that comes in one step
    # comes half a tick early: half a tick's way at the greatest speed, and nothing else that could be seen.
    errors = [worst(dt) for dt in (1e-3, 5e-4, 2.5e-4)]
    assert errors[0] < 0.51e-3 * exact[1].max()
    assert all(0.45 < fine / coarse < 0.55 for coarse, fine in pairwise(errors))


class Circuit(NamedTuple):
    """A motor behind its spring with a flywheel, as continuous equations; state (q, qd, th, thd)."""

    kind: ModuleType
    profile: NoiseProfile
    spring: tuple[float, float, float]
    inertia: float
    volts: Callable[[float], float]

    def __call__(self, t: float, state: np.ndarray) -> list[float]:
        q, qd, th, thd = state
        m, gear = self.kind.motor, self.kind.gear_ratio
        linear, cubic, gap = self.spring
        y = th - q - min(max(th - q, -gap / 2), gap / 2)
        elastic = linear * y + cubic * y**3
        push = elastic + SPRING_LOSS_S * (linear + 3 * cubic * y**2) * (thd - qd)
        if gap and (y == 0.0 or push * y < 0.0):
            push = 0.0
        torque = (
            m.back_emf_v_s_rad * gear * (self.volts(t) - m.back_emf_v_s_rad * gear * thd) / m.resistance_ohm
        )
        loss = self.profile.gear_loss * (1.0 - m.efficiency)
        limit = self.profile.friction * m.coulomb_nm + loss / 2 * abs(torque)
        # Smooth where it turns, or the integrator would never get past it: 1e-3 rad/s of 1 and more.
        friction = limit * np.tanh(thd / 1e-3) + self.profile.friction * m.viscous_nm_s_rad * thd
        drive = (1.0 - loss / 2) * torque - friction - push
        return [qd, push / self.inertia, thd, drive / (gear**2 * m.rotor_inertia_kg_m2)]


@pytest.mark.parametrize("name", ["X5-1", "X5-9"])
@pytest.mark.parametrize(
    ("on", "ticks_of_way"),
    [
        # Second order without corners: the bound is four times the largest error found, so that an error of
        # first order, which would be half a tick, stands out.
        ((), 0.02),
        (("stiffening-spring",), 0.02),
        # A gap is entered and left within a tick, and the reference rounds the corner of the friction.
        (("backlash",), 0.05),
        (("friction",), 0.07),
        (("friction", "gear-loss", "backlash", "stiffening-spring"), 0.12),
    ],
)
def test_a_swinging_joint_follows_the_continuous_equations_through_every_reversal(
    name: str, on: tuple[str, ...], ticks_of_way: float
) -> None:
    kind, inertia = module_type(name), 0.02
    off = tuple(effect for effect in ("friction", "gear-loss") if effect not in on)
    profile = switched(noise_profile("ideal"), on, off)
    bench = Bench(kind, inertia, profile=profile)

    def pwm(t: float) -> float:
        return 0.45 * math.sin(2 * math.pi * 1.5 * t)

    spring = tuple(float(x[0]) for x in bench.actuator.springs)
    circuit = Circuit(kind, profile, spring, inertia, lambda t: 48.0 * pwm(t))
    times = np.linspace(0.01, 1.0, 100)
    found = solve_ivp(
        circuit, (0.0, 1.0), np.zeros(4), "DOP853", times, rtol=1e-9, atol=1e-10, max_step=1e-3
    ).y
    worst = 0.0
    for row, state in enumerate(found.T):
        for k in range(10 * row, 10 * row + 10):
            bench.run(pwm(k * DT), DT)
        worst = max(worst, abs(bench.q[0] - state[0]), abs(bench.actuator.state.motor_rad[0] - state[2]))
    assert np.ptp(found[0]) > 0.4
    assert worst < ticks_of_way * DT * np.abs(found[1]).max()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(X5),
    log_inertia=st.floats(-7.0, 1.0),
    push=st.floats(-5.0, 5.0),
)
def test_an_unpowered_joint_comes_to_rest_whatever_it_carries(
    name: str, log_inertia: float, push: float
) -> None:
    kind = module_type(name)
    inertia = 10.0**log_inertia
    bench = Bench(kind, inertia)
    # The flywheel gets the energy of the spring at a torque of `push`.
    bench.qd = np.array([push / np.sqrt(kind.spring_nm_rad * inertia)])

    def energy() -> float:
        stretch = bench.actuator.state.motor_rad[0] - bench.q[0]
        return float(0.5 * inertia * bench.qd[0] ** 2 + 0.5 * kind.spring_nm_rad * stretch**2)

    start = energy()
    bench.run(0.0, 0.005)
    if inertia > 1e-2:
        # Velocities live half a tick before positions, so the reckoned energy swings a little about the true.
        assert energy() <= 1.2 * start + 1e-12
    # A flywheel too light for its swing to be resolved turns its first tick's way into spring energy.
    early = max(start, energy())
    bench.run(0.0, 0.5)
    # What is left of a light flywheel's is at rest: in the spring, where the gear's friction holds it.
    assert energy() <= 1.05 * early + 1e-12
    if inertia <= 1e-5:
        assert 0.5 * inertia * bench.qd[0] ** 2 <= 1e-3 * early + 1e-12


def test_the_three_temperatures_follow_the_continuous_heat_equation() -> None:
    a, b, c = 1.0 / np.array(RESISTANCES_K_W)
    flow = np.array([[-a, a, 0.0], [a, -a - b, b], [0.0, b, -b - c]]) / np.array(CAPACITIES_J_K)[:, None]
    np.testing.assert_allclose(
        np.linalg.matrix_power(heat_flow(DT), 5000), expm(5.0 * flow), atol=1e-3, rtol=1e-3
    )


def test_a_constant_current_heats_the_winding_by_power_times_all_resistances_in_the_end() -> None:
    windings = Windings(1, DT)
    power = 9.5 * 0.5**2
    settled = np.linalg.solve(np.eye(3) - heat_flow(DT), [DT * power / CAPACITIES_J_K[0], 0.0, 0.0])
    assert settled[0] == pytest.approx(power * sum(RESISTANCES_K_W), rel=1e-6)
    for _ in range(100):
        windings.step(np.array([power]))
    # Early on, nothing has left the winding yet: P t / C.
    assert windings.winding_c[0] - 25.0 == pytest.approx(power * 0.1 / CAPACITIES_J_K[0], rel=0.04)
