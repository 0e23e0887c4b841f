"""A URDF arm of six joints whose links are boxes, cylinders and a sphere."""

_LINKS = (
    ("shoulder", 3.7, "0 0 0.02", '<cylinder radius="0.07" length="0.16"/>'),
    ("upper", 8.4, "0 0.12 0.28", '<box size="0.12 0.12 0.5"/>'),
    ("fore", 2.3, "0 0 0.25", '<box size="0.1 0.1 0.3"/>'),
    ("wrist_1", 1.2, "0 0.05 0", '<cylinder radius="0.045" length="0.12"/>'),
    ("wrist_2", 1.2, "0 0 0.05", '<cylinder radius="0.045" length="0.1"/>'),
    ("wrist_3", 0.25, "0 0.06 0.01", '<sphere radius="0.04"/>'),
)
_JOINTS = (
    ("j1", "base", "shoulder", "0 0 0.09", "0 0 0", "0 0 1", 2.9, 2.0, 150),
    ("j2", "shoulder", "upper", "0 0.14 0", "0 1.5708 0", "0 1 0", 1.9, 2.0, 150),
    ("j3", "upper", "fore", "0 -0.12 0.425", "0 0 0", "0 1 0", 2.5, 2.5, 150),
    ("j4", "fore", "wrist_1", "0 0 0.45", "0 1.5708 0", "0 1 0", 2.9, 3.0, 28),
    ("j5", "wrist_1", "wrist_2", "0 0.12 0", "0 0 0", "0 0 1", 2.0, 3.0, 28),
    ("j6", "wrist_2", "wrist_3", "0 0 0.12", "0 0 0", "0 1 0", 2.9, 3.0, 28),
)
HOME = "0,-0.9,0.9,-1.2,1,0"


def six_joint_urdf() -> str:
    parts = [
        '<robot name="six"><link name="base"><collision><origin xyz="0 0 0.03"/>'
        '<geometry><cylinder radius="0.075" length="0.06"/></geometry></collision></link>'
    ]
    for name, mass, centre, shape in _LINKS:
        inertia = mass * (0.03 if "box" in shape else 0.006)
        parts.append(
            f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{centre}"/>'
            f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{1.1 * inertia}" iyz="0" izz="{0.5 * inertia}"/>'
            f'</inertial><collision><origin xyz="{centre}"/><geometry>{shape}</geometry></collision></link>'
        )
    parts += [
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}" rpy="{turn}"/><axis xyz="{axis}"/>'
        f'<limit lower="-{most}" upper="{most}" velocity="{speed}" effort="{effort}"/></joint>'
        for name, parent, child, place, turn, axis, most, speed, effort in _JOINTS
    ]
    return "".join([*parts, "</robot>"])
