"""Robots that give, against an independent implementation: equations, free motion, natural frequencies."""

import math
from typing import Any

import numpy as np
import pinocchio
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from sim.actuator.actuator import SPRING_LOSS_S, Actuators
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, switched
from sim.physics.equilibrium import FallsOver, equilibrium
from sim.physics.multibody import Multibody
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import Skeleton, build_skeleton
from sim.physics.skeleton_urdf import joint_name, urdf_text
from sim.robot.robot_file import Robot, load_robot, parse_robot
from sim.robot.robot_tree import build_tree
from sim.world.world import TICK_S, World

# Motors without friction, whose sticking no smooth integration could follow, on a structure that gives.
GIVING = switched(NOISE_PROFILES["ideal"], ("base-shake", "link-flex"), ("friction", "gear-loss", "heat"))
STUCK = NOISE_PROFILES["ideal"].model_copy(update={"friction": 1e4})
UP = np.array([0.0, 0.0, 9.81])


class Reference:
    """A skeleton in Pinocchio; coordinates in the skeleton's order, a turning joint's being (cos, sin)."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self.model = pinocchio.buildModelFromXML(urdf_text("reference", skeleton))
        self.data = self.model.createData()
        self.model.gravity.linear[:] = -UP
        self.ids = [self.model.getJointId(joint_name(name)) for name in skeleton.names]
        self.rows = np.array([self.model.joints[i].idx_v for i in self.ids])
        self._at = np.array([self.model.joints[i].idx_q for i in self.ids])
        self._slides = np.array(skeleton.prismatic)

    def configuration(self, q: Array) -> Array:
        full = np.zeros(self.model.nq)
        turns = self._at[~self._slides]
        full[turns], full[turns + 1] = np.cos(q[~self._slides]), np.sin(q[~self._slides])
        full[self._at[self._slides]] = q[self._slides]
        return full

    def ordered(self, values: Array) -> Array:
        full = np.zeros(self.model.nv)
        full[self.rows] = values
        return full

    def mass(self, q: Array) -> Array:
        upper = np.triu(pinocchio.crba(self.model, self.data, self.configuration(q)))
        whole = upper + np.triu(upper, 1).T
        return np.array(whole[np.ix_(self.rows, self.rows)])

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        args = self.configuration(q), self.ordered(qd), self.ordered(qdd)
        return np.array(pinocchio.rnea(self.model, self.data, *args))[self.rows]

    def acceleration(self, q: Array, qd: Array, force: Array) -> Array:
        args = self.configuration(q), self.ordered(qd), self.ordered(force)
        return np.array(pinocchio.aba(self.model, self.data, *args))[self.rows]

    def felt(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Gyro and specific force of every IMU, (n, 6)."""
        args = self.configuration(q), self.ordered(qd), self.ordered(qdd)
        pinocchio.forwardKinematics(self.model, self.data, *args)
        return np.array([self._imu(i) for i in range(len(self.skeleton.module))])

    def _imu(self, i: int) -> Array:
        pose, body = self.skeleton.imu_pose[i], self.skeleton.imu_body[i]
        placement: Any = pinocchio.SE3(pose[:3, :3], pose[:3, 3])
        joint = self.ids[body] if body >= 0 else 0
        rate, change = placement.actInv(self.data.v[joint]), placement.actInv(self.data.a[joint])
        axes = (self.data.oMi[joint] * placement).rotation
        force = change.linear + np.cross(rate.angular, rate.linear) + axes.T @ UP
        return np.concatenate([rate.angular, force])


def _numbers(values: Any) -> str:
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"


