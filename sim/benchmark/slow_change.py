"""What slowly becomes of a robot in use: the weather, which is no change, and changes that grow.

Sizes are those at the end of the growth; in between a change grows linearly. The weather is a slow swing of
the ambient temperature, which moves friction and the IMUs' biases of every module by its own share.
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np

from coordinator.monitoring.findings import Kind
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Array
from sim.benchmark.cases.link_change import LinkChange, draw_link_change, with_link_change
from sim.geometry.link_parts import FreePose
from sim.imperfections.ageing import Ageing
from sim.robot.robot_file import Robot
from sim.robot.variants import loaded
from sim.world.world import World

ChangeKind = Literal[
    "payload",
    "link",
    "friction",
    "play",
    "hysteresis",
    "torque-scale",
    "torque-offset",
    "gyro-bias",
    "accel-bias",
    "gyro-scale",
    "accel-scale",
]
CHANGE_KINDS: tuple[ChangeKind, ...] = get_args(ChangeKind)


class Growth(NamedTuple):
    """A kind of change: unit of its size, range of its final size, and as what findings name it rightly.

    named: the kinds of right findings, none if the monitor has no word for it; all but `unexplained`, which
    is nowhere, have to name the module too.
    """

    unit: str
    sizes: tuple[float, float]
    named: tuple[Kind, ...]


# Torque errors and play of a module are relative to its largest torque, and in mrad; IMUs' scales in percent.
GROWTHS: dict[ChangeKind, Growth] = {
    "payload": Growth("kg", (0.1, 0.4), ("payload",)),
    "link": Growth("mm", (6.0, 12.0), ("wear",)),
    "friction": Growth("%", (50.0, 100.0), ("friction",)),
    "play": Growth("mrad", (5.0, 20.0), ()),
    "hysteresis": Growth("% of the largest torque", (2.0, 5.0), ("unexplained", "torque-sensor")),
    "torque-scale": Growth("%", (5.0, 15.0), ("unexplained", "torque-sensor")),
    "torque-offset": Growth("% of the largest torque", (2.0, 5.0), ("unexplained", "torque-sensor")),
    "gyro-bias": Growth("mrad/s", (10.0, 50.0), ("gyro",)),
    "accel-bias": Growth("m/s^2", (0.2, 1.0), ("accelerometer",)),
    "gyro-scale": Growth("%", (2.0, 6.0), ("gyro",)),
    "accel-scale": Growth("%", (2.0, 6.0), ("accelerometer",)),
}


class SlowChange(NamedTuple):
    """A change of one module, as large as `full` after it has grown from `from_s` on for `over_s`.

    direction (3,): of a link's displacement, or of a payload from the module's origin; unit vectors.
    """

    kind: ChangeKind
    serial: str
    full: float
    direction: tuple[float, float, float]
    from_s: float
    over_s: float

    def size(self, t_s: float) -> float:
        """Return its size at a time, in the unit of its kind."""
        return self.full * min(max((t_s - self.from_s) / self.over_s, 0.0), 1.0)


def draw_change(
    kind: ChangeKind, robot: Robot, rng: np.random.Generator, from_s: float, over_s: float
) -> SlowChange:
    """Draw module, size and direction of a change; payloads are carried by the last module."""
    serial, full = str(rng.choice(robot.serials)), float(rng.uniform(*GROWTHS[kind].sizes))
    along = rng.standard_normal(3)
    if kind == "payload":
        serial = robot.serials[-1]
    elif kind == "link":
        drawn = draw_link_change(robot, int(rng.integers(2**31)), 1.0)
        serial, along = drawn.child, drawn.displacement_m
    x, y, z = (float(v) for v in along / np.linalg.norm(along))
    return SlowChange(kind, serial, full, (x, y, z), from_s, over_s)


# Swings of the ambient temperature: half the range [K], and ranges of their periods.
SWING_K, SWING_S = 5.0, (3600.0, 14400.0)
# By how much a kelvin moves them, standard deviations over modules: friction, relative and never other than
# less with more warmth; biases of gyros [rad/s] and accelerometers [m/s^2]. Data sheets of chips of this
# class say 0.01 deg/s and 0.15 mg per kelvin; grease is an assumption.
FRICTION_PER_K, GYRO_PER_K, ACCEL_PER_K = 5e-3, 2e-4, 1.5e-3
# Of a payload from the module's origin, and the moment of inertia of a kilogram of it.
_LEVER_M, _OWN_M2 = 0.05, 5e-4


class Weather(NamedTuple):
    """A swing of the ambient temperature, and by how much a kelvin moves what, per module (n,)."""

    period_s: float
    phase: float
    friction_per_k: Array
    gyro_per_k: Array
    accel_per_k: Array

    def kelvin(self, t_s: float) -> float:
        """Return how much warmer it is than when the life began [K]."""
        turn = 2.0 * math.pi * t_s / self.period_s
        return SWING_K * (math.sin(turn + self.phase) - math.sin(self.phase))


def draw_weather(modules: int, rng: np.random.Generator) -> Weather:
    """Draw the weather of a life."""
    return Weather(
        float(rng.uniform(*SWING_S)),
        float(rng.uniform(0.0, 2.0 * math.pi)),
        -FRICTION_PER_K * np.abs(rng.standard_normal(modules)),
        GYRO_PER_K * rng.standard_normal(modules),
        ACCEL_PER_K * rng.standard_normal(modules),
    )


class SlowlyChanging:
    """Keeps a world at what weather and a change have made of it; `robot` is what it began as."""

    def __init__(self, world: World, robot: Robot, weather: Weather, change: SlowChange | None):
        self._world, self._robot = world, robot
        self._weather, self._change = weather, change
        self._friction = np.ones(len(robot.serials))
        self._made_of: float = 0.0

    def at(self, t_s: float) -> None:
        """Make the world what it is at a time of its life [s]."""
        kelvin, change = self._weather.kelvin(t_s), self._change
        size = 0.0 if change is None else change.size(t_s)
        for place, serial in enumerate(self._robot.serials):
            friction = 1.0 + float(self._weather.friction_per_k[place]) * kelvin
            ageing = Ageing(
                gyro_bias_rad_s=float(self._weather.gyro_per_k[place]) * kelvin,
                accel_bias_m_s2=float(self._weather.accel_per_k[place]) * kelvin,
            )
            if change is not None and change.serial == serial:
                ageing = _aged(ageing, change.kind, size, self._largest_nm(place))
                friction *= 1.0 + 1e-2 * size if change.kind == "friction" else 1.0
            self._world.change_friction(serial, friction / float(self._friction[place]))
            self._friction[place] = friction
            self._world.age(serial, ageing)
        if change is not None and change.kind in _BUILT and size != self._made_of:
            self._world.become(_BUILT[change.kind](self._robot, change, size))
            self._made_of = size

    def _largest_nm(self, place: int) -> float:
        return module_type(self._robot.modules[place].type).max_effort_nm


def _aged(ageing: Ageing, kind: ChangeKind, size: float, largest_nm: float) -> Ageing:
    """Return the ageing of a module that a change adds to."""
    match kind:
        case "play":
            return ageing._replace(play_rad=1e-3 * size)
        case "hysteresis":
            return ageing._replace(hysteresis_nm=1e-2 * size * largest_nm)
        case "torque-scale":
            return ageing._replace(effort_scale=1e-2 * size)
        case "torque-offset":
            return ageing._replace(effort_offset_nm=1e-2 * size * largest_nm)
        case "gyro-bias":
            return ageing._replace(gyro_bias_rad_s=ageing.gyro_bias_rad_s + 1e-3 * size)
        case "accel-bias":
            return ageing._replace(accel_bias_m_s2=ageing.accel_bias_m_s2 + size)
        case "gyro-scale":
            return ageing._replace(gyro_scale=1e-2 * size)
        case "accel-scale":
            return ageing._replace(accel_scale=1e-2 * size)
        case _:
            return ageing


def _with_payload(robot: Robot, change: SlowChange, mass_kg: float) -> Robot:
    x, y, z = (_LEVER_M * v for v in change.direction)
    own = mass_kg * _OWN_M2
    weight = FreePose(mass_kg=mass_kg, com_xyz_m=(x, y, z), inertia=(own, own, own, 0.0, 0.0, 0.0))
    return loaded(robot, change.serial, weight)


def _with_link(robot: Robot, change: SlowChange, size_mm: float) -> Robot:
    return with_link_change(robot, LinkChange(change.serial, 1e-3 * size_mm * np.array(change.direction)))


_BUILT: dict[ChangeKind, Callable[[Robot, SlowChange, float], Robot]] = {
    "payload": _with_payload,
    "link": _with_link,
}
