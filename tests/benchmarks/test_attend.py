"""An attendant: from a change of a known arm to a new model, and what it does in hours of nothing.

`X5_ATTEND_HOURS` is how many hours of an arm at rest are attended, each on a day of its own; ten take
about half an hour on one core.
"""

import os
import time
from pathlib import Path

import pytest

from tests.benchmarks.bars import report
from tests.simulation.attended_robot import CHANGES, ROOM, Scene, remeasured
from tests.simulation.known_arm import lived

pytestmark = pytest.mark.benchmark

HOURS = float(os.environ.get("X5_ATTEND_HOURS", "0.1"))
DAY_S = 3600.0


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that the arm is known from."""
    return lived(tmp_path_factory.mktemp("arm") / "known", 0, False)


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_becomes_a_new_model(name: str, known: Path, tmp_path: Path) -> None:
    done = remeasured(Scene(known, tmp_path / "arm", ROOM), CHANGES[name])
    worst = max(done.link_sigmas.values(), key=abs)
    report(f"{name}: robot time to the new model", done.robot_time_s, "s", at_most=120.0)
    report(f"{name}: worst link error by its claim", abs(worst), "sigma", at_most=3.0)
    before_nm = done.gravity_before_nm
    anchor = "" if before_nm is None else f"the model before {1e3 * before_nm:.1f} mNm"
    report(f"{name}: gravity torque fed forward, rms error", 1e3 * done.gravity_nm, "mNm", anchor=anchor)


def test_hours_of_nothing(known: Path, tmp_path: Path) -> None:
    left_s, day, words, leases = 3600.0 * HOURS, 0, [], 0
    begun_s = time.process_time()
    while left_s > 0.0:
        day += 1
        scene = Scene(known, tmp_path / f"arm{day}", ROOM, day=100 + day)
        scene.plays(min(left_s, DAY_S))
        left_s -= DAY_S
        words += [text for _, text in scene.ears.said[1:]]
        leases += sum(host.modules[0].firmware.lease.token for host in scene.robot.hosts.values())
    cpu_s = time.process_time() - begun_s
    report("an arm at rest attended in a second of CPU", 3600.0 * HOURS / cpu_s, "s")
    report(f"alarms in {HOURS:g} h of an arm at rest", len(words), "", at_most=0.0, anchor="; ".join(words))
    report(f"leases taken in {HOURS:g} h of an arm at rest", leases, "", at_most=0.0)