def random_robot(seed: int, n: int = 7) -> Robot:
    """A tree of n modules of random types, some reversed, on tubes, brackets and odd solids that give."""
    rng = np.random.default_rng(seed)
    rows = [
        f'name = "random{seed}"\n[base]\nrpy_deg = {_numbers(rng.uniform(-180, 180, 3))}\n[base.compliance]',
        f"mass_kg = {rng.uniform(0.5, 2.0)!r}\npivot_m = {_numbers(rng.uniform(-0.2, 0.2, 3))}",
        "inertia = [0.01, 0.012, 0.015, 0.001, 0.0, 0.002]",
        f"stiffness_n_m = {_numbers(rng.uniform(1e4, 4e4, 3) * (rng.random(3) < 0.7))}",
        f"stiffness_nm_rad = {_numbers([*rng.uniform(3000.0, 6000.0, 2), 0.0])}",
        f"damping_nm_s_rad = {_numbers([*rng.uniform(1.0, 4.0, 2), 0.0])}",
    ]
    for i in range(n):
        parent = "base" if i == 0 else f"m{rng.integers(max(0, i - 2), i)}"
        angles, offset = _numbers(rng.uniform(-180, 180, 3)), _numbers(rng.uniform(-0.06, 0.06, 3))
        solid = f"mass_kg = 0.1, com_xyz_m = {offset}, inertia = [2e-4, 3e-4, 4e-4, 5e-5, 0.0, 1e-5]"
        odd = f"{{ pose = {{ xyz_m = {offset}, rpy_deg = {angles}, {solid} }} }}"
        length, twist = rng.uniform(0.08, 0.15), rng.uniform(-3.0, 3.0)
        tube = f"{{ tube = {{ length_m = {length!r}, twist_rad = {twist!r} }} }}"
        link = (odd, f"{odd}, {tube}", '{ bracket = "X5LightLeft" }', tube)[rng.integers(4)]
        rows.append(
            f'[[module]]\nserial = "m{i}"\ntype = "{rng.choice(["X5-1", "X5-4", "X5-9"])}"\n'
            f'parent = "{parent}"\nmounted = "{rng.choice(["forward", "reversed"])}"\nlink = [{link}]\n'
            f"start_rad = {rng.uniform(-2, 2)!r}"
        )
        if rng.random() < 0.4:
            rows.append(
                "flex = { stiffness_nm_rad = [2000.0, 900.0, 1500.0], damping_nm_s_rad = [1.0, 0.5, 0.0] }"
            )
    return parse_robot("\n".join(rows), f"random{seed}.toml")


