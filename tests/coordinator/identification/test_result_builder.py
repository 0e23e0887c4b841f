"""What `result.json` says of a robot: each way of saying it gives the same robot; the unknown is named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from coordinator.identification.result import Result, write_result
from module_agent.model.catalogue import module_type
from module_agent.model.perturbation import skew
from sim.scoring.score import score

# One process makes the run that all tests here look at.
pytestmark = pytest.mark.xdist_group("result_parts")


@pytest.fixture(scope="module")
def results() -> list[tuple[Result, Path]]:
    return []


@pytest.fixture
def run(
    results: list[tuple[Result, Path]],
    rigs: Callable[..., Any],
    quick_plan: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Result, Path]:
    """A run on two modules whose axis is along gravity; made once."""
    if not results:
        out = tmp_path_factory.mktemp("result") / "run"
        result = rigs("thesis_171_horizontal", "lan", 3).session(out, quick_plan)
        results.append((result, out))
    return results[0]


def _pose(place_m: Any, turn_rad: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn_rad).as_matrix(), place_m
    return pose


def _arrays(result: Result) -> Any:
    chain = result.chain
    return np.array(chain.axis), np.array(chain.point), np.array(chain.imu_home)


def test_the_transforms_of_the_links_put_the_imus_where_the_chain_has_them(run: tuple[Result, Path]) -> None:
    result, _ = run
    (link,) = result.transforms
    assert (link.parent_face, link.child_face) == ("output", "housing")
    parent, child = (module_type(result.types[s]) for s in (link.parent, link.child))
    x = _pose(np.array(link.values[:3]) / 1e3, np.radians(link.values[3:]))
    face = _pose(np.array(parent.output_xyz), np.zeros(3))
    imu = face @ x @ _pose(np.array(child.imu_xyz), np.zeros(3))
    _, _, homes = _arrays(result)
    np.testing.assert_allclose(imu, homes[1], atol=1e-12)


def test_the_product_of_exponentials_moves_the_tip_as_the_chain_moves_its_imu(
    run: tuple[Result, Path],
) -> None:
    result, _ = run
    axis, point, homes = _arrays(result)
    screws = result.product_of_exponentials.screws
    (tip,) = result.product_of_exponentials.tips
    assert tip.joints == result.serials == [s.serial for s in screws]
    q = np.array([0.4, -0.9])
    pose = np.eye(4)
    for screw, angle in zip(screws, q, strict=True):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(np.array(screw.screw[:3])), screw.screw[3:]
        pose = pose @ expm(angle * twist)
    # The IMU of the last module does not turn with its own joint, but its joint's axis point does not either.
    end = pose @ np.r_[point[1], 1.0]
    one = _pose(np.zeros(3), 0.4 * axis[0])
    np.testing.assert_allclose(end[:3], one[:3, :3] @ (point[1] - point[0]) + point[0], atol=1e-12)
    kind = module_type(result.types[tip.serial])
    across = np.array(kind.output_xyz) - np.array(kind.imu_xyz)
    np.testing.assert_allclose(np.array(tip.home)[:3, 3], homes[1, :3, :3] @ across + homes[1, :3, 3])


def test_unidentifiable_parameters_of_a_vertical_axis_are_named_with_the_remedy(
    run: tuple[Result, Path],
) -> None:
    result, out = run
    base, tip = result.serials
    by_kind = {item.kind: item for item in result.unresolved}
    assert set(by_kind) == {"offset_along_axis", "rotation_about_axis"}
    offset = by_kind["offset_along_axis"]
    assert [(link.parent, link.child, link.parameters) for link in offset.links] == [(base, tip, ["z_mm"])]
    assert offset.summary.startswith(f"z of the link {base} - {tip}: offset of {tip} along {base}'s axis")
    rotation = by_kind["rotation_about_axis"]
    assert "tilting the base" in rotation.summary
    # One rotation shows in several parameters, whose other combinations are known.
    (link,) = rotation.links
    names = ", ".join(name.split("_")[0] for name in link.parameters)
    assert rotation.summary.startswith(f"{names} of the link {base} - {tip} (1 combination of them): ")
    assert result.transforms[0].sigma[2] is None
    assert score(out).unidentifiable == [item.summary for item in result.unresolved]


def test_the_covariance_of_the_chain_is_that_of_its_links(run: tuple[Result, Path]) -> None:
    result, _ = run
    spread = np.array(result.chain_covariance)
    assert spread.shape == (12, 12)
    np.testing.assert_array_equal(spread[:6], 0.0)
    null = np.array(result.null_basis)
    np.testing.assert_allclose(spread @ null, 0.0, atol=1e-12)
    # A twist of the child alone, seen in the parent's output, which stands unturned above the root's origin.
    (link,) = result.transforms
    place = np.array(link.values[:3]) / 1e3
    over = np.array(module_type(result.types[link.parent]).output_xyz)
    slope = np.concatenate([-skew(place + over), np.eye(3)], axis=1)
    expected = 1e6 * slope @ spread[6:, 6:] @ slope.T
    np.testing.assert_allclose(np.array(link.covariance)[:3, :3], expected, rtol=1e-6, atol=1e-12)


def test_all_of_it_survives_the_file(run: tuple[Result, Path], tmp_path: Path) -> None:
    result, _ = run
    write_result(tmp_path / "result.json", result)
    assert Result.model_validate_json((tmp_path / "result.json").read_bytes()) == result
