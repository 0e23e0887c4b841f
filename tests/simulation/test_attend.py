"""A known arm is attended: what lasts is said, and nothing else; without leave it is never moved."""

from pathlib import Path

import pytest

from coordinator.attendant.workspace import Box
from coordinator.identification.identify import identify_kinematics
from coordinator.monitoring.reference import UnsuitableBaseline
from tests.breadth import breadth
from tests.simulation.attended_robot import CHANGES, LAST, ROOM, Scene, remeasured
from tests.simulation.known_arm import ARM, LOADED

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("monitoring")


def test_without_leave_to_move_it_says_what_was_put_on_and_what_left(known_arm: Path, tmp_path: Path) -> None:
    scene = Scene(known_arm, tmp_path / "arm")
    scene.at(6.0, lambda: scene.robot.world.become(LOADED))
    scene.at(34.0, lambda: scene.robot.kill(ARM.serials[-1]))
    scene.plays(42.0, moved_until_s=16.0)
    (stays,) = scene.ears.heard(f"kg added to the body that {ARM.serials[-1]} turns")
    # Named after a few windows of half a second, and said when it has lasted.
    assert 6.0 + 12.0 < stays < 25.0
    (gone,) = scene.ears.heard(f"module {ARM.serials[-1]} has gone")
    assert gone == pytest.approx(34.0 + 5.0, abs=0.6)
    assert len(scene.ears.said) == 5, scene.ears.said
    # No lease was taken: only the mover's was, and the arm has been limp since.
    assert scene.versions.history == ()
    assert all(host.modules[0].firmware.state == "idle" for host in scene.robot.hosts.values())


def test_what_the_run_leaves_open_is_said(
    known_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.monitoring.reference.moved_together", lambda *_: False)
    scene = Scene(known_arm, tmp_path / "arm")
    scene.plays(4.0)
    assert scene.ears.heard("hardly moved its joints together")


@pytest.mark.parametrize("name", ["0.2 kg put on", "a module added", *breadth("a module exchanged")])
def test_what_has_changed_is_measured_again_and_the_new_model_holds(
    name: str, known_arm: Path, tmp_path: Path
) -> None:
    """A displaced link, which takes a minute, and the time that all take, are a benchmark."""
    scene = Scene(known_arm, tmp_path / "arm", ROOM)
    done = remeasured(scene, CHANGES[name])
    assert done.robot_time_s < 120.0
    # Of the few links of one arm one is beyond three sigmas once in a hundred arms.
    assert all(abs(sigmas) < 3.0 for sigmas in done.link_sigmas.values()), done.link_sigmas
    # 2 % of the 1.4 to 1.9 Nm that hold the arm.
    assert done.gravity_nm < 0.04
    assert done.gravity_before_nm is None or done.gravity_before_nm > 5.0 * done.gravity_nm
    (entry,) = scene.versions.history
    assert (entry.what, entry.version) == ("replaced", 2)
    assert scene.versions.current == scene.versions.folder / "versions" / "0002"
    # It began slowly, after a notice, and goes on with the new model without a word.
    assert any("every joint slowly" in line for line in scene.ears.noted)
    (announced,) = scene.ears.heard("THE ROBOT MOVES")
    assert not [text for at_s, text in scene.ears.said if at_s > announced + 100.0]


def test_a_workspace_without_room_keeps_the_model(known_arm: Path, tmp_path: Path) -> None:
    cramped = ROOM.model_copy(update={"box": Box(low_m=(-0.2, -0.2, -0.2), high_m=(0.2, 0.2, 0.2))})
    scene = Scene(known_arm, tmp_path / "arm", cramped)
    scene.at(2.0, lambda: scene.robot.kill(LAST))
    scene.plays(45.0)
    assert scene.ears.heard("could not be measured")
    assert [entry.what for entry in scene.versions.history] == ["failed"]
    assert scene.versions.current == scene.versions.folder


def test_a_folder_in_which_nothing_can_be_written_ends_a_measurement_and_not_the_attendant(
    known_arm: Path, tmp_path: Path
) -> None:
    scene = Scene(known_arm, tmp_path / "arm", ROOM)

    def becomes_useless() -> None:
        # A file in the place of the folder: what is refused to root as well.
        (scene.versions.folder / "versions").write_text("")
        scene.robot.kill(LAST)

    scene.at(2.0, becomes_useless)
    scene.plays(45.0)
    (failed,) = [text for _, text in scene.ears.said if "could not be measured, again in 60 s" in text]
    assert f"cannot use {scene.versions.folder / 'versions'}" in failed
    assert "not noted in the history" in failed
    assert scene.versions.current == scene.versions.folder
    # The watch went on: it could only join the network once the measurement had left it.
    assert scene.loop.now_ns >= 45e9


def test_a_model_that_is_not_to_be_believed_is_no_reason_to_move_the_robot(
    known_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is measured from it would be suspect, too, and the robot moved in vain."""
    why = "a chunk of the recording is lost"
    monkeypatch.setattr(
        "coordinator.baseline.baseline_robot.identify_kinematics",
        lambda *of: identify_kinematics(*of)._replace(damage=(why,)),
    )
    scene = Scene(known_arm, tmp_path / "arm", ROOM)
    with pytest.raises(UnsuitableBaseline, match=why):
        scene.plays(5.0)
    # Without leave to move it is attended.
    scene = Scene(known_arm, tmp_path / "attended")
    scene.plays(5.0)
    assert scene.ears.heard(f"attends {ARM.name}")
    assert scene.ears.heard(f"not to be believed as usual: {why}")


def test_a_second_measurement_is_granted_the_modules_as_the_first_was(
    known_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each begins a connection anew, and with it the numbers of its requests."""
    monkeypatch.setattr("coordinator.monitoring.reference.moved_together", lambda *_: False)
    scene = Scene(known_arm, tmp_path / "arm", ROOM)
    scene.at(2.0, lambda: scene.robot.kill(LAST))
    scene.at(26.0, lambda: scene.robot.boot(LAST))
    scene.at(40.0, lambda: scene.robot.kill(LAST))
    scene.plays(190.0)
    history = [(entry.what, entry.version) for entry in scene.versions.history]
    assert history == [("failed", 2), ("replaced", 3)], scene.ears.said
    # What a model leaves open is said once of each of the two.
    assert len(scene.ears.heard("hardly moved its joints together")) == 2


def test_a_module_that_comes_back_while_the_rest_is_measured_ends_that_by_name(
    known_arm: Path, tmp_path: Path
) -> None:
    scene = Scene(known_arm, tmp_path / "arm", ROOM)
    scene.at(2.0, lambda: scene.robot.kill(LAST))
    # The arm that is left moves from 20 s on, within what was checked without this module.
    scene.at(26.0, lambda: scene.robot.boot(LAST))
    scene.plays(45.0)
    (failed_s,) = scene.ears.heard(f"could not be measured, again in 60 s: module {LAST} came in the middle")
    assert failed_s > 26.0
    assert scene.ears.heard("all modules are as they are known again")
    assert [entry.what for entry in scene.versions.history] == ["failed"]
    assert scene.versions.current == scene.versions.folder
    states = {serial: host.modules[0].firmware.state for serial, host in scene.robot.hosts.items()}
    assert set(states.values()) <= {"idle", "stopped"}, states
