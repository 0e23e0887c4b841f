"""The catalogue of module types, read from `module_types.toml`, and the priors of gravity."""

import tomllib
from pathlib import Path
from typing import Any, Literal, NamedTuple

from module_agent.model.errors import RobotError

_FILE = Path(__file__).with_name("module_types.toml")

Vector = tuple[float, float, float]


class MotorConstants(NamedTuple):
    """Electrical and friction constants; friction is seen at the output [Nm, Nm s/rad]."""

    resistance_ohm: float
    torque_constant_nm_a: float
    back_emf_v_s_rad: float
    velocity_constant_rpm_v: float
    rotor_inertia_kg_m2: float
    coulomb_nm: float
    viscous_nm_s_rad: float
    efficiency: float


class FactoryGains(NamedTuple):
    """kp of the position, velocity and effort loops by control strategy."""

    strategy_2: Vector
    strategy_3: Vector
    strategy_4: Vector


class ModuleType(NamedTuple):
    """One type of module; lengths [m], masses [kg].

    `inertia` is (ixx, iyy, izz, ixy, ixz, iyz) about the centre of mass in housing axes [kg m^2]. `imu_xyz`
    and `output_xyz` are positions in the housing; the axes of IMU and output are parallel to its own.
    `vibration` is the size of the module's own vibration that its IMU measures, relative to a module of the
    present generation. `housing_min_xyz` and `housing_max_xyz` are the corners of the housing's envelope.
    `hrdf_actuator` is the type of HRDF's actuator element, empty if HRDF has none. `velocity_loop` is the
    side of the spring whose speed the velocity loop of strategies 2 and 3 is closed on.
    """

    name: str
    mass_kg: float
    com_xyz: Vector
    inertia: tuple[float, float, float, float, float, float]
    output_xyz: Vector
    imu_xyz: Vector
    max_effort_nm: float
    max_speed_rad_s: float
    gear_ratio: float
    velocity_clamp_rad_s: float
    spring_nm_rad: float
    motor: MotorConstants
    gains: FactoryGains
    housing_min_xyz: Vector
    housing_max_xyz: Vector
    colour: str
    hrdf_actuator: str
    velocity_loop: Literal["motor", "output"]
    range_rad: tuple[float, float] | None = None
    vibration: float = 1.0


def _merged(entry: dict[str, Any], earlier: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return an entry of the file with what it takes from the type that it is `like`."""
    if "like" not in entry:
        return entry
    base = earlier[entry["like"]]
    parts = {part: {**base[part], **entry.get(part, {})} for part in ("motor", "gains")}
    return {**base, **{key: value for key, value in entry.items() if key != "like"}, **parts}


def _motor(gear_ratio: float, motor: dict[str, float]) -> MotorConstants:
    """Return the constants with friction scaled to the type's gear ratio."""
    constants = dict(motor)
    scale = gear_ratio / constants.pop("friction_gear_ratio")
    constants["coulomb_nm"] *= scale
    constants["viscous_nm_s_rad"] *= scale**2
    return MotorConstants(**constants)


def _read_catalogue() -> dict[str, ModuleType]:
    entries: dict[str, dict[str, Any]] = {}
    types = {}
    for raw in tomllib.loads(_FILE.read_text(encoding="utf-8"))["module_type"]:
        entry = entries[raw["name"]] = _merged(raw, entries)
        plain: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in entry.items()}
        plain["motor"] = _motor(entry["gear_ratio"], entry["motor"])
        plain["gains"] = FactoryGains(**{key: tuple(kp) for key, kp in entry["gains"].items()})
        types[entry["name"]] = ModuleType(**plain)
    return types


CATALOGUE = _read_catalogue()


class UnknownModuleType(RobotError):
    """The catalogue has no such type; the message lists those that it has."""


def module_type(name: str) -> ModuleType:
    """Look up a type by name.

    Raises:
        UnknownModuleType: the message lists the known ones.
    """
    if name not in CATALOGUE:
        raise UnknownModuleType(f"unknown module type {name!r}; the catalogue knows {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


# Prior of gravity's size where it has not been measured, anywhere on the ground of the Earth: from 9.764
# (Huascaran) to 9.834 m/s^2 (the Arctic Ocean): Hirt et al., New ultrahigh-resolution picture of Earth's
# gravity field, Geophys. Res. Lett. 40, 2013. Taken as a uniform distribution: its mean, its sigma.
GRAVITY_M_S2, GRAVITY_SIGMA_M_S2 = 9.80, 0.02

TorqueKind = Literal["calibrated", "uncalibrated"]
ImuKind = Literal["calibrated", "uncalibrated"]

# The heat of a motor: winding, housing and body as a chain of heat capacities to the air.
AMBIENT_C = 25.0
# Of winding, housing and body; and from each to the next, the body's to the air. Published constants.
CAPACITIES_J_K = (0.367, 16.6, 1250.0)
RESISTANCES_K_W = (4.626, 1.0, 8.0)
# Copper's resistance grows by this share for every kelvin above the ambient, at which it is catalogued.
COPPER_PER_K = 0.00393
