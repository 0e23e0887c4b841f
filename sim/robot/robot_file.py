"""Robot files: which modules a robot has and how they are joined, as TOML.

A link leads from the distal frame of the parent (its output; its housing if the parent is mounted reversed)
to the proximal frame of the child (its housing; its output if the child is mounted reversed).
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, ValidationInfo, model_validator

from module_agent.model.catalogue import module_type
from module_agent.model.errors import RobotError, UsageError
from module_agent.model.model_faults import Location, faults_of
from module_agent.model.suggestion import did_you_mean
from module_agent.model.toml_location import fault_lines, parse_toml
from module_agent.network_emulation.profile_file import network as network_profile
from module_agent.network_emulation.profile_file import network_relative_to
from module_agent.wire.keys import check_chunk
from sim.geometry.link_parts import Angle, Edge, FreePose, Part, Solid, Strict, Xyz
from sim.geometry.pose import Array, pose
from sim.geometry.shape import Shape
from sim.imperfections.noise_profile import DEFAULT_PROFILE, noise_profile

ROBOTS = Path(__file__).parents[1] / "robots"
BASE = "base"
MAX_MODULES = 64

MountName = Literal["floor", "ceiling", "wall"]
# Roll, pitch, yaw of the base frame in a world with z up. On the wall its z is horizontal, its y points up.
MOUNTS: dict[MountName, tuple[float, float, float]] = {
    "floor": (0.0, 0.0, 0.0),
    "ceiling": (180.0, 0.0, 0.0),
    "wall": (90.0, 0.0, 0.0),
}


class RobotFileError(UsageError):
    """A robot file is invalid; the message names file, line and key."""


def _in_a_list(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


def _known(lookup: Callable[[str], object]) -> AfterValidator:
    """Return the validator of a name whose look-up succeeds."""

    def check(value: str) -> str:
        try:
            lookup(value)
        except RobotError as error:
            raise ValueError(str(error)) from error
        return value

    return AfterValidator(check)


def _check_serial(serial: str) -> None:
    if serial == BASE:
        raise ValueError(f"{BASE!r} is the base's own name; call the module otherwise")
    check_chunk("serial", serial)


Stiffness = Annotated[float, Field(ge=0.0, le=1e9)]
Damping = Annotated[float, Field(ge=0.0, le=1e6)]
Stiffnesses = tuple[Stiffness, Stiffness, Stiffness]
Dampings = tuple[Damping, Damping, Damping]
_RIGID = (0.0, 0.0, 0.0)
_AXES = "xyz"


def _check_springs(kind: str, stiffness: Stiffnesses, damping: Dampings) -> None:
    for axis, k, c in zip(_AXES, stiffness, damping, strict=True):
        if c > 0.0 and k == 0.0:
            raise ValueError(
                f"the {kind} {axis} has a damping of {c} but a stiffness of 0, which stands for rigid; "
                "give it a stiffness or leave the damping out"
            )


class BaseCompliance(Solid):
    """Compliance of the base: springs and dampers in base axes, in up to six directions.

    A stiffness of 0, or none, stands for a rigid direction. The rotations are about `pivot_m`, a point of the
    base frame. The solid, in the base frame, moves with it in addition to the modules' own parts.
    """

    pivot_m: Xyz = (0.0, 0.0, 0.0)
    stiffness_n_m: Stiffnesses = _RIGID
    damping_n_s_m: Dampings = _RIGID
    stiffness_nm_rad: Stiffnesses = _RIGID
    damping_nm_s_rad: Dampings = _RIGID

    @model_validator(mode="after")
    def _springs_somewhere(self) -> "BaseCompliance":
        if not any((*self.stiffness_n_m, *self.stiffness_nm_rad)):
            raise ValueError(
                "every direction is rigid; give a stiffness_n_m or stiffness_nm_rad, or leave compliance out"
            )
        _check_springs("translation along", self.stiffness_n_m, self.damping_n_s_m)
        _check_springs("rotation about", self.stiffness_nm_rad, self.damping_nm_s_rad)
        return self


class Flex(Strict):
    """Compliance of a link at its proximal end: springs and dampers about axes of the parent's distal frame.

    A stiffness of 0 stands for a rigid direction; with all three the link is rigid, tubes included.
    """

    stiffness_nm_rad: Stiffnesses
    damping_nm_s_rad: Dampings = _RIGID

    @model_validator(mode="after")
    def _springs_damped(self) -> "Flex":
        _check_springs("rotation about", self.stiffness_nm_rad, self.damping_nm_s_rad)
        return self


class Base(Strict):
    """Orientation of the base frame: a named mount, or roll, pitch, yaw in a world with z up.

    `gravity_m_s2` is the local gravity: 9.764 to 9.834 on the Earth.
    """

    mount: MountName | None = None
    gravity_m_s2: Annotated[float, Field(ge=0.1, le=30.0)] = 9.81
    rpy_deg: tuple[Angle, Angle, Angle] | None = None
    compliance: BaseCompliance | None = None

    @model_validator(mode="after")
    def _one_or_the_other(self) -> "Base":
        if self.mount is not None and self.rpy_deg is not None:
            raise ValueError("give either mount or rpy_deg, not both")
        return self

    @property
    def world_pose(self) -> Array:
        """The base frame in the world, (4, 4)."""
        return pose(rpy_rad=np.radians(self.rpy_deg or MOUNTS[self.mount or "floor"]))


class Build(Strict):
    """How one module differs from the catalogue's entry of its type, in the axes of its housing.

    `imu_xyz_m` and `imu_turn_rad` (a rotation vector) displace the IMU in the housing, `axis_xyz_m` and
    `axis_turn_rad` the joint's axis with the output. `mass_factor` multiplies mass and inertia of the
    module, `com_xyz_m` displaces its centre of mass.
    """

    imu_xyz_m: Xyz = (0.0, 0.0, 0.0)
    imu_turn_rad: Xyz = (0.0, 0.0, 0.0)
    axis_xyz_m: Xyz = (0.0, 0.0, 0.0)
    axis_turn_rad: Xyz = (0.0, 0.0, 0.0)
    mass_factor: Annotated[float, Field(ge=0.5, le=2.0)] = 1.0
    com_xyz_m: Xyz = (0.0, 0.0, 0.0)


class Module(Strict):
    """One module and the link that holds it: a list of parts, from the parent on.

    Without `flex` tubes are compliant by beam theory, and all else is rigid. `payload` is fixed to the distal
    side of the joint: mass, centre and inertia in the output's frame, or the housing's if mounted reversed.
    Without `build` the noise profile draws how the module differs from its type.
    """

    serial: Annotated[str, _known(_check_serial)]
    type: Annotated[str, _known(module_type)]
    parent: str
    mounted: Literal["forward", "reversed"] = "forward"
    start_rad: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0
    link: Annotated[tuple[Part, ...], BeforeValidator(_in_a_list)] = ()
    payload: FreePose | None = None
    flex: Flex | None = None
    build: Build | None = None


class Obstacle(Strict):
    """What stands around the robot and does not move, in a world with z up and the base frame's origin.

    Exactly one of: `box_m` (edges), `cylinder_m` (radius, and length along its z), `sphere_m` (radius), and
    `floor`, a half-space below its own z = 0. `xyz_m` and `rpy_deg` are the pose of its centre.
    """

    name: str
    box_m: tuple[Edge, Edge, Edge] | None = None
    cylinder_m: tuple[Edge, Edge] | None = None
    sphere_m: Edge | None = None
    floor: Literal[True] | None = None
    xyz_m: Xyz = (0.0, 0.0, 0.0)
    rpy_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    friction: Annotated[float, Field(ge=0.0, le=10.0)] = 0.5

    @model_validator(mode="after")
    def _exactly_one(self) -> "Obstacle":
        shapes = (self.box_m, self.cylinder_m, self.sphere_m, self.floor)
        if sum(one is not None for one in shapes) != 1:
            raise ValueError("an obstacle is exactly one of: box_m, cylinder_m, sphere_m, floor")
        return self

    @property
    def shape(self) -> Shape:
        """Its shape in the world."""
        place = pose(self.xyz_m, np.radians(self.rpy_deg))
        if self.box_m is not None:
            return Shape("box", place, self.box_m)
        if self.cylinder_m is not None:
            return Shape("cylinder", place, self.cylinder_m)
        return Shape("plane", place) if self.sphere_m is None else Shape("sphere", place, (self.sphere_m,))


def _resolved(name: str, info: ValidationInfo) -> str:
    return network_relative_to(name, (info.context or {}).get("folder", Path()))


class Robot(Strict):
    """A robot as its file describes it; `modules` is ordered depth first, so parents precede children.

    `network` is a profile's name, or the path of a network file, in the robot's file from its own folder.
    Where there are obstacles the robot touches them and itself: see `sim.physics.contact`.
    """

    name: Annotated[str, _known(partial(check_chunk, "robot"))]
    network: Annotated[str, AfterValidator(_resolved), _known(network_profile)] = "none"
    noise: Annotated[str, _known(noise_profile)] = DEFAULT_PROFILE
    base: Base = Base()
    obstacles: Annotated[tuple[Obstacle, ...], Field(alias="obstacle")] = ()
    modules: Annotated[tuple[Module, ...], Field(alias="module", min_length=1, max_length=MAX_MODULES)]

    @property
    def serials(self) -> tuple[str, ...]:
        """The modules' serials, in order."""
        return tuple(m.serial for m in self.modules)

    @property
    def parents(self) -> tuple[int, ...]:
        """The index of every module's parent, -1 for a module on the base."""
        index = {m.serial: i for i, m in enumerate(self.modules)} | {BASE: -1}
        return tuple(index[m.parent] for m in self.modules)

    @property
    def start_rad(self) -> Array:
        """The joint positions in which the world begins, (n,) [rad]."""
        return np.array([m.start_rad for m in self.modules])


