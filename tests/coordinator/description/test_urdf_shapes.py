"""Collision shapes of a URDF: where they are, how large, and what is refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from coordinator.description.urdf_reader import UrdfError, read_urdf
from coordinator.description.urdf_shapes import Shapes, read_shapes

URDF = """<robot name="one"><link name="base"/><link name="arm"><collision><origin xyz="0 0 0.1"/>
<geometry>{}</geometry></collision></link><joint name="turn" type="continuous"><parent link="base"/>
<child link="arm"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/></joint></robot>"""
CORNERS = ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 4.0, 6.0))


def shapes_of(folder: Path, geometry: str) -> Shapes:
    (folder / "one.urdf").write_text(URDF.format(geometry))
    return read_shapes(read_urdf(folder / "one.urdf"))


def write_meshes(folder: Path) -> None:
    lines = "".join("vertex {} {} {}\n".format(*corner) for corner in CORNERS)
    (folder / "text.stl").write_text(f"solid one\nfacet normal 0 0 1\nouter loop\n{lines}endloop\n")
    (folder / "text.obj").write_text(
        "".join("v {} {} {}\n".format(*corner) for corner in CORNERS) + "f 1 2 3\n"
    )
    (folder / "mesh.dae").write_text("<COLLADA/>")
    (folder / "damaged.stl").write_text("solid\nvertex 1 2\n")
    facet = struct.pack("<12fH", 0.0, 0.0, 1.0, *np.ravel(CORNERS), 0)
    (folder / "binary.stl").write_bytes(bytes(80) + struct.pack("<I", 1) + facet)


@pytest.mark.parametrize(
    ("geometry", "half", "disc", "ball"),
    [
        ('<box size="0.2 0.4 0.6"/>', (0.1, 0.2, 0.3), 0.0, 0.0),
        ('<cylinder radius="0.2" length="0.6"/>', (0.0, 0.0, 0.3), 0.2, 0.0),
        ('<sphere radius="0.2"/>', (0.0, 0.0, 0.0), 0.0, 0.2),
        ('<capsule radius="0.2" length="0.6"/>', (0.0, 0.0, 0.3), 0.0, 0.2),
    ],
)
def test_shapes_are_read(
    tmp_path: Path, geometry: str, half: tuple[float, ...], disc: float, ball: float
) -> None:
    shapes = shapes_of(tmp_path, geometry)
    assert shapes.link == ("arm",)
    assert shapes.body.tolist() == [0]
    np.testing.assert_allclose(shapes.pose[0, :3, 3], (1.0, 0.0, 0.1))
    np.testing.assert_allclose(shapes.half_m[0], half)
    assert (shapes.disc_m[0], shapes.ball_m[0]) == (disc, ball)


@pytest.mark.parametrize(
    "name", ["text.stl", "binary.stl", "text.obj", "package://arm_description/meshes/text.stl"]
)
def test_meshes_are_boxes(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "arm_description" / "urdf"
    meshes = tmp_path / "arm_description" / "meshes"
    folder.mkdir(parents=True)
    meshes.mkdir()
    write_meshes(folder)
    write_meshes(meshes)
    shapes = shapes_of(folder, f'<mesh filename="{name}" scale="0.1 0.1 0.1"/>')
    np.testing.assert_allclose(shapes.half_m[0], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(shapes.pose[0, :3, 3], (1.1, 0.2, 0.4))


@pytest.mark.parametrize(
    ("geometry", "text"),
    [
        ("<plane/>", "collision of link 'arm' has none of box, cylinder"),
        ('<box size="1 2"/>', "size='1 2'; 3 finite numbers are needed"),
        ('<mesh filename="package://other/a.stl"/>', "mesh 'package://other/a.stl' is not there"),
        ('<mesh filename="mesh.dae"/>', "mesh 'mesh.dae'; .stl and .obj are read: convert it"),
        ('<mesh filename="damaged.stl"/>', "mesh 'damaged.stl' has no vertices, or is damaged"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, geometry: str, text: str) -> None:
    write_meshes(tmp_path)
    with pytest.raises(UrdfError, match=text):
        shapes_of(tmp_path, geometry)


def test_a_floor_lies_across_gravity(tmp_path: Path) -> None:
    shapes = shapes_of(tmp_path, '<sphere radius="0.2"/>').with_floor(-0.5, np.array([0.0, 9.81, 0.0]))
    assert shapes.link == ("arm", "floor")
    top = shapes.pose[1] @ np.array([0.0, 0.0, shapes.half_m[1, 2], 1.0])
    np.testing.assert_allclose(top[:3], (0.0, -0.5, 0.0), atol=1e-12)
    np.testing.assert_allclose(shapes.pose[1, :3, :3].T @ shapes.pose[1, :3, :3], np.eye(3), atol=1e-12)
