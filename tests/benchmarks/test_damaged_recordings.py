"""Bit flips, damaged sectors and missing ends of a recording: read alike, or said; counts to read."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import SessionWriter
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile import PROFILES
from sim.benchmark.cases.arm import SHORTENED
from sim.benchmark.damaged_files import DAMAGES
from sim.benchmark.sensor_faults import KeptRecording
from sim.imperfections.noise_profile import noise_profile
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session
from tests.benchmarks.bars import report

pytestmark = pytest.mark.benchmark

COUNT = 200
# Of so many damaged files the robot is identified, too: that must end with a result or with a sentence.
IDENTIFIED = 20


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_recordings(tmp_path: Path, damage: str) -> None:
    path, session = tmp_path / "session.mcap", KeptRecording()
    robot = load_robot("thesis_171_horizontal")
    plan = Plan(dynamics=False).model_copy(update=SHORTENED)
    record_session(VirtualSettings(robot, PROFILES["lan"], 1, noise_profile("x5")), plan, recording=session)
    writer = SessionWriter(path)
    for entry in session.entries:
        writer.write(entry)
    writer.close()
    whole, content, draw = load_recording(path), path.read_bytes(), np.random.default_rng(20261123)
    alike = said = 0
    for k in range(COUNT):
        path.write_bytes(DAMAGES[damage](content, draw))
        same = False
        try:
            read = load_recording(path)
            same = (read.trace_hash, read.journal) == (whole.trace_hash, whole.journal)
            told = bool(read.damage or read.remarks)
            if k < IDENTIFIED:
                identify(read)
        except RobotError:
            told = True
        alike, said = alike + (same and not told), said + told
    report(f"recordings with {damage} that are read alike", alike)
    report(f"recordings with {damage} of which it is said", said)
    report(f"recordings with {damage} wrong in silence", COUNT - alike - said, at_most=0)
