"""A score is zero for the truth, the size of a known error for that error, and says which file is broken."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng
from rich.console import Console

from module_agent.model.chain import Array, Chain
from module_agent.model.files import write_json
from module_agent.model.perturbation import apply_perturbation
from sim.commands.score import table
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import tip_errors
from sim.scoring.gauge_alignment import reorder
from sim.scoring.score import Score, ScoreError, score
from sim.world.truth import write_truth

ROBOT = load_robot("tree_y")
TRUTH = true_chain(ROBOT)
SERIALS = TRUTH.serials
OTHER_ORDER = ("root", "right-1", "left-1", "left-2", "right-2", "left-3")
EPOCH_NS = 1_700_000_000_000_000_000


def true_torque(t_s: Array, column: int, faint: int | None = None) -> Array:
    if column == faint:
        return 0.01 * np.sin(2.0 * t_s)
    return (1.0 + column) * np.sin(2.0 * t_s + column)


def write_truth_files(folder: Path, faint: int | None = None) -> None:
    write_truth(folder / "truth.json", ROBOT)
    t_ns = 4_000_000 * np.arange(1500, dtype=np.int64)
    n = len(SERIALS)
    # Every module's clock has its own epoch and drift.
    clock = np.stack([EPOCH_NS + 10**9 * k + t_ns + t_ns // 50_000 * k for k in range(n)], axis=1)
    torque = np.stack([true_torque(t_ns / 1e9, k, faint) for k in range(n)], axis=1)
    np.savez(
        folder / "truth.npz",
        serials=np.array(SERIALS),
        t_ns=t_ns,
        clock_ns=clock,
        q_rad=np.zeros_like(torque),
        qd_rad_s=np.zeros_like(torque),
        spring_torque_nm=torque,
    )


def write_held_out(folder: Path, order: tuple[str, ...], predicted: float, measured: float) -> None:
    """Held-out samples between the truth's, scaled against the true torque."""
    world_ns = 1_000_000_000 + 4_001_003 * np.arange(900, dtype=np.int64)
    columns = [SERIALS.index(serial) for serial in order]
    clock = np.stack([EPOCH_NS + 10**9 * k + world_ns + world_ns // 50_000 * k for k in columns], axis=1)
    torque = np.stack([true_torque(world_ns / 1e9, k) for k in columns], axis=1)
    np.savez(
        folder / "held_out.npz",
        t_ns=clock,
        q_rad=np.zeros_like(torque),
        tau_measured_nm=measured * torque,
        tau_predicted_nm=predicted * torque,
    )


def links(chain: Chain) -> list[dict[str, Any]]:
    return [
        {"parent": chain.serials[p], "child": s, "link_length_mm": 1.0, "link_length_sigma_mm": 0.5 + k}
        for k, (s, p) in enumerate(zip(chain.serials, chain.parent, strict=True))
        if p >= 0
    ]


def make_run(
    folder: Path,
    chain: Chain,
    basis: Array | None = None,
    /,
    predicted: float = 1.0,
    measured: float = 1.0,
    **changed: Any,
) -> Path:
    write_truth_files(folder)
    if set(chain.serials) == set(SERIALS):
        write_held_out(folder, chain.serials, predicted, measured)
    document = {
        "schema": 2,
        "serials": list(chain.serials),
        "chain": chain.to_dict(),
        "unresolved": [
            {"kind": "rotation_about_axis", "joint": "root", "modules": [], "summary": "yaw beyond root"}
        ],
        "null_basis": [[]] * (6 * len(chain.serials)) if basis is None else basis.tolist(),
        "links": links(chain),
        "dynamics": {"phi": [], "rank": 1, "held_out": {"relative_error": 0.1}},
        "robot_time_s": 61.5,
        "wall_time_s": None,
        "trace_hash": "00",
    }
    (folder / "result.json").write_text(json.dumps(document | changed))
    return folder


def test_the_truth_scores_zero(tmp_path: Path) -> None:
    found = score(make_run(tmp_path, TRUTH))
    assert found.topology_correct
    assert found.topology_differences == []
    assert [(link.parent, link.child) for link in found.links] == [
        ("root", "left-1"),
        ("left-1", "left-2"),
        ("left-2", "left-3"),
        ("root", "right-1"),
        ("right-1", "right-2"),
    ]
    for link in found.links:
        assert link.link_length_true_mm > 10.0
        assert link.link_length_error_mm == pytest.approx(0.0, abs=1e-9)
        assert link.axis_error_deg == pytest.approx(0.0, abs=1e-9)
    assert found.tip_position_rms_mm == pytest.approx(0.0, abs=1e-9)
    assert found.tip_orientation_rms_deg == pytest.approx(0.0, abs=1e-9)
    assert found.unidentifiable == ["yaw beyond root"]
    # The spline between the truth's samples at 250 Hz and a torque of 0.3 Hz: (0.008)^4 * 5 / 384.
    assert found.torque_relative_error == pytest.approx(0.0, abs=1e-8)
    assert found.torque_relative_error_measured == 0.0
    assert (found.robot_time_s, found.wall_time_s) == (61.5, None)


def test_what_a_result_claims_stands_beside_its_errors(tmp_path: Path) -> None:
    leaf = SERIALS.index("right-2")
    covariance = np.zeros((6 * len(SERIALS),) * 2)
    covariance[6 * leaf + 3 :, 6 * leaf + 3 :][:3, :3] = 4e-6 * np.eye(3)
    found = score(make_run(tmp_path, TRUTH, chain_covariance=covariance.tolist()))
    claimed = {link.child: link.link_vector_sigma_mm for link in found.links}
    assert claimed.pop("right-2") == pytest.approx(2.0)
    assert list(claimed.values()) == pytest.approx([0.0] * 4, abs=1e-9)
    # Of two leaves one is off by 2 mm in each of three directions.
    assert found.tip_position_sigma_mm == pytest.approx(2.0 * np.sqrt(3.0 / 2.0))
    assert found.tip_orientation_sigma_deg == pytest.approx(0.0, abs=1e-9)
    without = score(make_run(tmp_path, TRUTH))
    assert without.links[0].link_vector_sigma_mm is None
    assert without.tip_position_sigma_mm is None
    assert without.gravity_error_deg == pytest.approx(0.0, abs=1e-9)


def test_another_order_of_modules_scores_the_same(tmp_path: Path) -> None:
    found = score(make_run(tmp_path, reorder(TRUTH, OTHER_ORDER), predicted=1.1))
    assert found.topology_correct
    assert found.tip_position_rms_mm == pytest.approx(0.0, abs=1e-9)
    assert {link.child: link.link_length_sigma_mm for link in found.links} == {
        "right-1": 1.5,
        "left-1": 2.5,
        "left-2": 3.5,
        "right-2": 4.5,
        "left-3": 5.5,
    }
    assert found.torque_relative_error_per_joint == {s: pytest.approx(0.1, abs=1e-8) for s in SERIALS}


def test_a_leaf_that_sits_two_millimetres_further_out_is_two_millimetres_too_long(tmp_path: Path) -> None:
    leaf, parent = SERIALS.index("left-3"), SERIALS.index("left-2")
    axis = TRUTH.axis[parent]
    arm = TRUTH.imu_home[leaf, :3, 3] - TRUTH.point[parent]
    outward = arm - (arm @ axis) * axis
    delta = np.zeros((len(SERIALS), 6))
    delta[leaf, 3:] = 0.002 * outward / np.linalg.norm(outward)
    found = score(make_run(tmp_path, apply_perturbation(TRUTH, delta.ravel())))
    errors = {link.child: link.link_length_error_mm for link in found.links}
    assert errors.pop("left-3") == pytest.approx(2.0)
    assert list(errors.values()) == pytest.approx([0.0] * 4, abs=1e-9)
    assert found.tip_position_rms_mm == pytest.approx(2.0 / np.sqrt(2.0))


def test_a_leaf_tilted_by_one_degree_sees_the_axis_one_degree_off(tmp_path: Path) -> None:
    leaf, parent = SERIALS.index("right-2"), SERIALS.index("right-1")
    tilt = np.cross(TRUTH.axis[parent], [0.3, 0.5, 0.8])
    tilt *= np.radians(1.0) / np.linalg.norm(tilt)
    delta = np.zeros((len(SERIALS), 6))
    delta[leaf] = np.concatenate([tilt, np.cross(TRUTH.imu_home[leaf, :3, 3], tilt)])
    found = score(make_run(tmp_path, apply_perturbation(TRUTH, delta.ravel())))
    by_child = {link.child: link for link in found.links}
    assert by_child["right-2"].axis_error_deg == pytest.approx(1.0, rel=1e-9)
    assert by_child["right-2"].link_length_error_mm == pytest.approx(0.0, abs=1e-9)
    assert by_child["left-2"].axis_error_deg == pytest.approx(0.0, abs=1e-9)
    assert found.tip_orientation_rms_deg == pytest.approx(1.0 / np.sqrt(2.0), rel=1e-9)


def test_what_the_result_lists_as_unidentifiable_does_not_count_and_all_else_does(tmp_path: Path) -> None:
    axis, point = TRUTH.axis[0], TRUTH.point[0]
    yaw = np.zeros((len(SERIALS), 6))
    yaw[1:] = np.concatenate([axis, np.cross(point, axis)])
    basis = yaw.reshape(-1, 1) / np.linalg.norm(yaw)
    off = apply_perturbation(TRUTH, 1.2 * yaw.ravel())
    excused = score(make_run(tmp_path, off, basis))
    assert excused.tip_position_rms_mm == pytest.approx(0.0, abs=1e-6)
    assert excused.tip_orientation_rms_deg == pytest.approx(0.0, abs=1e-6)
    blamed = score(make_run(tmp_path, off))
    assert blamed.tip_orientation_rms_deg == pytest.approx(np.degrees(1.2), rel=1e-6)


def test_torque_errors_are_relative_to_the_true_and_to_the_measured_torque(tmp_path: Path) -> None:
    found = score(make_run(tmp_path, TRUTH, predicted=0.9, measured=1.2))
    assert found.torque_relative_error == pytest.approx(0.1, abs=1e-8)
    assert found.torque_relative_error_measured == pytest.approx(0.25)


def test_an_error_of_scale_is_told_from_an_error_of_shape(tmp_path: Path) -> None:
    term = {
        "serial": "left-1",
        "term": "scale",
        "unit": "",
        "significant": True,
        "value": 0.02,
        "sigma": 0.03,
    }
    dynamics = {"held_out": {"relative_error": 0.1}, "torque_terms": [term]}
    found = score(make_run(tmp_path, TRUTH, predicted=0.9, dynamics=dynamics))
    assert found.torque_scale_error_per_joint == pytest.approx(dict.fromkeys(SERIALS, -0.1), abs=1e-6)
    assert found.torque_shape_error_nm_per_joint == pytest.approx(dict.fromkeys(SERIALS, 0.0), abs=1e-6)
    assert found.torque_scale_sigma_per_joint == dict.fromkeys(SERIALS, 0.0) | {"left-1": 0.03}
    # Errors of both kinds add up in squares.
    with np.load(tmp_path / "held_out.npz") as file:
        columns = dict(file)
    columns["tau_predicted_nm"] = columns["tau_predicted_nm"] + np.sin(np.arange(900.0))[:, None]
    np.savez(tmp_path / "held_out.npz", **columns)
    found = score(tmp_path)
    for serial in SERIALS:
        error, size, scale, shape = (
            values[serial] or 0.0
            for values in (
                found.torque_rms_error_nm_per_joint or {},
                found.torque_rms_nm_per_joint or {},
                found.torque_scale_error_per_joint or {},
                found.torque_shape_error_nm_per_joint or {},
            )
        )
        assert shape > 0.5
        assert error**2 == pytest.approx((scale * size) ** 2 + shape**2, rel=1e-9)


def test_a_torque_too_small_to_measure_by_is_scored_in_newton_metres(tmp_path: Path) -> None:
    run = make_run(tmp_path, TRUTH)
    # The module at the end of the first arm turns a bare output; all are predicted to do what the others do.
    faint = SERIALS.index("left-3")
    write_truth_files(tmp_path, faint)
    found = score(run)
    relative, absolute = found.torque_relative_error_per_joint, found.torque_rms_error_nm_per_joint
    assert relative is not None
    assert absolute is not None
    relative = dict(relative)
    assert relative.pop("left-3") is None
    assert list(relative.values()) == pytest.approx([0.0] * 5, abs=1e-8)
    t_s = 1.0 + 4.001003e-3 * np.arange(900)
    error = true_torque(t_s, faint) - true_torque(t_s, faint, faint)
    rms_nm = float(np.sqrt((error**2).mean()))
    assert absolute["left-3"] == pytest.approx(rms_nm, rel=1e-6)
    assert found.torque_relative_error is not None
    assert found.torque_relative_error > 0.1
    console = Console(width=200, record=True, file=(tmp_path / "out.txt").open("w"))
    console.print(table(found))
    assert f"{rms_nm:.3f} Nm" in console.export_text()


def test_without_dynamics_there_are_no_torque_errors(tmp_path: Path) -> None:
    found = score(make_run(tmp_path, TRUTH, dynamics=None))
    assert found.torque_relative_error is None
    assert found.torque_relative_error_per_joint is None


def test_a_wrong_parent_is_said_and_the_rest_is_still_compared(tmp_path: Path) -> None:
    parent = list(TRUTH.parent)
    parent[SERIALS.index("right-1")] = SERIALS.index("left-1")
    found = score(make_run(tmp_path, TRUTH._replace(parent=tuple(parent))))
    assert not found.topology_correct
    assert found.topology_differences == ["module right-1 is mounted on root, the result says on left-1"]
    assert found.tip_position_rms_mm is None
    assert found.tip_orientation_rms_deg is None
    by_child = {link.child: link for link in found.links}
    assert by_child["right-1"].link_length_error_mm is None
    assert by_child["right-2"].link_length_error_mm == pytest.approx(0.0, abs=1e-9)
    assert found.torque_relative_error == pytest.approx(0.0, abs=1e-8)


def test_a_wrong_mounting_and_a_missing_module_are_said(tmp_path: Path) -> None:
    mounting = [False] * len(SERIALS)
    mounting[1] = True
    found = score(make_run(tmp_path, TRUTH._replace(reversed=tuple(mounting))))
    assert found.topology_differences == ["module left-1 is mounted forward, the result says reversed"]
    lacking = reorder(TRUTH, SERIALS[:-1])
    found = score(make_run(tmp_path, lacking, dynamics=None))
    assert found.topology_differences == ["module right-2 was not found"]
    assert found.links[-1].link_length_error_mm is None


def test_the_file_says_what_the_score_says(tmp_path: Path) -> None:
    found = score(make_run(tmp_path, TRUTH, predicted=1.05))
    write_json(tmp_path / "score.json", found)
    document = json.loads((tmp_path / "score.json").read_text())
    assert Score.model_validate(document) == found
    assert not list(tmp_path.glob("*.part"))


def test_the_table_shows_every_figure(tmp_path: Path) -> None:
    console = Console(width=200, record=True, file=(tmp_path / "out.txt").open("w"))
    console.print(table(score(make_run(tmp_path, TRUTH, predicted=1.05))))
    text = console.export_text()
    for words in ("correct", "link root - left-1", "5.00%", "61.5 s", "Not identifiable: yaw beyond root"):
        assert words in text


@pytest.mark.parametrize("name", ["result.json", "truth.json", "truth.npz", "held_out.npz"])
def test_a_missing_or_broken_file_is_named(tmp_path: Path, name: str) -> None:
    run = make_run(tmp_path, TRUTH)
    (run / name).write_bytes(b"PK\x03\x04 but no more than that")
    with pytest.raises(ScoreError, match=name):
        score(run)
    (run / name).unlink()
    with pytest.raises(ScoreError, match=f"{name} is missing"):
        score(run)


def test_what_is_wrong_within_a_file_is_named(tmp_path: Path) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"schema": 3}, "schema 3; this program scores schema 2"),
        ({"robot_time_s": "long"}, "robot_time_s: expected a number, found 'long'"),
        ({"null_basis": [[1.0]]}, "null_basis must have 36 rows"),
        ({"serials": ["root"]}, r"serials and chain\.serials differ"),
        (
            {"chain": TRUTH.to_dict() | {"axis": [[0.0, 0.0, 1.0]]}},
            r"chain\.axis has shape \(1, 3\)",
        ),
        ({"chain": TRUTH.to_dict() | {"parent": [1, 0, 1, 2, 0, 4]}}, "every parent before"),
    ]
    for changed, words in cases:
        with pytest.raises(ScoreError, match=words):
            score(make_run(tmp_path, TRUTH, **changed))


