"""A session with a trial moves every joint slowly first; one that does not come along ends it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coordinator.session.session import JointBlocked
from sim.virtual_time.run import QUICK_PLAN
from tests.rig import Rig

ROBOT = "thesis_171_horizontal"
PLAN = QUICK_PLAN.model_copy(update={"trial_speed_rad_s": 0.2})


def test_a_blocked_joint_ends_the_session_before_anything_moves_fast(
    rigs: Callable[..., Rig], tmp_path: Path
) -> None:
    rig = rigs(ROBOT)
    blocked = rig.serials[-1]
    # A gear that is stuck: more friction than its motor can overcome.
    rig.world.change_friction(blocked, 1e4)
    with pytest.raises(JointBlocked, match=rf"joint {blocked} was to move by \+0\.080 rad"):
        rig.session(tmp_path / "run", PLAN)
    motion = rig.truth.motion()
    # Peaks of a minimum-jerk motion with what the position loop adds; travelling would be at 1.5 rad/s.
    assert np.abs(motion.qd_rad_s[motion.t_ns > 10**9]).max() < 0.4
    assert {rig.state(serial) for serial in rig.serials} == {"stopped"}


def test_a_sound_robot_passes_its_trial_and_is_identified(rigs: Callable[..., Rig], tmp_path: Path) -> None:
    rig = rigs(ROBOT)
    result = rig.session(tmp_path / "run", PLAN)
    assert result.serials == list(rig.serials)
    steps = [line for line in rig.notes if "every joint slowly" in line]
    assert len(steps) == 1