@pytest.mark.parametrize("seed", range(8))
def test_a_random_tree_that_gives_has_pinocchios_mass_bias_and_imu_readings(seed: int) -> None:
    robot = random_robot(seed)
    skeleton = build_skeleton(robot, 1.0, 1.0)
    reference, tree = Reference(skeleton), RigidTree(skeleton)
    m = len(skeleton.names)
    assert m > len(robot.modules) + 2
    rng = np.random.default_rng(100 + seed)
    q, qd, qdd = rng.uniform(-2.0, 2.0, (3, m))
    q[list(skeleton.passive)] *= 0.05
    mass, bias = tree.mass_and_bias(q, qd)
    np.testing.assert_allclose(mass, reference.mass(q), atol=1e-13)
    np.testing.assert_allclose(bias, reference.torque(q, qd, np.zeros(m)), atol=1e-11)
    np.testing.assert_allclose(
        np.hstack(tree.imu_readings(q, qd, qdd)), reference.felt(q, qd, qdd), atol=1e-11
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_wrench_on_any_body_reaches_the_joints_as_pinocchios_jacobian_has_it(seed: int) -> None:
    skeleton = build_skeleton(random_robot(seed), 1.0, 1.0)
    reference, tree = Reference(skeleton), RigidTree(skeleton)
    rng = np.random.default_rng(200 + seed)
    for body, joint in enumerate(reference.ids):
        q = rng.uniform(-2.0, 2.0, len(skeleton.names))
        point, force, moment = rng.uniform(-3.0, 3.0, (3, 3))
        placed = reference.configuration(q)
        pinocchio.forwardKinematics(reference.model, reference.data, placed)
        jacobian = pinocchio.computeJointJacobian(reference.model, reference.data, placed, joint)
        axes = reference.data.oMi[joint].rotation
        wrench = np.concatenate([axes.T @ force, axes.T @ moment + np.cross(point, axes.T @ force)])
        wanted = (jacobian.T @ wrench)[reference.rows]
        np.testing.assert_allclose(tree.joint_loads(q, body, point, force, moment), wanted, atol=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_the_physics_engine_steps_a_random_tree_that_gives_as_pinocchio_accelerates_it(seed: int) -> None:
    skeleton = build_skeleton(random_robot(seed), 1.0, 1.0)
    reference = Reference(skeleton)
    body = Multibody("random", skeleton, TICK_S)
    m = len(skeleton.names)
    rng = np.random.default_rng(200 + seed)
    q = rng.uniform(-1.0, 1.0, m)
    q[list(skeleton.passive)] *= 0.05
    body.place(q)
    force = reference.torque(q, np.zeros(m), rng.uniform(-20.0, 20.0, m))
    wanted = reference.acceleration(q, np.zeros(m), force)
    position, speed = body.step(force, wanted, np.zeros((2, m)))
    body.close()
    np.testing.assert_allclose(speed / TICK_S, wanted, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(position, q + TICK_S * speed, atol=1e-12)


class Exact:
    """The whole robot as continuous equations over Pinocchio; state (q, qd, th, thd)."""

    def __init__(self, world: World, robot: Robot, profile: NoiseProfile):
        self.skeleton = build_skeleton(robot, profile.base_shake, profile.link_flex)
        self.reference = Reference(self.skeleton)
        self.types = build_tree(robot).types
        self.n, self.m = len(self.types), len(self.skeleton.names)
        self.own, self.passive = list(self.skeleton.module), list(self.skeleton.passive)
        gear = np.array([t.gear_ratio for t in self.types])
        self.per_amp = gear * [t.motor.back_emf_v_s_rad for t in self.types]
        self.ohm = np.array([t.motor.resistance_ohm for t in self.types])
        self.rotor = gear**2 * [t.motor.rotor_inertia_kg_m2 for t in self.types]
        self.spring = np.array([t.spring_nm_rad for t in self.types])
        plant = world.plant
        # In PWM, what holds the weight at rest: K N i = load. So nothing moves until the drive begins.
        self.hold = plant.spring_torque_nm * self.ohm / self.per_amp / 48.0
        start = np.zeros(self.m)
        start[self.own], start[self.passive] = plant.q_rad, plant.structure
        self.start = np.concatenate([start, np.zeros(self.m), plant.motor_rad, np.zeros(self.n)])

    def split(self, state: Array) -> tuple[Array, Array, Array, Array]:
        q, qd, th, thd = np.split(state, [self.m, 2 * self.m, 2 * self.m + self.n])
        return q, qd, th, thd

    def accelerations(self, t: float, state: Array) -> tuple[Array, Array]:
        q, qd, th, thd = self.split(state)
        ts = self.spring * (th - q[self.own] + SPRING_LOSS_S * (thd - qd[self.own]))
        force = np.zeros(self.m)
        force[self.own] = ts
        force[self.passive] = (
            -self.skeleton.stiffness * q[self.passive] - self.skeleton.damping * qd[self.passive]
        )
        amps = (48.0 * self.pwm(t) - self.per_amp * thd) / self.ohm
        return self.reference.acceleration(q, qd, force), (self.per_amp * amps - ts) / self.rotor

    def __call__(self, t: float, state: Array) -> Array:
        _, qd, _, thd = self.split(state)
        qdd, thdd = self.accelerations(t, state)
        return np.concatenate([qd, qdd, thd, thdd])

    def felt(self, t: float, state: Array) -> Array:
        q, qd, _, _ = self.split(state)
        return self.reference.felt(q, qd, self.accelerations(t, state)[0])

    def pwm(self, t: float) -> Array:
        """Hold, and a drive that begins smoothly and differs from module to module."""
        waves = np.array([math.sin(2 * math.pi * (0.8 + 0.15 * i) * t + i) for i in range(self.n)])
        swell: Array = 0.15 * math.sin(0.5 * math.pi * min(t / 0.3, 1.0)) ** 2 * waves
        return self.hold + swell


@pytest.mark.parametrize("gives", [False, True], ids=["rigid", "giving"])
@pytest.mark.parametrize("robot", [random_robot(1), load_robot("arm7")], ids=lambda robot: robot.name)
def test_seven_modules_imus_feel_what_an_exact_integration_of_the_whole_robot_says(
    robot: Robot, gives: bool
) -> None:
    profile = GIVING if gives else switched(GIVING, (), ("base-shake", "link-flex"))
    world = World(robot, seed=1, noise=profile)
    exact = Exact(world, robot, profile)
    instants = np.arange(0, 500, 4)
    # LSODA, as the structure's light parts are stiff; DOP853 gives the same in 30 times the time.
    found = solve_ivp(exact, (0.0, 0.5), exact.start, "LSODA", instants * TICK_S, rtol=1e-8, atol=1e-9)
    errors = []
    for k in range(500):
        samples = world.step(exact.pwm(k * TICK_S).tolist())
        if k in instants:
            felt = exact.felt(k * TICK_S, found.y[:, k // 4])
            errors.append(np.array([s[-7:-1] for s in samples]) - felt)
    world.close()
    q = found.y[exact.own]
    assert np.ptp(q, axis=1).max() > 0.5
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    # Both integrate from the same start; what is left is the step of 1 ms. The bars are 1e-4 rad/s and
    # 1e-3 m/s^2, measured are 5.3e-6 and 4.1e-5. Velocity forces half a tick old give 1.8e-4 and 9.8e-4.
    assert rms[:3].max() < 1e-5
    assert rms[3:].max() < 1e-4


class Bell:
    """A robot whose motors are stuck, by a friction beyond all loads: only springs and structure ring."""

    def __init__(self, robot: Robot):
        self.skeleton = build_skeleton(robot, 1.0, 1.0)
        self.types = build_tree(robot).types
        self.tree = RigidTree(self.skeleton)
        self.q, self.load = equilibrium(robot.name, self.tree, self.skeleton, robot.start_rad)
        self.start_rad = robot.start_rad

    def modes(self) -> tuple[Array, Array, Array, Array]:
        """Natural frequencies [rad/s], damping ratios, shapes, and the mass matrix, by Pinocchio and eigh."""
        reference, m = Reference(self.skeleton), len(self.q)
        own, passive = list(self.skeleton.module), list(self.skeleton.passive)
        springs = np.array([t.spring_nm_rad for t in self.types])
        stiffness, damping = np.zeros(m), np.zeros(m)
        stiffness[own], damping[own] = springs, springs * SPRING_LOSS_S
        stiffness[passive], damping[passive] = self.skeleton.stiffness, self.skeleton.damping
        still = np.zeros(m)
        # The weight's own stiffness: what its load changes by when a joint moves.
        weight = [
            reference.torque(self.q + e, still, still) - reference.torque(self.q - e, still, still)
            for e in 1e-5 * np.eye(m)
        ]
        mass = reference.mass(self.q)
        squares, shapes = eigh(np.diag(stiffness) + np.array(weight) / 2e-5, mass)
        omega = np.sqrt(squares)
        return omega, np.einsum("ji,j,ji->i", shapes, damping, shapes) / (2.0 * omega), shapes, mass

    def struck(self, shape: Array, ticks: int) -> Array:
        """The joints' motion (ticks, m) about rest after a release from a little along the shape."""
        actuators = Actuators(self.types, TICK_S, STUCK, skeleton=self.skeleton)
        actuators.reset(self.start_rad, self.load)
        body = Multibody("bell", self.skeleton, TICK_S)
        # Little enough for the sines of its angles to be straight.
        q, qd = self.q + shape * (1e-5 / np.abs(shape).max()), np.zeros_like(shape)
        body.place(q)
        rows = []
        for _ in range(ticks):
            rows.append(q - self.q)
            mass, bias = self.tree.mass_and_bias(q, qd)
            force, qdd = actuators.step(np.zeros(len(self.types)), q, qd, mass, bias)
            q, qd = body.step(force, qdd, np.zeros((2, len(q))))
        body.close()
        return np.array(rows)


def _ringing(wave: Array) -> tuple[float, float]:
    """Frequency [rad/s] and damping ratio of a decaying wave: the roots of its linear prediction."""
    a, b = np.linalg.lstsq(np.column_stack([wave[1:-1], wave[:-2]]), wave[2:], rcond=None)[0]
    root = np.log(np.roots([1.0, -a, -b]).astype(complex)[0]) / TICK_S
    return float(abs(root)), float(-root.real / abs(root))


@pytest.mark.parametrize("name", ["thesis_484_vertical", "thesis_484_horizontal", "arm7", "a2085_04"])
def test_a_struck_robot_rings_at_its_natural_frequencies_and_dies_away_as_damped(name: str) -> None:
    bell = Bell(load_robot(name))
    omega, zeta, shapes, mass = bell.modes()
    heard = [i for i in range(len(omega)) if omega[i] < 2 * math.pi * 50.0]
    assert len(heard) >= 2
    for i in heard:
        wave = bell.struck(shapes[:, i], 400) @ mass @ shapes[:, i]
        frequency, damping = _ringing(wave)
        # The average-acceleration rule rings low by (omega h)^2 / 12: 0.8 % at 50 Hz. Modes lend each other
        # damping where it is not proportional to stiffness: a share of it of the order of itself, which moves
        # the frequency by the order of its square.
        assert frequency == pytest.approx(omega[i], rel=0.01 + zeta[i] ** 2)
        assert damping == pytest.approx(zeta[i], rel=0.03 + zeta[i])


@pytest.mark.parametrize("millimetres", [484, 350, 245, 171])
def test_the_thesis_vertical_arm_rocks_at_some_hertz_and_the_horizontal_one_stands_firm(
    millimetres: int,
) -> None:
    lowest = {}
    for way in ("vertical", "horizontal"):
        bell = Bell(load_robot(f"thesis_{millimetres}_{way}"))
        skeleton, passive = bell.skeleton, list(bell.skeleton.passive)
        # Joints held at the start, the vertical arm hanging; the weight's own stiffness is 1 % here.
        mass = Reference(skeleton).mass(bell.q)[np.ix_(passive, passive)]
        lowest[way] = math.sqrt(eigh(np.diag(skeleton.stiffness), mass)[0][0]) / (2 * math.pi)
    assert 6.0 < lowest["vertical"] < 9.0
    assert lowest["horizontal"] > 25.0


@pytest.mark.parametrize("name", ["thesis_484_vertical", "arm7", "arm6"])
def test_a_giving_robot_begins_sagged_under_its_weight_and_stays_there(name: str) -> None:
    robot = load_robot(name)
    world = World(robot, seed=1, noise=switched(NOISE_PROFILES["ideal"], ("base-shake", "link-flex")))
    skeleton = build_skeleton(robot, 1.0, 1.0)
    q = np.zeros(len(skeleton.names))
    q[list(skeleton.module)], q[list(skeleton.passive)] = world.plant.q_rad, world.plant.structure
    still = np.zeros_like(q)
    load = Reference(skeleton).torque(q, still, still)
    before = world.plant.structure
    np.testing.assert_allclose(-skeleton.stiffness * before, load[list(skeleton.passive)], atol=1e-9)
    np.testing.assert_allclose(world.plant.spring_torque_nm, load[list(skeleton.module)], atol=1e-9)
    np.testing.assert_array_equal(world.plant.q_rad, robot.start_rad)
    assert np.abs(before).max() > 1e-5
    for _ in range(5):
        world.step([0.0] * len(robot.modules))
    # Motors that yield to the weight move it by g t^2 / 2 of their own way at most: 1e-4 of a radian.
    assert np.abs(world.plant.structure - before).max() < 0.05 * np.abs(before).max()
    world.close()


def test_a_base_too_soft_to_carry_its_robot_is_refused() -> None:
    text = 'name = "soft"\n[base.compliance]\nstiffness_nm_rad = [0.2, 0.2, 0.0]\n[[module]]\nserial = "a"\n'
    text += 'type = "X5-9"\nparent = "base"\nlink = { tube = { length_m = 0.5 } }\n'
    text += '[[module]]\nserial = "b"\ntype = "X5-9"\nparent = "a"\n'
    text += "link = { pose = { xyz_m = [0.0, 0.0, 0.5] } }\n"
    with pytest.raises(FallsOver, match="'soft' falls over"):
        World(parse_robot(text, "soft.toml"), seed=1, noise=GIVING)
