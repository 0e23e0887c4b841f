"""The versions of a robot: the current one is replaced in one step, and none is ever lost."""

from pathlib import Path

import pytest

from coordinator.recording.run_folder import RESULT
from coordinator.recording.versions import CURRENT, VERSIONS, VersionError, Versions, current_run

NOW = "2026-01-05T10:00:00+00:00"


def run_in(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / RESULT).write_text("{}")
    return folder


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    return run_in(tmp_path / "arm")


def test_a_robot_that_was_never_measured_again_is_its_first_run(robot: Path) -> None:
    assert current_run(robot) == robot
    assert Versions(robot).current_number == 1
    assert Versions(robot).history == ()


def test_a_new_version_takes_the_place_of_the_current_one_and_the_old_ones_stay(robot: Path) -> None:
    versions = Versions(robot)
    for number in (2, 3):
        assert versions.next_run().name == f"{number:04d}"
        run_in(versions.next_run())
        versions.replace(number, NOW, ["module spare is new"], ["link 1 mm"])
        assert current_run(robot) == robot / VERSIONS / f"{number:04d}"
    # Readers that know nothing of versions reach the files by the link.
    assert (robot / VERSIONS / CURRENT / RESULT).samefile(robot / VERSIONS / "0003" / RESULT)
    assert [(entry.what, entry.version) for entry in versions.history] == [("replaced", 2), ("replaced", 3)]
    assert versions.history[0].why == ("module spare is new",)
    assert (robot / RESULT).is_file()
    assert not list((robot / VERSIONS).glob("*.part"))


def test_a_folder_that_cannot_hold_versions_is_refused_and_one_that_can_is_left_as_it_was(
    robot: Path,
) -> None:
    before = sorted(robot.iterdir())
    Versions(robot).check_writable()
    assert sorted(robot.iterdir()) == before
    (robot / VERSIONS).write_text("a file, which nothing can be written in, not even by root")
    with pytest.raises(VersionError, match=r"where new models are kept, cannot be written: Not a directory"):
        Versions(robot).check_writable()


def test_a_person_goes_back_to_an_earlier_version(robot: Path) -> None:
    versions = Versions(robot)
    run_in(versions.next_run())
    versions.replace(2, NOW, [], [])
    versions.choose(1, NOW)
    assert current_run(robot) == robot
    assert versions.current_number == 1
    # A number is never given twice.
    assert versions.next_run().name == "0003"


def test_a_measurement_that_changed_nothing_is_noted_and_its_number_is_not_used_again(robot: Path) -> None:
    versions = Versions(robot)
    run_in(versions.next_run())
    versions.note("confirmed", 2, NOW, ["unexplained torques"])
    assert current_run(robot) == robot
    assert versions.history[-1].what == "confirmed"
    assert versions.next_run().name == "0003"


def test_a_version_without_a_result_never_becomes_the_current_one(robot: Path) -> None:
    versions = Versions(robot)
    versions.next_run().mkdir(parents=True)
    with pytest.raises(VersionError, match="no version 2"):
        versions.replace(2, NOW, [], [])
    assert current_run(robot) == robot
    assert versions.history == ()


def test_a_link_to_a_version_that_is_gone_is_an_error_and_not_the_first_run(robot: Path) -> None:
    versions = Versions(robot)
    run = run_in(versions.next_run())
    versions.replace(2, NOW, [], [])
    (run / RESULT).unlink()
    with pytest.raises(VersionError, match="--use"):
        current_run(robot)
    versions.choose(1, NOW)
    assert current_run(robot) == robot