def test_a_truth_that_ends_before_the_held_out_motion_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path, TRUTH)
    with np.load(run / "truth.npz") as file:
        arrays = {name: file[name] for name in file.files}
    cut = {name: array if name == "serials" else array[:500] for name, array in arrays.items()}
    np.savez(run / "truth.npz", **cut)
    with pytest.raises(ScoreError, match=r"truth\.npz does not cover the held-out motion of module root"):
        score(run)


def test_two_roots_in_another_order_are_the_same_robot(tmp_path: Path) -> None:
    # A second robot next to the first: the result begins at the other root, so its root frame is another one.
    rng = default_rng(4)
    one, two = TRUTH, TRUTH
    offset = np.eye(4)
    offset[:3, 3] = [1.0, 0.5, 0.0]
    offset[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    pair = Chain(
        serials=(*one.serials, *(f"{s}b" for s in two.serials)),
        parent=(*one.parent, *(p + len(SERIALS) if p >= 0 else -1 for p in two.parent)),
        reversed=(*one.reversed, *two.reversed),
        axis=np.vstack([one.axis, two.axis @ offset[:3, :3].T]),
        point=np.vstack([one.point, two.point @ offset[:3, :3].T + offset[:3, 3]]),
        imu_home=np.concatenate([one.imu_home, offset @ two.imu_home]),
        gravity=one.gravity,
    )
    inverse = np.linalg.inv(offset)
    turned = pair._replace(
        axis=pair.axis @ inverse[:3, :3].T,
        point=pair.point @ inverse[:3, :3].T + inverse[:3, 3],
        imu_home=inverse @ pair.imu_home,
    )
    estimated = reorder(turned, (*pair.serials[len(SERIALS) :], *SERIALS))
    basis = np.linalg.qr(rng.normal(size=(6 * len(pair.serials), 1)))[0]
    position, orientation = tip_errors(estimated, pair, basis)
    assert position < 1e-6
    assert orientation < 1e-6
