"""The command looks at a recording as if it happened now, and says by its exit code what it found."""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.main import app
from coordinator.recording.session_file import SessionWriter, read_session
from tests.simulation.known_arm import ARM, GRASPED_S, lived

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("monitoring")


@pytest.fixture(scope="module")
def known(known_arm: Path) -> Iterator[Path]:
    """The run that the robot is known from; the commands of this file identify its robot once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coordinator.commands.monitor.load_baseline", cache(load_baseline))
        yield known_arm


def watch(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["monitor", *words])
    return done.exit_code, done.output


def test_the_run_that_a_robot_is_known_from_is_quiet(known: Path) -> None:
    code, findings = watch(str(known), "--recording", str(known / "session.mcap"))
    assert code == 0, findings
    assert "no findings" in findings


def test_what_the_robot_grasped_meanwhile_is_found_and_written_down(known: Path, tmp_path: Path) -> None:
    later = lived(tmp_path / "later", 1, True)
    file = tmp_path / "found.jsonl"
    code, findings = watch(str(known), "--recording", str(later / "session.mcap"), "--json", str(file))
    assert code == 4, findings
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    (finding,) = lines[-1]["findings"]
    assert (finding["kind"], finding["serial"]) == ("payload", ARM.serials[-1])
    # 3 %, as a payload that is searched for.
    assert finding["size"] == pytest.approx(0.2, abs=0.006)
    assert finding["since_ns"] == pytest.approx(GRASPED_S * 1e9, abs=1e9)


def test_what_a_baseline_leaves_untold_is_refused_and_what_is_suspect_said_by_the_exit_code(
    known: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = load_baseline(known)
    lacking = robot._replace(kinematics=robot.kinematics._replace(missing=("X-66666 took no part",)))
    monkeypatch.setattr("coordinator.commands.monitor.load_baseline", lambda folder: lacking)
    code, said = watch(str(known), "--recording", str(known / "session.mcap"))
    assert code == 2
    assert "does not tell the robot's inertia: X-66666 took no part" in " ".join(said.split())
    damaged = robot._replace(kinematics=robot.kinematics._replace(damage=("a chunk is lost",)))
    monkeypatch.setattr("coordinator.commands.monitor.load_baseline", lambda folder: damaged)
    code, said = watch(str(known), "--recording", str(known / "session.mcap"))
    assert code == 5
    assert "is not to be believed as usual: a chunk is lost" in " ".join(said.split())


def test_wrong_usage_is_answered_with_what_would_be_right(known: Path, tmp_path: Path) -> None:
    assert watch(str(tmp_path))[0] == 2
    code, findings = watch(str(known), "--recording", str(tmp_path / "none.mcap"))
    assert code == 2
    assert "none.mcap" in findings
    assert watch(str(known), "--json", str(tmp_path / "no" / "file"), "--recording", "x")[0] == 2


def test_a_recording_in_which_nothing_can_be_compared_is_not_a_quiet_one(known: Path, tmp_path: Path) -> None:
    """The first module's feedback ends before that of the others begins."""
    first, *others = ARM.serials
    writer, begun_ns = SessionWriter(tmp_path / "apart.mcap"), 0
    for entry in read_session(known / "session.mcap"):
        begun_ns = begun_ns or entry.t_ns
        is_early = entry.t_ns < begun_ns + 15_000_000_000
        is_feedback = entry.kind == "publication" and entry.topic.endswith("/feedback")
        if not is_feedback or is_early == (f"/{first}/" in entry.topic):
            writer.write(entry)
    writer.close()
    code, said = watch(str(known), "--recording", str(tmp_path / "apart.mcap"))
    assert code == 1, said
    assert f"nothing was compared: for no 0.5 s all of {first}, {others[0]}" in " ".join(said.split())
