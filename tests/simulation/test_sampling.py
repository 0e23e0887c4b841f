"""Whole runs whose IMUs are read at other rates than 250 Hz, or whose rows have a hole in a motion."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.excitation.plan import Plan
from module_agent.wire.feedback_rows import ROW
from sim import simulate
from sim.robot.robot_file import load_robot
from sim.scoring.score import score
from sim.virtual_time.robot import VirtualRobot
from sim.virtual_time.run import VirtualConfig, run_virtual
from tests.breadth import breadth

ARM, BASE, TIP = "thesis_171_horizontal", "X-00009", "X-00010"
SHORTER = Plan(dynamics=False, sine_centre_s=1.6, sine_sigma_s=0.7)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0, *breadth(100.0, 500.0)])
def test_links_are_within_their_claim_at_any_rate_of_the_imus(rate_hz: float) -> None:
    run = simulate(ARM, seed=1, plan=SHORTER, imu_rate_hz=rate_hz)
    result, links = run.identified.result, run.score().links
    for claimed, found in zip(result.links, links, strict=True):
        assert found.link_length_error_mm is not None
        assert abs(found.link_length_error_mm) < 3.0 * claimed.link_length_sigma_mm
    # Agents know a distance too, by samples of their own rate.
    estimates = [e for of_pair in run.recording.estimates.values() for e in of_pair.values()]
    assert not [e.note for e in estimates if e.note]
    slow = [note for note in run.identified.kinematics.notes if "vibration" in note]
    assert len(slow) == (2 if rate_hz == 50.0 else 0)


# About the middle of a motion, after its beginning.
MIDDLE_NS = {"constant": 700_000_000, "windowed_sine": 1_600_000_000}


def _without_rows(serial: str, kind: str) -> Callable[[VirtualRobot], None]:
    """Make a module lose ten rows in the middle of the base module's motion of a kind."""

    def prepare(robot: VirtualRobot) -> None:
        rows = robot.hosts[serial].modules[0].firmware._rows
        due, keep, begins = rows.due, rows.keep, list[int]()

        def lost(now_ns: int) -> bool:
            record = robot.hosts[BASE].modules[0].firmware._record
            if not begins and record is not None and record.pattern.kind == kind and record.end_row is None:
                begins.append(now_ns + MIDDLE_NS[kind])
            return bool(begins) and 0 <= now_ns - begins[0] < 40_000_000

        # A tick's row comes from the firmware's objects or, where nothing arrives, from what is compiled.
        def sometimes_due(now_ns: int, imu_t_ns: int) -> bool:
            return due(now_ns, imu_t_ns) and not lost(now_ns)

        def sometimes_kept(rows: memoryview) -> tuple[int, int] | None:
            each = [rows[start : start + ROW.itemsize] for start in range(0, len(rows), ROW.itemsize)]
            kept = [row for row in each if not lost(int.from_bytes(row[:8], "little"))]
            return keep(memoryview(b"".join(kept)))

        rows.due = sometimes_due  # type: ignore[method-assign]
        rows.keep = sometimes_kept  # type: ignore[method-assign]

    return prepare


@pytest.mark.parametrize(
    ("serial", "kind"),
    [(BASE, "constant"), (TIP, "windowed_sine"), *breadth((BASE, "windowed_sine"), (TIP, "constant"))],
)
def test_a_hole_in_a_motion_costs_the_samples_around_it(tmp_path: Path, serial: str, kind: str) -> None:
    out = tmp_path / "run"
    config = VirtualConfig(load_robot(ARM), out, seed=1, network="none", plan=SHORTER)
    run_virtual(config, between=_without_rows(serial, kind))
    (link,) = score(out).links
    assert link.link_length_error_mm is not None
    result = json.loads((out / "result.json").read_text())
    assert abs(link.link_length_error_mm) < 3.0 * result["links"][0]["link_length_sigma_mm"]
    (note,) = [note for note in result["notes"] if "a hole" in note]
    assert note == f"{serial}: a hole of 44 ms in the {kind} motion of {BASE}, which is split there"
