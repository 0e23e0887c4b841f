"""Random robots: chains and trees of any modules on any base, that can carry what is mounted on them.

A robot is drawn in depth-first order: a module is mounted on the one before it or on one of that one's
ancestors, at times on the base. Weak modules that carry too much are replaced by stronger ones; what even the
strongest cannot carry is drawn again with shorter links.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.model.catalogue import CATALOGUE, module_type
from module_agent.model.errors import RobotError
from sim.geometry.link_parts import BRACKETS
from sim.geometry.pose import inverse
from sim.geometry.rigid_body import about_origin, joined, moved
from sim.robot.robot_file import BASE, MOUNTS, Robot
from sim.robot.robot_tree import build_tree

MIN_MODULES, MAX_MODULES = 3, 16
# A held joint that carries half of what its motor can do at standstill still moves at half its free speed.
GRAVITY_SHARE = 0.5
# Of a sine of 2 Hz and 0.1 rad, the sharpest motion that a joint is explored with: A (2 pi f)^2.
ACCELERATION_RAD_S2 = 16.0
# Its two right-angle ends alone take this much.
MIN_TUBE_M = 0.06
_LADDER = ("X5-1", "X5-4", "X5-9")
_TRIES = 40
_SHRINK = 0.85


class RobotNotDrawn(RobotError):
    """No drawn robot can carry its own weight; the message gives the seed."""


class JointLoad(NamedTuple):
    """Load of a joint: largest torque of gravity over all base orientations, and inertia about the axis."""

    weight_nm: float
    inertia_kg_m2: float


def random_robot(seed: int) -> Robot:
    """Draw a robot of 3 to 16 modules; the same seed draws the same.

    Raises:
        RobotNotDrawn: every try was too heavy for the strongest modules.
    """
    rng = np.random.default_rng(seed)
    count = int(rng.integers(MIN_MODULES, MAX_MODULES + 1))
    parents = _parents(rng, count)
    serials = [f"M-{number:05d}" for number in rng.choice(100_000, count, replace=False)]
    head = {"name": f"random_{seed}", "network": "lan", "base": _base(rng)}
    # Long chains of long tubes weigh more than any module holds: begin with a reach of about 1 m in all.
    scale = min(1.0, 6.0 / count)
    for _ in range(_TRIES):
        modules = [_module(rng, serials, parents, k, scale) for k in range(count)]
        robot = _strong_enough(Robot.model_validate({**head, "module": modules}))
        if robot is not None:
            return robot
        scale *= _SHRINK
    raise RobotNotDrawn(f"seed {seed}: no robot of {count} modules that carries itself in {_TRIES} tries")


def joint_loads(robot: Robot) -> tuple[JointLoad, ...]:
    """Return every joint's load at q = 0; the torque is g times distal mass times distance to the axis."""
    tree = build_tree(robot)
    loads = []
    for k in range(len(tree.serials)):
        distal = [i for i in range(len(tree.serials)) if k in _with_ancestors(tree.parent, i)]
        whole = joined([moved(tree.bodies[i], inverse(tree.output[k]) @ tree.output[i]) for i in distal])
        arm = float(np.hypot(whole.com_m[0], whole.com_m[1]))
        loads.append(JointLoad(tree.gravity_m_s2 * whole.mass_kg * arm, float(about_origin(whole)[2, 2])))
    return tuple(loads)


def _with_ancestors(parent: Sequence[int], k: int) -> list[int]:
    way = []
    while k >= 0:
        way.append(k)
        k = parent[k]
    return way


def carries(kind: str, load: JointLoad) -> bool:
    """Return whether a module of that type can hold a load, and move it as an exploration does."""
    most = CATALOGUE[kind].max_effort_nm
    moving = load.weight_nm + ACCELERATION_RAD_S2 * load.inertia_kg_m2
    return load.weight_nm <= GRAVITY_SHARE * most and moving <= most


def _strong_enough(robot: Robot) -> Robot | None:
    """Replace overloaded modules by stronger ones until none is left; None if the strongest is too weak."""
    while True:
        loads = joint_loads(robot)
        modules = list(robot.modules)
        weak = [k for k, m in enumerate(modules) if not carries(module_type(m.type).name, loads[k])]
        if not weak:
            return robot
        for k in weak:
            stronger = [kind for kind in _LADDER if carries(kind, loads[k])]
            if not stronger:
                return None
            modules[k] = modules[k].model_copy(update={"type": stronger[0]})
        robot = robot.model_copy(update={"modules": tuple(modules)})


# ---------------------------------------------------------------------- draws


def _parents(rng: np.random.Generator, count: int) -> list[int]:
    """Draw parents in depth-first order.

    Three robots in ten are chains, the others branch more or less, and one in five of these may stand on the
    base with several modules.
    """
    straight = 1.0 if rng.random() < 0.3 else rng.uniform(0.3, 0.9)
    roots = [-1] if rng.random() < 0.2 else []
    parents = [-1]
    for k in range(1, count):
        choices = [k - 1] if rng.random() < straight else _with_ancestors(parents, k - 1) + roots
        parents.append(int(rng.choice(choices)))
    return parents


def _base(rng: np.random.Generator) -> dict[str, Any]:
    return {"mount": str(rng.choice(sorted(MOUNTS)))} if rng.random() < 0.4 else {"rpy_deg": _any_turn(rng)}


def _any_turn(rng: np.random.Generator) -> list[float]:
    """Draw roll, pitch, yaw of a rotation that is uniform over all rotations."""
    return [float(a) for a in Rotation.from_quat(rng.normal(size=4)).as_euler("xyz", degrees=True)]


def _module(
    rng: np.random.Generator, serials: Sequence[str], parents: Sequence[int], k: int, scale: float
) -> dict[str, Any]:
    return {
        "serial": serials[k],
        "type": str(rng.choice(sorted(CATALOGUE))),
        "parent": BASE if parents[k] < 0 else serials[parents[k]],
        "mounted": "reversed" if rng.random() < 0.3 else "forward",
        "start_rad": float(rng.uniform(-0.2, 0.2)),
        "link": [_part(rng, scale) for _ in range(int(rng.choice([0, 1, 2], p=[0.1, 0.7, 0.2])))],
    }


def _part(rng: np.random.Generator, scale: float) -> dict[str, Any]:
    kind, length = rng.random(), scale * rng.uniform(0.1, 0.33)
    if kind < 0.5 and length >= MIN_TUBE_M:
        return {"tube": {"length_m": float(length), "twist_rad": float(rng.uniform(-np.pi, np.pi))}}
    if 0.5 <= kind < 0.8:
        return {"bracket": str(rng.choice(sorted(BRACKETS)))}
    mass, radius = rng.uniform(0.02, 0.15), 0.02
    xyz = scale * rng.uniform(-0.12, 0.12, size=3)
    moment = 0.4 * mass * radius**2
    return {
        "pose": {
            "xyz_m": xyz.tolist(),
            "rpy_deg": _any_turn(rng),
            "mass_kg": float(mass),
            "com_xyz_m": (0.5 * xyz).tolist(),
            "inertia": [moment, moment, moment, 0.0, 0.0, 0.0],
        }
    }
