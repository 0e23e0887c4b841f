"""Every invariant has a canary: a build that is broken on purpose, in which the search finds the violation.

A search over the first 500 seeds has each of these. The same seeds find nothing in the build as it is.
"""

import asyncio
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.identification.result import Result, write_result
from coordinator.live_robot.errors import ModuleLost
from coordinator.recording.session_file import SessionWriter
from coordinator.session.run import Run
from coordinator.session.session import Session
from module_agent.firmware.admission import Admission
from module_agent.firmware.firmware import Answer, Firmware
from module_agent.hardware import motor_guard
from module_agent.hardware.motor_guard import MotorGuard
from module_agent.wire.messages import MotionCommand, Setpoint
from sim.faults import run
from sim.faults.report import run_seed
from sim.faults.schedule import Schedule, draw


def session(seed: int) -> Schedule:
    return draw(seed, planned="short")


def found(seed: int) -> dict[str, str]:
    return run_seed(session(seed), shrinks=False).violations


# The coordinator of two joints is killed in mid motion, and not started again.
KILLED = 89
# An agent freezes before its joint was explored, which ends the session.
FROZEN = 289
# An intruder commands in the holder's name; later a torque sensor breaks, which ends the session.
STOLEN = 81
# So does one while the joint that it commands is held, and set-points would be followed.
FORGED = 284
# Messages are corrupted while joints move.
CORRUPTED = 10
# A program with the holder's secret drives a joint by full PWM.
RECKLESS = 57
# Another swings one at twice the speed of its type, until the coordinator notices and stops the robot.
STOPPED = 68
# Something holds a motor while its joint is to move, and lets it go.
HELD = 39
# A motor is too hot while the session begins.
HOT = 125
# Some messages arrive twice, which changes nothing.
HARMLESS = 102
# So do they to an arm that hangs, of which a short session tells the zero of its first joint.
HARMLESS_HANGING = 7


@pytest.mark.parametrize(
    "seed", [KILLED, FROZEN, STOLEN, FORGED, RECKLESS, STOPPED, HOT, HARMLESS, HARMLESS_HANGING]
)
def test_the_build_as_it_is_violates_nothing(seed: int) -> None:
    assert found(seed) == {}


def test_a_right_robot_tells_how_wide_its_claims_are() -> None:
    """Which no invariant bounds: a claim that is wide enough is never wrong."""
    report = run_seed(session(HARMLESS))
    assert report.outcome == "right"
    assert report.claim is not None
    assert report.claim.link == " - ".join(session(HARMLESS).robot.serials)
    # Short motions and the catalogue's places of IMUs leave some millimetres, and parts of a degree.
    assert 0.5 < report.claim.mm < 5.0
    assert 0.05 < report.claim.deg < 1.0
    assert run_seed(session(FROZEN)).claim is None


def test_firmware_that_does_not_expire_drives_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Firmware, "_expire", lambda firmware: None)
    monkeypatch.setattr("module_agent.firmware.firmware.Lease.lapsed", lambda lease, now_ns: False)
    assert set(found(KILLED)) == {"driven too late"}


def test_a_module_that_ignores_stops_drives_after_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Firmware, "_stop", lambda firmware, note: None)
    assert set(found(STOPPED)) == {"driven after a stop"}


def test_a_guard_that_does_not_limit_lets_too_much_pwm_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MotorGuard, "limit", lambda guard, pwm, sample: 100.0 * pwm)
    assert "PWM out of range" in found(STOLEN)


def test_a_guard_without_positions_lets_a_joint_be_driven_out_of_its_range(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(motor_guard._ACTIONS, "hold", motor_guard.FREE)
    assert "driven beyond its range" in found(RECKLESS)


def test_a_coordinator_with_a_defect_is_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def defect(serial: str, why: str) -> None:
        raise KeyError(serial)

    monkeypatch.setattr("coordinator.live_robot.errors.ModuleLost.__init__", lambda *_: defect("X", "y"))
    assert set(found(FROZEN)) == {"traceback"}


def test_a_coordinator_that_logs_a_defect_and_goes_on_is_a_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def logs_and_goes_on(run: Run, preview: Any) -> None:
        try:
            raise KeyError("X")
        except KeyError:
            logging.getLogger("coordinator").exception("a defect of ours")

    monkeypatch.setattr(Run, "_show_preview", logs_and_goes_on)
    violations = found(HARMLESS)
    assert set(violations) == {"traceback"}
    assert "logged: KeyError at test_canaries.py" in violations["traceback"]


def test_a_coordinator_whose_preview_has_a_defect_is_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "coordinator.identification.preview.assemble", lambda *_: np.linalg.norm("not a matrix")
    )
    assert set(found(HARMLESS)) == {"traceback"}


def test_a_module_that_takes_any_proof_gets_two_holders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("module_agent.firmware.admission.hmac.compare_digest", lambda one, other: True)
    monkeypatch.setattr("module_agent.firmware.admission.is_proven", lambda payload, secret: True)
    assert "two holders" in found(STOLEN)


