"""The passive parts of a link: tubes, brackets and free poses; each leads from one frame to the next.

Masses and lengths of tubes and brackets are the manufacturer's published ones; their inertia tensors are
those of the simple solids named below.
"""

from collections.abc import Sequence
from math import pi, sqrt
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from module_agent.model.read_only import read_only
from sim.geometry.pose import Array, pose
from sim.geometry.rigid_body import RigidBody, joined, moved, tensor
from sim.geometry.shape import Shape, box_between

Length = Annotated[float, Field(ge=-10.0, le=10.0)]
Xyz = tuple[Length, Length, Length]
Edge = Annotated[float, Field(gt=0.0, le=10.0)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
Moment = Annotated[float, Field(ge=-100.0, le=100.0)]

_TUBE_RADIUS_M = 0.016
# From the face of a right-angle end to the tube's axis.
_TUBE_OFF_M = 0.02
# Of both ends at right angles; and what an inline input and an inline output weigh more.
_ENDS_KG, _INLINE_KG = 0.199, (0.015, 0.013)
# 0.4 kg/m of aluminium (2700 kg/m^3) at that outer radius makes a wall of 1.6 mm.
_TUBE_INNER_RADIUS_M = sqrt(_TUBE_RADIUS_M**2 - 0.4 / 2700.0 / pi)
_PLATE_M = 0.006
_ALUMINIUM_E_PA, _ALUMINIUM_G_PA = 69e9, 26e9
# Bolted and clamped aluminium structures lose 1-3 % of critical; this is 2 % at 40 Hz: c = 2 zeta k / omega.
STRUCTURE_LOSS_S = 2.0 * 0.02 / (2.0 * pi * 40.0)
# Pseudo-rigid-body model of a clamped beam (Howell, Compliant Mechanisms, 2001, section 5): a rigid bar of
# 0.85 L on a hinge of 2.25 EI/L, exact to 0.5 % up to large deflections.
_HOWELL_HINGE, _HOWELL_STIFFNESS = 0.15, 2.25


class Hinge(NamedTuple):
    """A compliant joint within a part: pose (4, 4), stiffness and damping about its x, y, z, (3,) each.

    A stiffness of zero stands for a rigid direction.
    """

    pose: Array
    stiffness_nm_rad: Array
    damping_nm_s_rad: Array


class PlacedPart(NamedTuple):
    """A part in its input frame: pose of its output frame (4, 4), its body, hinge if compliant, shapes."""

    output: Array
    body: RigidBody
    hinge: Hinge | None = None
    shapes: tuple[Shape, ...] = ()


class Strict(BaseModel):
    """A table of a robot file: unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


End = Literal["right-angle", "inline"]


class Tube(Strict):
    """An X5 tube; its far end is twisted about the tube.

    At a right-angle end the tube runs along the face that it is bolted to, at an inline end along its normal.
    """

    length_m: Annotated[float, Field(gt=0.0, le=3.0)]
    twist_rad: Annotated[float, Field(ge=-2 * pi, le=2 * pi)] = 0.0
    input: End = "right-angle"
    output: End = "right-angle"


class Solid(Strict):
    """A rigid body: its mass, and its centre and inertia about that centre in the table's own frame.

    `inertia` is (ixx, iyy, izz, ixy, ixz, iyz) [kg m^2].
    """

    mass_kg: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    com_xyz_m: Xyz = (0.0, 0.0, 0.0)
    inertia: tuple[Moment, Moment, Moment, Moment, Moment, Moment] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _possible_inertia(self) -> Self:
        moments = np.linalg.eigvalsh(tensor(*self.inertia))
        if self.mass_kg == 0.0 and any(self.inertia):
            raise ValueError("an inertia needs a mass_kg")
        if moments[0] < -1e-15 or moments[0] + moments[1] < moments[2] * (1 - 1e-9):
            raise ValueError(
                f"no solid has these moments of inertia: principal {moments.round(9).tolist()} kg m^2; "
                "each must be at least 0 and at most the sum of the other two"
            )
        return self

    @property
    def body(self) -> RigidBody:
        """The same as a rigid body."""
        return _body(self.mass_kg, self.com_xyz_m, tensor(*self.inertia))


class FreePose(Solid):
    """Any rigid part: the pose of its output and its body, in its input frame; massless, a transform only.

    `box_m` are the edges of what it touches with, about its centre of mass; without them it touches nothing.
    """

    xyz_m: Xyz = (0.0, 0.0, 0.0)
    rpy_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    box_m: tuple[Edge, Edge, Edge] | None = None

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """What it touches with, in its input frame."""
        return () if self.box_m is None else (Shape("box", pose(self.com_xyz_m), self.box_m),)


class Part(Strict):
    """One part of a link: exactly one of `tube`, `bracket` and `pose`."""

    tube: Tube | None = None
    bracket: str | None = None
    pose: FreePose | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        if sum(x is not None for x in (self.tube, self.bracket, self.pose)) != 1:
            raise ValueError("a part of a link is exactly one of: tube, bracket, pose")
        return self

    @field_validator("bracket")
    @classmethod
    def _known_bracket(cls, name: str | None) -> str | None:
        if name is not None and name not in BRACKETS:
            raise ValueError(f"unknown bracket {name!r}; known are {', '.join(BRACKETS)}")
        return name


def placed(part: Part) -> PlacedPart:
    """Return a part's output frame, body and hinge in its input frame."""
    if part.tube is not None:
        return _tube(part.tube)
    if part.bracket is not None:
        return BRACKETS[part.bracket]
    free = part.pose or FreePose()
    return PlacedPart(pose(free.xyz_m, np.radians(free.rpy_deg)), free.body, None, free.shapes)


def _body(mass_kg: float, com: Sequence[float], inertia: Array) -> RigidBody:
    return RigidBody(mass_kg, read_only(np.array(com, dtype=float)), inertia)


def _tube(tube: Tube) -> PlacedPart:
    """Return a tube, which is made in a frame at the beginning of its axis, along x, and moved to `entry`."""
    length, twist = tube.length_m, tube.twist_rad
    off = pose((0.0, 0.0, _TUBE_OFF_M))
    # The normal of an inline end's face is the tube's axis, and the face is where the length begins and ends.
    entry = off if tube.input == "right-angle" else pose(rpy_rad=(0.0, -pi / 2, 0.0))
    leave = off if tube.output == "right-angle" else pose(rpy_rad=(0.0, pi / 2, 0.0))
    output = entry @ pose((length, 0.0, 0.0), (twist, 0.0, 0.0)) @ leave
    # A thin-walled tube, and its two cast ends as point masses, which together give the published mass
    # 0.4 L + 0.199 kg, and a little more with inline ends, with its centre in the middle.
    walls, ends = (
        0.4 * length,
        _ENDS_KG
        + sum(
            extra for end, extra in zip((tube.input, tube.output), _INLINE_KG, strict=True) if end == "inline"
        ),
    )
    along = walls * _TUBE_RADIUS_M**2 + ends * _TUBE_RADIUS_M**2
    across = walls * (length**2 / 12 + _TUBE_RADIUS_M**2 / 2) + ends * (length / 2) ** 2
    body = _body(walls + ends, (length / 2, 0.0, 0.0), tensor(along, across, across, 0.0, 0.0, 0.0))
    wall = Shape(
        "cylinder", entry @ pose((length / 2, 0.0, 0.0), (0.0, pi / 2, 0.0)), (_TUBE_RADIUS_M, length)
    )
    return PlacedPart(output, moved(body, entry), _tube_hinge(length, entry), (wall,))


def _tube_hinge(length_m: float, entry: Array) -> Hinge:
    """Return the hinge of a tube clamped at its input: bending about y, z, torsion about x (beam theory)."""
    area_moment = pi / 4.0 * (_TUBE_RADIUS_M**4 - _TUBE_INNER_RADIUS_M**4)
    bending = _HOWELL_STIFFNESS * _ALUMINIUM_E_PA * area_moment / length_m
    twisting = _ALUMINIUM_G_PA * 2.0 * area_moment / length_m
    stiffness = np.array([twisting, bending, bending])
    place = entry @ pose((_HOWELL_HINGE * length_m, 0.0, 0.0))
    return Hinge(place, read_only(stiffness), read_only(stiffness * STRUCTURE_LOSS_S))


def _bracket(mass_kg: float, y: float, z: float, turn_rad: float) -> PlacedPart:
    """Return a bracket whose output is at y, z [m] and turned about x."""
    # Two square plates of 50 mm at a right angle, half the mass each: one at the input, one at the output.
    half, side = mass_kg / 2, 0.05
    foot = tensor(half * side**2 / 12, half * side**2 / 12, half * side**2 / 6, 0.0, 0.0, 0.0)
    wall = tensor(half * side**2 / 12, half * side**2 / 6, half * side**2 / 12, 0.0, 0.0, 0.0)
    plates = (_body(half, (0.0, y / 2, 0.003), foot), _body(half, (0.0, y, z * 0.7), wall))
    far = y + np.sign(y) * _PLATE_M
    low, high = sorted((0.0, float(far)))
    plate = box_between(np.array([-side / 2, low, 0.0]), np.array([side / 2, high, z]))
    return PlacedPart(pose((0.0, y, z), (turn_rad, 0.0, 0.0)), joined(plates), None, (plate,))


BRACKETS: dict[str, PlacedPart] = {
    f"{kind}{hand}{side}": _bracket(mass, sign * y, z, -sign * pi / 2)
    for hand, sign in (("Right", -1.0), ("Left", 1.0))
    for kind, side, mass, y, z in (
        ("X5Light", "", 0.100, 0.043, 0.040),
        ("Heavy", "Outside", 0.215, 0.0375, 0.055),
        # An inside bracket turns the output as its outside twin does but sets it off to the other side.
        ("Heavy", "Inside", 0.215, -0.0225, 0.055),
    )
}