def shipped_robots() -> tuple[str, ...]:
    """Return the names of the robots that come with the simulator."""
    return tuple(sorted(path.stem for path in ROBOTS.glob("*.toml")))


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a shipped robot by name, or a robot file by path: TOML, or the manufacturer's HRDF.

    Raises:
        RobotFileError: the file is invalid; the message names file, line and key.
        FileNotFoundError: neither a shipped robot nor a file; the message lists the shipped ones.
    """
    path = ROBOTS / f"{name_or_path}.toml" if str(name_or_path) in shipped_robots() else Path(name_or_path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{name_or_path} is neither a robot file nor a shipped robot"
            f"{did_you_mean(str(name_or_path), shipped_robots())}; shipped are {', '.join(shipped_robots())}"
        )
    if path.suffix.lower() == ".hrdf":
        # Imported here: it makes what this file defines.
        from sim.robot.hrdf_reader import read_hrdf

        return read_hrdf(path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise RobotFileError(f"{path} is no text: {error}") from error
    return parse_robot(text, str(path))


def parse_robot(text: str, name: str) -> Robot:
    """Parse the text of a robot file; errors call the file `name`.

    Raises:
        RobotFileError: as `load_robot`.
    """
    data = parse_toml(text, name, RobotFileError)
    try:
        robot = Robot.model_validate(data, context={"folder": Path(name).parent})
    except ValidationError as error:
        raise RobotFileError(fault_lines(faults_of(error), text, name)) from error
    faults = _tree_faults(robot.modules)
    if faults:
        raise RobotFileError(fault_lines(faults, text, name))
    return robot.model_copy(update={"modules": _depth_first(robot.modules)})


def _tree_faults(modules: tuple[Module, ...]) -> list[tuple[Location, str]]:
    faults: list[tuple[Location, str]] = []
    first: dict[str, int] = {}
    for i, module in enumerate(modules):
        if first.setdefault(module.serial, i) != i:
            reason = f"serial {module.serial!r} is already that of module[{first[module.serial]}]"
            faults.append((("module", i, "serial"), reason))
    for i, module in enumerate(modules):
        if module.parent == module.serial:
            faults.append((("module", i, "parent"), f"module {module.serial!r} is its own parent"))
        elif module.parent not in (BASE, *first):
            reason = f"unknown parent {module.parent!r}; known are {', '.join((BASE, *first))}"
            faults.append((("module", i, "parent"), reason))
    return faults or _cycle_faults(modules)


def _cycle_faults(modules: tuple[Module, ...]) -> list[tuple[Location, str]]:
    parent_of = {m.serial: m.parent for m in modules}
    for i, module in enumerate(modules):
        path = [module.serial]
        while path[-1] != BASE and parent_of[path[-1]] not in path:
            path.append(parent_of[path[-1]])
        if path[-1] != BASE:
            loop = " -> ".join([*path, parent_of[path[-1]]])
            reason = f"the parents of {module.serial!r} never reach the base: {loop}"
            return [(("module", i, "parent"), reason)]
    return []


def _depth_first(modules: tuple[Module, ...]) -> tuple[Module, ...]:
    """Order modules as a physics engine numbers its links: depth first, siblings as in the file."""
    ordered: list[Module] = []
    waiting = [m for m in reversed(modules) if m.parent == BASE]
    while waiting:
        ordered.append(waiting.pop())
        waiting += [m for m in reversed(modules) if m.parent == ordered[-1].serial]
    return tuple(ordered)
