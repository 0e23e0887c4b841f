"""Messages as modules and coordinator send them, with all that a test does not care about filled in."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.firmware.config import FirmwareConfig
from module_agent.model.catalogue import module_type
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    Ack,
    Ask,
    Estimate,
    Feedback,
    Info,
    Message,
    MotionRecord,
    Pattern,
    Status,
)

ROBOT = "robot"


def rows(first: int, count: int) -> np.ndarray:
    """Rows at 250 Hz whose position is their number, so that a mix-up shows."""
    found = np.zeros(count, dtype=ROW)
    found["t_ns"] = 4_000_000 * np.arange(first, first + count)
    found["imu_t_ns"] = found["t_ns"]
    found["position_rad"] = np.arange(first, first + count)
    return found


def feedback(serial: str = "A", boot: int = 1, first: int = 0, count: int = 5, **more: Any) -> Feedback:
    block = more.pop("rows", None)
    block = rows(first, count) if block is None else block
    return Feedback(
        serial=serial,
        boot=boot,
        seq=first,
        first_row=first,
        count=len(block),
        rows=block.tobytes(),
        **more,
    )


def status(serial: str = "A", boot: int = 1, t_ns: int = 0, **more: Any) -> Status:
    fields: dict[str, Any] = {
        "seq": 1,
        "state": "armed",
        "holder": None,
        "lease_left_ns": 0,
        "token": 0,
        "next_row": 0,
        "motion": None,
        "refusals": {},
        "expiries": 0,
        "dropped_events": 0,
    }
    return Status(serial=serial, boot=boot, t_ns=t_ns, **{**fields, **more})


def ack(serial: str = "A", boot: int = 1, re: int = 0, t_ns: int = 0, accepted: bool = True) -> Ack:
    return Ack(
        serial=serial,
        boot=boot,
        seq=1,
        re=re,
        accepted=accepted,
        t_ns=t_ns,
        holder=None,
        lease_left_ns=0,
        token=1,
    )


def ask(serial: str = "A", seq: int = 1) -> Ask:
    return Ask(serial=serial, boot=0, seq=seq, sender="tester")


def info(serial: str = "A", boot: int = 1, kind: str = "X5-4", t_ns: int = 0, **more: Any) -> Info:
    found = module_type(kind)
    return Info(
        serial=serial,
        boot=boot,
        seq=1,
        module_type=kind,
        firmware="test",
        feedback_rate_hz=250.0,
        batch_rows=5,
        history_rows=15_000,
        tick_ns=1_000_000,
        imu_period_ns=4_000_000,
        lifetime_ns=250_000_000,
        expiry_action="motor_off",
        limits=catalogue_limits(found),
        gains=default_gains(found, 3),
        t_ns=t_ns,
        **more,
    )


def estimate(
    joint: str, observer: str = "A", boot: int = 1, ids: tuple[int, ...] = (1,), **more: Any
) -> Estimate:
    fields: dict[str, Any] = {"moved": True, "rate_ratio": 1.0, "circle": None, "note": ""}
    return Estimate(
        serial=observer,
        boot=boot,
        seq=1,
        joint=joint,
        motion_ids=ids,
        gravity_m_s2=(0.0, 0.0, 9.81),
        **{**fields, **more},
    )


def record(
    motion_id: int, pattern: Pattern, start: int, end: int | None, outcome: str = "done"
) -> MotionRecord:
    return MotionRecord.model_validate(
        {
            "motion_id": motion_id,
            "pattern": pattern,
            "outcome": outcome,
            "start_ns": 4_000_000 * start,
            "start_row": start,
            "end_row": end,
            "origin_rad": 0.0,
        }
    )


def publication(leaf: Leaf, message: Message, t_ns: int = 0, on: str | None = None) -> Entry:
    return Entry("publication", key(ROBOT, on or message.serial, leaf), t_ns, encode(message))


def request(leaf: Leaf, message: Message, t_ns: int = 0) -> Entry:
    return Entry("request", key(ROBOT, message.serial, leaf), t_ns, encode(message))


def reply(leaf: Leaf, message: Message, t_ns: int = 0, on: str | None = None) -> Entry:
    return Entry("reply", key(ROBOT, on or message.serial, leaf), t_ns, encode(message))


def journal(what: str, t_ns: int = 0, **fields: Any) -> Entry:
    event = JournalEvent.model_validate({"t_ns": t_ns, "what": what, **fields})
    return Entry("journal", JOURNAL_TOPIC, t_ns, event.encode())


def config(serial: str, boot: int = 1, kind: str = "X5-4", **more: Any) -> FirmwareConfig:
    found = module_type(kind)
    return FirmwareConfig(serial=serial, kind=found, boot=boot, limits=catalogue_limits(found), **more)


@pytest.fixture
def wire() -> SimpleNamespace:
    return SimpleNamespace(
        robot=ROBOT,
        rows=rows,
        feedback=feedback,
        status=status,
        ack=ack,
        ask=ask,
        info=info,
        estimate=estimate,
        record=record,
        publication=publication,
        request=request,
        reply=reply,
        journal=journal,
        config=config,
    )