@pytest.mark.parametrize("kind", [Setpoint, MotionCommand])
def test_a_module_that_admits_any_command_of_a_kind_obeys_a_stranger(
    monkeypatch: pytest.MonkeyPatch, kind: type[Setpoint | MotionCommand]
) -> None:
    check = Admission.check_command

    def admit(admission: Admission, command: Any, *how: Any) -> None:
        if not isinstance(command, kind):
            check(admission, command, *how)

    monkeypatch.setattr(Admission, "check_command", admit)
    assert set(found(FORGED)) == {"command of a stranger"}


def test_a_coordinator_that_mixes_up_its_modules_misnames_the_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    def mixed_up(error: ModuleLost, serial: str, why: str) -> None:
        other = {"X-00009": "X-00010", "X-00010": "X-00009"}[serial]
        Exception.__init__(error, f"module {other} is lost: {why}")
        error.serial = other

    assert run_seed(session(FROZEN)).outcome == "named"
    monkeypatch.setattr(ModuleLost, "__init__", mixed_up)
    assert run_seed(session(FROZEN)).outcome == "misnamed"


def test_a_guard_that_does_not_bound_the_speed_lets_a_motor_be_too_fast(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("module_agent.hardware.motor_guard.OVERSPEED", 10.0)
    assert set(found(HELD)) == {"speed beyond the limit"}


def test_a_module_that_does_not_mind_its_winding_drives_it_too_hot(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds_of, enter, finish = motor_guard.bounds_of, Firmware._enter, Firmware._finish_motion
    monkeypatch.setattr(motor_guard, "bounds_of", lambda *of: bounds_of(*of)._replace(ceiling_c=1e9))
    monkeypatch.setattr(
        Firmware, "_enter", lambda own, trigger, note="": trigger == "fault" or enter(own, trigger, note)
    )
    monkeypatch.setattr(
        Firmware, "_finish_motion", lambda own, outcome: outcome == "fault" or finish(own, outcome)
    )
    assert "driven too hot" in found(HOT)


def test_an_agent_that_dies_of_a_message_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    def receive(firmware: Firmware, incoming: Any) -> None:
        answer = firmware._dispatch(incoming)
        if incoming.request is not None:
            firmware._out.append(Answer(incoming.request, answer))

    monkeypatch.setattr(Firmware, "_receive", receive)
    assert "agent died" in found(CORRUPTED)


def test_a_writer_that_loses_its_file_makes_it_unreadable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    close = SessionWriter.close

    def lose(writer: Any) -> None:
        close(writer)
        path = Path(writer._file.name)
        content = path.read_bytes()
        path.write_bytes(b"\0" * len(content))

    monkeypatch.setattr(SessionWriter, "close", lose)
    assert "unreadable recording" in found(FROZEN)


def test_a_session_that_waits_for_ever_is_unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait(session: Session, expected: int) -> None:
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr(Session, "run", wait)
    monkeypatch.setattr(run, "LIMIT_S", 5.0)
    assert set(found(FROZEN)) == {"unbounded"}


def displaced_link(chain: Any) -> None:
    for row in chain["imu_home"][1][:3]:
        row[3] += 0.1


def tilted_axis(chain: Any) -> None:
    """About the foot of the perpendicular to the IMU, by 4 degrees: the length stays what it is."""
    axis, point, place = (
        np.array(chain[name][k]) for name, k in (("axis", 0), ("point", 0), ("imu_home", 1))
    )
    along = axis * (axis @ (place[:3, 3] - point))
    across = place[:3, 3] - point - along
    tilt = Rotation.from_rotvec(np.radians(4.0) * across / np.linalg.norm(across))
    chain["point"][0], chain["axis"][0] = (point + along).tolist(), tilt.apply(axis).tolist()


def lost_zero(chain: Any) -> None:
    """The joint's zero is 10 degrees off: length, way across and axis stay what they are."""
    axis, point, place = (
        np.array(chain[name][k]) for name, k in (("axis", 0), ("point", 0), ("imu_home", 1))
    )
    turn = Rotation.from_rotvec(np.radians(10.0) * axis)
    place[:3] = np.column_stack([turn.as_matrix() @ place[:3, :3], point + turn.apply(place[:3, 3] - point)])
    chain["imu_home"][1] = place.tolist()


def turned_gravity(chain: Any) -> None:
    gravity = np.array(chain["gravity"])
    aside = np.cross(gravity, chain["imu_home"][1][0][:3])
    turn = Rotation.from_rotvec(np.radians(5.0) * aside / np.linalg.norm(aside))
    chain["gravity"] = turn.apply(gravity).tolist()


@pytest.mark.parametrize(
    ("defect", "seed", "words"),
    [
        (displaced_link, HARMLESS, "the length is"),
        (tilted_axis, HARMLESS, "the axis is"),
        (lost_zero, HARMLESS_HANGING, "the tips are"),
        (turned_gravity, HARMLESS, "gravity is"),
    ],
)
def test_a_result_that_is_wrong_in_one_way_is_a_wrong_robot(
    monkeypatch: pytest.MonkeyPatch, defect: Callable[[Any], None], seed: int, words: str
) -> None:
    def write(path: Path, result: Result) -> None:
        write_result(path, result)
        written = json.loads(path.read_text())
        defect(written["chain"])
        path.write_text(json.dumps(written))

    monkeypatch.setattr("coordinator.session.run.write_result", write)
    violations = found(seed)
    assert set(violations) == {"wrong robot"}
    assert words in violations["wrong robot"]
