"""The catalogue of module types: what a module knows of its own make.

Figures are the manufacturer's published ones where they exist. A housing frame has its origin at the centre
of the mounting face and z along the output axis; the output turns about that z axis.

Gravity's size where nobody has measured it: anywhere on the ground of the Earth.
"""

from typing import Literal, NamedTuple

ModuleTypeName = Literal["X5-1", "X5-4", "X5-9", "X5-1-old", "X5-4-old", "X5-9-old", "SEA-snake"]


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


class ModuleType(NamedTuple):
    """One type of module; lengths [m], masses [kg].

    `inertia` is (ixx, iyy, izz, ixy, ixz, iyz) about the centre of mass in housing axes [kg m^2]. `imu_xyz`
    and `output_xyz` are positions in the housing; the axes of IMU and output are parallel to its own.
    `vibration` is how much more than a module of the present generation the IMU feels of the own gears.
    """

    name: ModuleTypeName
    mass_kg: float
    com_xyz: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]
    output_xyz: tuple[float, float, float]
    imu_xyz: tuple[float, float, float]
    max_effort_nm: float
    max_speed_rad_s: float
    gear_ratio: float
    velocity_clamp_rad_s: float
    spring_nm_rad: float
    motor: MotorConstants
    range_rad: tuple[float, float] | None
    vibration: float = 1.0


_X5_COM = (-0.0142, -0.0031, 0.0165)
_X5_INERTIA = (1.5e-4, 2.55e-4, 3.5e-4, 3.41e-5, 1.18e-5, 2.29e-6)


# Where the IMU of the older generation sits is not published, only that it is not where it is today (thesis
# 6.1): this place on the board's other side is an assumption. So is the size of "more prone to vibration
# noise".
_OLD_IMU_XYZ = (-0.030, 0.015, 0.010)
_OLD_VIBRATION = 3.0


def _motor(coulomb_nm: float, viscous_nm_s_rad: float) -> MotorConstants:
    # Resistance at 25 C: published, and in a real X5-1's log 14.2 ohm at the 128 C that it reports, which is
    # copper's growth to 1.3 %. Back-EMF: the same log. Rotor inertia: the log's motion comes out best with
    # 1.6e-8 to 3.2e-8, depending on when within its 10 ms a command was received, which is not recorded.
    return MotorConstants(9.99, 0.00626, 0.00575, 1530.0, 2.6e-8, coulomb_nm, viscous_nm_s_rad, 0.65)


def _x5(
    name: ModuleTypeName,
    mass_kg: float,
    max_effort_nm: float,
    max_speed_rad_s: float,
    gear_ratio: float,
    velocity_clamp_rad_s: float,
    spring_nm_rad: float,
) -> ModuleType:
    # A real X5-1 that drives nothing draws the current of 0.076 Nm + 0.017 Nm s/rad by the torque constant
    # alone; behind a gear that passes 0.65 of it the friction is 0.049 Nm + 0.011 Nm s/rad at the output. The
    # same gear train drives the other types through further stages, so it is scaled with the gear ratio,
    # viscous friction with its square.
    scale = gear_ratio / 272.22
    return ModuleType(
        name=name,
        mass_kg=mass_kg,
        com_xyz=_X5_COM,
        inertia=_X5_INERTIA,
        output_xyz=(0.0, 0.0, 0.03105),
        imu_xyz=(0.025, 0.0, 0.003),
        max_effort_nm=max_effort_nm,
        max_speed_rad_s=max_speed_rad_s,
        gear_ratio=gear_ratio,
        velocity_clamp_rad_s=velocity_clamp_rad_s,
        spring_nm_rad=spring_nm_rad,
        motor=_motor(0.049 * scale, 0.011 * scale**2),
        range_rad=None,
    )


def _older(kind: ModuleType, name: ModuleTypeName) -> ModuleType:
    return kind._replace(name=name, imu_xyz=_OLD_IMU_XYZ, vibration=_OLD_VIBRATION)


# The X5-1's 40 Nm/rad is read from the log (effort = -k * deflection holds exactly); the other linear springs
# are within the published 70-170 Nm/rad, stiffer for the stronger types.
_X5_1 = _x5("X5-1", 0.315, 2.5, 9.425, 272.22, 9.617128, 40.0)
_X5_4 = _x5("X5-4", 0.335, 7.0, 3.351, 762.22, 3.434687, 100.0)
_X5_9 = _x5("X5-9", 0.360, 13.0, 1.466, 1742.22, 1.502675, 150.0)

CATALOGUE: dict[ModuleTypeName, ModuleType] = {
    t.name: t
    for t in (
        _X5_1,
        _X5_4,
        _X5_9,
        _older(_X5_1, "X5-1-old"),
        _older(_X5_4, "X5-4-old"),
        _older(_X5_9, "X5-9-old"),
        ModuleType(
            name="SEA-snake",
            mass_kg=0.205,
            com_xyz=(0.0, 0.0, 0.016),
            # A solid cylinder of 51 mm diameter and 64 mm length.
            inertia=(1.03e-4, 1.03e-4, 6.67e-5, 0.0, 0.0, 0.0),
            output_xyz=(0.0, 0.0, 0.032),
            imu_xyz=(0.010, 0.0, 0.016),
            max_effort_nm=7.0,
            max_speed_rad_s=3.351,
            gear_ratio=762.22,
            velocity_clamp_rad_s=3.434687,
            spring_nm_rad=100.0,
            motor=_motor(0.137, 0.086),
            range_rad=(-1.5708, 1.5708),
        ),
    )
}


class UnknownModuleType(KeyError):
    """The catalogue has no such type; the message lists those that it has."""

    def __str__(self) -> str:
        # A KeyError would show its message in quotes.
        return str(self.args[0])


def module_type(name: str) -> ModuleType:
    """Look up a type by name.

    Raises:
        UnknownModuleType: a KeyError; the message lists the known ones.
    """
    for known, found in CATALOGUE.items():
        if known == name:
            return found
    raise UnknownModuleType(f"unknown module type {name!r}; the catalogue knows {', '.join(CATALOGUE)}")


# From 9.764 (Huascaran) to 9.834 m/s^2 (the Arctic Ocean): Hirt et al., New ultrahigh-resolution picture of
# Earth's gravity field, Geophys. Res. Lett. 40, 2013. Taken as a uniform distribution: its mean, its sigma.
GRAVITY_M_S2, GRAVITY_SIGMA_M_S2 = 9.80, 0.02


TorqueKind = Literal["calibrated", "uncalibrated"]


ImuKind = Literal["calibrated", "uncalibrated"]
