"""A known arm is attended: what lasts is said, and nothing else; without leave it is never moved."""

from pathlib import Path

import pytest

from tests.simulation.attended_robot import Scene
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
