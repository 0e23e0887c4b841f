"""The collision shapes of a URDF's links: boxes, cylinders, spheres, capsules, meshes' bounding boxes."""

from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, parse

import numpy as np
from numpy.typing import NDArray

from coordinator.description.urdf_reader import UrdfError, UrdfRobot, element_pose, numbers
from module_agent.model.chain import BASE, Array
from module_agent.model.read_only import make_read_only

_KINDS = ("box", "cylinder", "sphere", "capsule", "mesh")


class Shapes(NamedTuple):
    """k convex shapes, each the sum of a box, a disc across z and a ball about one centre; read-only.

    link: whose they are. body: (k,) that moves them, `BASE` for none. pose: (k, 4, 4) of the centres at q = 0
    in the root frame. half_m: (k, 3) half lengths of the boxes. disc_m, ball_m: (k,) radii.
    """

    link: tuple[str, ...]
    body: NDArray[np.int64]
    pose: Array
    half_m: Array
    disc_m: Array
    ball_m: Array

    def with_floor(self, height_m: float, up: Array) -> "Shapes":
        """Return the shapes and a floor, which does not move, at a height [m] above the root frame."""
        pose = np.eye(4)
        pose[:3, 2] = up / np.linalg.norm(up)
        across = np.eye(3)[np.argmin(np.abs(up))]
        pose[:3, 0] = np.cross(across, pose[:3, 2]) / np.linalg.norm(np.cross(across, pose[:3, 2]))
        pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
        pose[:3, 3] = (height_m - _FLOOR_M[2]) * pose[:3, 2]
        return Shapes(
            (*self.link, "floor"),
            np.append(self.body, BASE),
            np.concatenate([self.pose, pose[None]]),
            np.vstack([self.half_m, _FLOOR_M]),
            np.append(self.disc_m, 0.0),
            np.append(self.ball_m, 0.0),
        )


# Half lengths; no arm reaches its edge.
_FLOOR_M = (20.0, 20.0, 1.0)


def read_shapes(robot: UrdfRobot) -> Shapes:
    """Return the collision shapes of a robot from its file, in the order of the links.

    Raises:
        UrdfError: a shape of another kind, or a mesh that cannot be read; the message names the link.
        OSError: the file cannot be read.
    """
    shapes = []
    for link in parse(robot.path).getroot().findall("link"):
        name = link.get("name", "")
        place = robot.links[name]
        for collision in link.findall("collision"):
            where = f"{robot.path}: collision of link {name!r}"
            centre, half, disc, ball = _shape(collision, where, robot.path.parent)
            pose = place.pose @ element_pose(collision.find("origin"), where) @ centre
            shapes.append((name, place.body, pose, half, disc, ball))
    link_names, body, poses, halves, discs, balls = zip(*shapes, strict=True) if shapes else ((),) * 6
    result = Shapes(
        link_names,
        np.array(body, dtype=np.int64),
        np.array(poses, dtype=float).reshape(-1, 4, 4),
        np.array(halves, dtype=float).reshape(-1, 3),
        np.array(discs, dtype=float),
        np.array(balls, dtype=float),
    )
    make_read_only(result)
    return result


def _shape(collision: Element, where: str, folder: Path) -> tuple[Array, Array, float, float]:
    """Return the centre (4, 4), half lengths (3,), and radii of disc and ball of a collision element."""
    geometry = collision.find("geometry")
    shape = next((one for one in geometry or () if one.tag in _KINDS), None)
    if shape is None:
        raise UrdfError(f"{where} has none of {', '.join(_KINDS)}")
    if shape.tag == "mesh":
        return _bounding_box(shape, where, folder)
    size = numbers(shape, "size", where, 3) if shape.tag == "box" else np.zeros(3)
    radius = 0.0 if shape.tag == "box" else float(numbers(shape, "radius", where, 1)[0])
    if shape.tag in ("cylinder", "capsule"):
        size[2] = numbers(shape, "length", where, 1)[0]
    disc, ball = (radius, 0.0) if shape.tag == "cylinder" else (0.0, radius)
    return np.eye(4), 0.5 * size, disc, ball


def _bounding_box(mesh: Element, where: str, folder: Path) -> tuple[Array, Array, float, float]:
    name = mesh.get("filename", "")
    path = _mesh_path(name, folder.resolve())
    if path is None:
        raise UrdfError(f"{where}: mesh {name!r} is not there, looked for from {folder.resolve()} upwards")
    if path.suffix.lower() not in _VERTEX:
        raise UrdfError(f"{where}: mesh {name!r}; {' and '.join(_VERTEX)} are read: convert it")
    scale = numbers(mesh, "scale", where, 3) if mesh.get("scale") else np.ones(3)
    points = _vertices(path) * scale
    if not len(points) or not np.isfinite(points).all():
        raise UrdfError(f"{where}: mesh {name!r} has no vertices, or is damaged")
    centre, low, high = np.eye(4), points.min(axis=0), points.max(axis=0)
    centre[:3, 3] = 0.5 * (low + high)
    return centre, 0.5 * (high - low), 0.0, 0.0


def _mesh_path(name: str, folder: Path) -> Path | None:
    """Return the file of a mesh; `package://NAME/` is a folder of that name above the URDF, or in one."""
    if not name.startswith("package://"):
        path = folder / name.removeprefix("file://")
        return path if path.is_file() else None
    package, _, rest = name.removeprefix("package://").partition("/")
    for above in (folder, *folder.parents):
        for path in (above / package / rest, *([above / rest] if above.name == package else [])):
            if path.is_file():
                return path
    return None


# What begins the line of a vertex.
_VERTEX = {".stl": "vertex", ".obj": "v"}


def _vertices(path: Path) -> Array:
    """Return the vertices (v, 3) of a mesh, empty if it is damaged."""
    data, binary = path.read_bytes(), np.dtype([("corners", "<f4", 12), ("attributes", "<u2")])
    count = int.from_bytes(data[80:84], "little")
    if path.suffix.lower() == ".stl" and len(data) == 84 + binary.itemsize * count:
        return np.asarray(
            np.frombuffer(data, binary, count, 84)["corners"][:, 3:].reshape(-1, 3), dtype=float
        )
    rows = (line.split() for line in data.decode(errors="replace").splitlines())
    cells = [row[1:4] for row in rows if row[:1] == [_VERTEX[path.suffix.lower()]]]
    try:
        return np.array(cells, dtype=float).reshape(-1, 3)
    except ValueError:
        return np.zeros((0, 3))
