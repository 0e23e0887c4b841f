"""A run whose coordinator did not know the truth has it in its recording when it is over."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rerun.chunk import RrdReader

from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.viewer.viewer_process import MergeFailed, merge_into
from sim.imperfections.noise_profile import noise_profile
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import as_built
from sim.scoring.truth_recording import add_truth

BASE, TIP = "X-00009", "X-00010"


def styles(file: Path) -> Counter[str]:
    """How often each entity has been given a style of its lines, colours among it."""
    return Counter(
        chunk.entity_path
        for chunk in RrdReader(str(file)).stream()
        if chunk.is_static and chunk.entity_path.startswith("/modules/")
    )


def table(file: Path, entity: str) -> pd.DataFrame:
    stored: Any = RrdReader(str(file)).stream().collect()
    return stored.reader(index="session_time", contents=entity).to_pandas()


def turns(found: pd.DataFrame, path: str) -> pd.Series:
    """The angle of a body about the base's axis, z, by time."""
    matrices = found[f"{path}:Transform3D:mat3x3"].dropna()
    angles = [float(np.arctan2(m[0][1], m[0][0])) for m in matrices]
    return pd.Series(angles, found["session_time"].loc[matrices.index].to_numpy())


def test_the_true_robot_turns_beside_the_identified_one(
    rigs: Callable[..., Any], quick_plan: Any, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    rigs("thesis_171_vertical", "lan", 3).session(run, quick_plan)
    file = run / "session.rrd"
    before = {chunk.entity_path for chunk in RrdReader(str(file)).stream()}
    assert not [path for path in before if path.startswith("/world/true")]
    layouts, styled = len(RrdReader(str(file)).blueprints()), styles(file)
    assert styled
    said: list[str] = []
    add_truth(run, None, said.append)
    assert said == []
    assert not (run / "truth.rrd").exists()
    reader = RrdReader(str(file))
    assert [entry.recording_id for entry in reader.recordings()] == ["run"]
    # It opens as it did, and nothing of it is lost.
    assert len(reader.blueprints()) == layouts
    # Two programs that order the modules differently would give them other colours.
    assert styles(file) == styled
    assert before < {chunk.entity_path for chunk in reader.stream()}
    length = table(file, f"/estimates/link_length/{TIP}/true")
    (values,) = [length[c].dropna() for c in length if c.endswith(":scalars")]
    robot = as_built(load_robot("thesis_171_vertical"), 3, noise_profile("x5"))
    true_mm = 1e3 * link_lengths(true_chain(robot), np.zeros((12, 12)))[0][1]
    assert [v[0] for v in values] == pytest.approx([true_mm, true_mm], abs=1e-3)
    bodies = {w: f"/world/{w}/body/{BASE}" for w in ("est", "true")}
    shown = {w: turns(table(file, path), path) for w, path in bodies.items()}
    true = shown["true"]
    at = shown["est"].index.intersection(shown["est"].index[shown["est"].index >= true.index[0]])
    nearest = true.iloc[[int(np.argmin(np.abs(true.index - t))) for t in at]].to_numpy()
    # Up to 33 ms apart at 1.5 rad/s, and a degree that gravity may be off.
    apart = np.angle(np.exp(1j * (nearest - shown["est"].loc[at].to_numpy())))
    assert len(at) > 10
    assert np.abs(apart).max() < 0.1


def test_a_run_without_its_truth_keeps_its_recording_and_it_is_said(tmp_path: Path) -> None:
    (tmp_path / "session.rrd").write_bytes(b"as it was")
    said: list[str] = []
    add_truth(tmp_path, None, said.append)
    assert len(said) == 1
    assert "the true robot is not in" in said[0]
    assert (tmp_path / "session.rrd").read_bytes() == b"as it was"


def test_what_is_no_recording_is_not_merged(tmp_path: Path) -> None:
    one, other = tmp_path / "one.rrd", tmp_path / "other.rrd"
    one.write_bytes(b"as it was")
    other.write_bytes(b"neither")
    with pytest.raises(MergeFailed, match=r"one\.rrd is not a Rerun recording"):
        merge_into(one, other)
    assert one.read_bytes() == b"as it was"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.rrd", "other.rrd"]
