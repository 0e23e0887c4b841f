"""Gaps between convex shapes are lower bounds of their distances, and near them."""

import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.description.shape_clearance import projected_gap
from coordinator.description.urdf_shapes import Shapes

# Box, cylinder, sphere, capsule: half lengths, radii of disc and ball, and the same to coal.
KINDS = (
    ((0.1, 0.05, 0.2), 0.0, 0.0, coal.Box(0.2, 0.1, 0.4)),
    ((0.0, 0.0, 0.15), 0.06, 0.0, coal.Cylinder(0.06, 0.3)),
    ((0.0, 0.0, 0.0), 0.0, 0.08, coal.Sphere(0.08)),
    ((0.0, 0.0, 0.1), 0.0, 0.05, coal.Capsule(0.05, 0.2)),
)
SHAPES = Shapes(
    link=("box", "cylinder", "sphere", "capsule"),
    body=np.arange(4),
    pose=np.tile(np.eye(4), (4, 1, 1)),
    half_m=np.array([kind[0] for kind in KINDS]),
    disc_m=np.array([kind[1] for kind in KINDS]),
    ball_m=np.array([kind[2] for kind in KINDS]),
)


@pytest.mark.parametrize("one", range(4))
@pytest.mark.parametrize("other", range(4))
def test_a_gap_is_a_lower_bound_of_the_distance(one: int, other: int) -> None:
    rng = np.random.default_rng(10 * one + other)
    count = 300
    pose, there = np.tile(np.eye(4), (2, count, 1, 1))
    for some in (pose, there):
        some[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
        some[:, :3, 3] = rng.uniform(-0.3, 0.3, (count, 3))
    gaps = projected_gap(SHAPES, np.full(count, one), np.full(count, other), pose, there)
    distances = []
    for a, b in zip(pose, there, strict=True):
        places = [coal.Transform3s(p[:3, :3], p[:3, 3]) for p in (a, b)]
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        coal.distance(KINDS[one][3], places[0], KINDS[other][3], places[1], request, result)
        distances.append(result.min_distance)
    apart = np.array(distances)
    assert (gaps <= np.maximum(apart, 0.0) + 1e-6).all()
    # Boxes that are clear are never called touching, other shapes by a few centimetres at most.
    clear = apart > (1e-6 if one == other == 0 else 0.03)
    assert clear.sum() > 50
    assert (gaps[clear] > 0.0).mean() > 0.99
