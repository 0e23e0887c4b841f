"""What pushes a robot from outside: on the command line, in the world, and on the bus."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from module_agent.model.chain import Chain
from module_agent.model.errors import UsageError
from module_agent.model.forward_kinematics import body_displacements
from sim.geometry.link_parts import FreePose
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.main import app
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import build_skeleton
from sim.processes.launcher import LaunchConfig, Launcher
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.virtual_time.run import VirtualConfig
from sim.world.external_force import Push, parse_push
from sim.world.world import World

ARM = "a2085_03"
TIP = load_robot(ARM).serials[-1]
# Motors that do not turn, so that the springs alone give.
STUCK = NOISE_PROFILES["ideal"].model_copy(update={"friction": 1e4})


def _motion(world: World, ticks: int) -> Array:
    rows = []
    for _ in range(ticks):
        world.step([0.0] * len(world.modules))
        rows.append(np.stack([world.plant.q_rad, world.plant.qd_rad_s, world.plant.qdd_rad_s2]))
    return np.array(rows)


def test_a_world_is_the_same_bit_by_bit_until_the_push_begins_and_another_from_then_on() -> None:
    push = Push(serial=TIP, force_n=(3.0, 0.0, 0.0), at_m=(0.0, 0.0, 0.1), from_s=0.05, for_s=0.02)
    alone, pushed = (_motion(World(load_robot(ARM), 1, pushes=p), 120) for p in ((), (push,)))
    np.testing.assert_array_equal(pushed[:50], alone[:50])
    assert not np.array_equal(pushed[50, 2], alone[50, 2])


def test_with_the_pushs_torque_the_plant_fulfils_the_equations_of_motion() -> None:
    robot = load_robot(ARM)
    push = Push(
        serial=TIP, force_n=(8.0, -4.0, 6.0), torque_nm=(0.2, 0.1, -0.3), at_m=(0.02, 0.1, 0.3), for_s=0.1
    )
    world = World(robot, 1, "ideal", pushes=(push,))
    tree = RigidTree(build_skeleton(robot))
    for _ in range(99):
        world.step([0.0] * len(world.modules))
        plant = world.plant
        mass, bias = tree.mass_and_bias(plant.q_rad, plant.qd_rad_s)
        wrench = np.array(push.at_m), np.array(push.force_n), np.array(push.torque_nm)
        outside = tree.joint_loads(plant.q_rad, len(robot.modules) - 1, *wrench)
        left = mass @ plant.qdd_rad_s2 + bias - plant.spring_torque_nm - outside
        # Of some Nm; the integrator foretells the velocity of velocity forces from the last acceleration.
        np.testing.assert_allclose(left, 0.0, atol=1e-3)


def test_a_push_upwards_that_equals_a_payloads_weight_takes_it_off_the_torque_sensors() -> None:
    bare = load_robot(ARM)
    payload = FreePose(mass_kg=0.4, com_xyz_m=(0.0, 0.0, 0.1), inertia=(1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0))
    last = bare.modules[-1].model_copy(update={"payload": payload})
    laden = bare.model_copy(update={"modules": (*bare.modules[:-1], last)})
    weight = 0.4 * bare.base.gravity_m_s2
    lift = Push(serial=TIP, force_n=(0.0, 0.0, weight), at_m=(0.0, 0.0, 0.1), for_s=9.0)
    without, with_load, lifted = (
        _settled(World(robot, 1, STUCK, pushes=pushes))
        for robot, pushes in ((bare, ()), (laden, ()), (laden, (lift,)))
    )
    assert np.abs(with_load - without).max() > 1.0
    # The springs have settled to a millinewtonmetre; the arm hangs a little lower by what the motors took up.
    np.testing.assert_allclose(lifted, without, atol=0.02)


def _settled(world: World) -> Array:
    """The torques of the springs when the motion has died away [Nm]."""
    for _ in range(1500):
        world.step([0.0] * len(world.modules))
    return world.plant.spring_torque_nm


def test_several_pushes_add_up_and_opposite_ones_cancel() -> None:
    one = Push(serial=TIP, force_n=(0.0, 5.0, 0.0), at_m=(0.1, 0.0, 0.0), for_s=1.0)
    back = one.model_copy(update={"force_n": (0.0, -5.0, 0.0)})
    none, both, single = (_motion(World(load_robot(ARM), 1, pushes=p), 50) for p in ((), (one, back), (one,)))
    np.testing.assert_allclose(both, none, atol=1e-9)
    assert np.abs(single - none).max() > 1e-3


def test_a_push_may_come_while_the_world_runs_and_moves_a_body_along_the_force() -> None:
    world = World(load_robot(ARM), 1)
    _motion(world, 20)
    chain = true_chain(world.robot)
    world.push(Push(serial=TIP, force_n=(0.0, 0.0, 40.0), from_s=0.02, for_s=0.2))
    before = _height(chain, world.plant.q_rad)
    _motion(world, 200)
    assert _height(chain, world.plant.q_rad) > before + 0.01


def test_pushes_begin_and_end_each_at_its_own_time_whenever_they_were_given() -> None:
    first, second, third = (
        Push(serial=TIP, force_n=(0.0, 5.0, 0.0), at_m=(0.1, 0.0, 0.0), from_s=from_s, for_s=0.02)
        for from_s in (0.01, 0.02, 0.05)
    )
    at_once = _motion(World(load_robot(ARM), 1, pushes=(first, second, third)), 80)
    world = World(load_robot(ARM), 1, pushes=(first, third))
    before = _motion(world, 15)
    world.push(second)
    np.testing.assert_array_equal(np.concatenate([before, _motion(world, 65)]), at_once)
    two = _motion(World(load_robot(ARM), 1, pushes=(first, second)), 80)
    np.testing.assert_array_equal(two[:50], at_once[:50])
    assert not np.array_equal(two[50], at_once[50])


def _height(chain: Chain, q_rad: Array) -> float:
    """How high the last joint is along gravity [m]."""
    tip = body_displacements(chain, q_rad[None])[0, -1] @ [*chain.point[-1], 1.0]
    return float(tip[:3] @ chain.gravity / np.linalg.norm(chain.gravity))


# --------------------------------------------------------------------------- on the command line


def test_a_push_is_read_from_one_line_with_or_without_quotation_marks() -> None:
    wanted = Push(serial="X-1", force_n=(0.0, 0.0, -10.0), at_m=(0.1, 0.0, 0.0), from_s=2.0, for_s=0.5)
    keys = "force_n=[0,0,-10],at_m=[0.1,0,0],from_s=2,for_s=0.5"
    assert parse_push(f"serial=X-1,{keys}") == wanted
    assert parse_push(f'{keys}, serial = "X-1"') == wanted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("serial=A,force_n=[0,0,1]", "for_s: is missing"),
        ("serial=A,for_s=1", "nothing pushes: give force_n, torque_nm or both"),
        ("serial=A,force_n=[0,0,nan],for_s=1", "force_n: expected a finite number, found nan"),
        ("serial=A,force_n=[0,0,1],for_s=1,colour=1", "colour: unknown key"),
        ("hard", "is no push"),
    ],
)
def test_a_text_that_is_no_push_is_refused_with_the_key_and_an_example(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)) as refused:
        parse_push(text)
    assert "one is serial=X-00011" in str(refused.value)


@pytest.mark.parametrize("command", [("world", "--bus", "bus"), ("run", "--virtual"), ("run",), ("launch",)])
def test_a_push_on_no_module_of_the_robot_is_wrong_usage_and_names_the_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, [*command, ARM, "--push", "serial=Q,force_n=[0,0,1],for_s=1"])
    assert done.exit_code == 2, done.output
    assert "a push on 'Q', which is no module here; there are" in done.output
    assert TIP in done.output
    assert not list(tmp_path.iterdir())


def test_a_launcher_hands_pushes_on_to_its_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pushes = ("serial=A,force_n=[0,0,1],for_s=1", "serial=B,force_n=[0,0,2],for_s=1")
    launcher = Launcher(LaunchConfig(ARM, ARM, ("A", "B"), tmp_path, pushes=pushes), lambda text: None)
    asked: list[str] = []
    monkeypatch.setattr(launcher, "_start", lambda name, arguments: asked.extend(arguments))
    monkeypatch.setattr(launcher, "_wait", lambda ready, child, what: None)
    launcher.start_world()
    launcher.stop()
    assert [asked[k + 1] for k, word in enumerate(asked) if word == "--push"] == list(pushes)


def test_a_virtual_run_is_pushed_as_its_command_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    configs: list[VirtualConfig] = []
    monkeypatch.setattr("sim.commands.run._run_virtual", lambda config, quiet: configs.append(config))
    monkeypatch.setattr("sim.commands.run.score_run", lambda folder: None)
    text = f"serial={TIP},force_n=[0,0,1],from_s=3,for_s=1"
    out = str(tmp_path / "run")
    done = CliRunner().invoke(app, ["run", ARM, "--virtual", "--out", out, "--push", text])
    assert done.exit_code == 0, done.output
    assert configs[0].pushes == (parse_push(text),)
