"""A session's recording as coordinator and agents would leave it: every message, with the run's own writer.

The modules' own estimates are those of their agents' code, computed from the rows as published.
"""

from pathlib import Path
from typing import Any

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from coordinator.recording.run_folder import SESSION
from coordinator.recording.session_file import SessionWriter
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.estimate.observer import Observer
from module_agent.firmware.feedback import History
from module_agent.model.catalogue import module_type
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.peers.motion_listener import JointMotion
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import STATE_NAMES
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    Ack,
    Ask,
    Estimate,
    Feedback,
    Info,
    LeaseRequest,
    Message,
    MotionRecord,
    Status,
)
from tests.second_simulator.motion import BEFORE_S, Motion, Move, planned_motion
from tests.second_simulator.robot import Robot
from tests.second_simulator.sensors import NS, feedback

NAME, SENDER = "pinocchio", "second-simulator"
# The session's clock when recording begins; the shortest round trip, of which the way there may be any share,
# and the mean of what delays a message.
START_NS, TRIP_S, DELAY_S = 7_000_000_000, 6e-4, 5e-4
BATCH_ROWS, LEASE_S, ASKED_S = 5, 0.06, 0.03


def write_session(folder: Path, robot: Robot, plan: Plan, seed: int) -> Path:
    """Let a robot carry out a plan, and write `session.mcap` into a folder; return its path."""
    session = _Session(robot, plan, seed)
    folder.mkdir(parents=True, exist_ok=True)
    writer = SessionWriter(folder / SESSION)
    for entry in session.entries():
        writer.write(entry)
    writer.close()
    return folder / SESSION


class _Session:
    """Collects the messages of a session; times in seconds since it began."""

    def __init__(self, robot: Robot, plan: Plan, seed: int):
        self._robot, self._plan = robot, plan
        self._rng = np.random.default_rng([seed, 5])
        self._motion = planned_motion(robot, plan, seed)
        self._modules = feedback(robot, self._motion, seed, plan.imu)
        self._boots = [int(boot) for boot in self._rng.integers(1, 2**63, len(robot.serials))]
        self._way_s = TRIP_S * self._rng.random(len(robot.serials))
        self._entries: list[Entry] = []
        self._seq = 0

    def entries(self) -> list[Entry]:
        """Return all messages in the order of their times."""
        records = [self._record(number, move) for number, move in enumerate(self._motion.moves, 1)]
        self._journal(0.0, what="session", robot=NAME, imu=self._plan.imu, torque=self._plan.torque)
        for k in range(len(self._robot.serials)):
            self._info(k)
            self._publish_feedback(k)
        self._ask_modules()
        for move, record in zip(self._motion.moves, records, strict=True):
            self._note(move, record)
        self._estimates(self._motion, records)
        self._journal(self._motion.end_s, what="finished", wall_time_s=self._motion.end_s)
        return sorted(self._entries, key=lambda entry: entry.t_ns)

    # ------------------------------------------------------------------ pieces

    def _there_s(self, k: int) -> float:
        """Return how long a message takes to a module."""
        return float(self._way_s[k] + self._rng.exponential(DELAY_S))

    def _back_s(self, k: int) -> float:
        """Return how long a message takes from a module."""
        return float(TRIP_S - self._way_s[k] + self._rng.exponential(DELAY_S))

    def _add(self, kind: Any, leaf: Leaf, t_s: float, message: Message) -> None:
        topic = key(NAME, message.serial, leaf)
        self._entries.append(Entry(kind, topic, START_NS + round(NS * t_s), encode(message)))

    def _journal(self, t_s: float, **fields: Any) -> None:
        event = JournalEvent(t_ns=START_NS + round(NS * t_s), **fields)
        self._entries.append(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))

    def _head(self, k: int, boot: int | None = None) -> dict[str, Any]:
        self._seq += 1
        own = self._boots[k] if boot is None else boot
        return {"serial": self._robot.serials[k], "boot": own, "seq": self._seq}

    def _record(self, number: int, move: Move) -> MotionRecord:
        """Return a motion as its module ran it, and mark its rows."""
        clock, rows = self._modules[move.joint]
        start_ns, end_ns = int(clock.module_ns(move.start_s)), int(clock.module_ns(move.end_s))
        first, end = (int(row) for row in np.searchsorted(rows["t_ns"], (start_ns, end_ns)))
        rows["motion_id"][first:end], rows["state"][first:end] = number, STATE_NAMES.index("moving")
        return MotionRecord(
            motion_id=number,
            pattern=move.pattern,
            outcome="done",
            start_ns=start_ns,
            start_row=first,
            end_row=end,
            origin_rad=move.origin_rad,
        )

    def _info(self, k: int) -> None:
        kind, asked_s = module_type(self._robot.types[k]), 0.05
        ask = Ask(**self._head(k, 0), sender=SENDER)
        self._add("request", Leaf.INFO, asked_s, ask)
        answered_s = asked_s + self._there_s(k)
        info = Info(
            **self._head(k),
            module_type=kind.name,
            firmware="second simulator",
            feedback_rate_hz=250.0,
            batch_rows=BATCH_ROWS,
            history_rows=15_000,
            tick_ns=1_000_000,
            imu_period_ns=4_000_000,
            lifetime_ns=250_000_000,
            expiry_action="motor_off",
            limits=catalogue_limits(kind),
            gains=default_gains(kind, 3),
            t_ns=int(self._modules[k].clock.module_ns(answered_s)),
        )
        self._add("reply", Leaf.INFO, answered_s + self._back_s(k), info)

    def _publish_feedback(self, k: int) -> None:
        clock, rows = self._modules[k]
        for first in range(0, len(rows), BATCH_ROWS):
            batch = rows[first : first + BATCH_ROWS]
            sent_s = float(clock.session_s(batch["t_ns"][-1]))
            message = Feedback(**self._head(k), first_row=first, count=len(batch), rows=batch.tobytes())
            self._add("publication", Leaf.FEEDBACK, sent_s + self._back_s(k), message)

    def _ask_modules(self) -> None:
        """Add the status that the link check asks for, and the leases that keep motions alive."""
        for asked_s in np.arange(0.2, BEFORE_S, ASKED_S).tolist():
            for k in range(len(self._robot.serials)):
                ask = Ask(**self._head(k, 0), sender=SENDER)
                answered_s = asked_s + self._there_s(k)
                self._add("request", Leaf.STATUS, asked_s, ask)
                status = self._status(k, answered_s, "armed", None, re=ask.seq)
                self._add("reply", Leaf.STATUS, answered_s + self._back_s(k), status)
        for asked_s in np.arange(BEFORE_S, self._motion.end_s - 0.1, LEASE_S).tolist():
            for k in range(len(self._robot.serials)):
                self._renew(k, asked_s)

    def _renew(self, k: int, asked_s: float) -> None:
        clock = self._modules[k].clock
        echo_ns, answered_s = int(clock.module_ns(asked_s - 0.02)), asked_s + self._there_s(k)
        lease = LeaseRequest(
            **self._head(k, self._boots[k]), sender=SENDER, action="renew", token=1, echo_ns=echo_ns
        )
        self._add("request", Leaf.LEASE, asked_s, lease)
        ack = Ack(
            **self._head(k),
            re=lease.seq,
            accepted=True,
            t_ns=int(clock.module_ns(answered_s)),
            holder=SENDER,
            lease_left_ns=lease.duration_ns,
            token=1,
        )
        self._add("reply", Leaf.LEASE, answered_s + self._back_s(k), ack)

    def _status(self, k: int, t_s: float, state: Any, motion: MotionRecord | None, re: int = 0) -> Status:
        clock, rows = self._modules[k]
        t_ns = int(clock.module_ns(t_s))
        return Status(
            **self._head(k),
            re=re,
            t_ns=t_ns,
            state=state,
            holder=SENDER,
            lease_left_ns=900_000_000,
            token=1,
            next_row=int(np.searchsorted(rows["t_ns"], t_ns)),
            motion=motion,
            refusals={},
            expiries=0,
            dropped_events=0,
        )

    def _note(self, move: Move, record: MotionRecord) -> None:
        """Publish the status at a motion's begin and end, and journal it."""
        k, running = move.joint, record.model_copy(update={"outcome": "running", "end_row": None})
        for t_s, state, motion in ((move.start_s, "moving", running), (move.end_s, "armed", record)):
            status = self._status(k, t_s, state, motion)
            self._add("publication", Leaf.STATUS, t_s + self._back_s(k), status)
        if move.purpose != "other":
            serial = self._robot.serials[k]
            step = {"rest": "rest", "dynamic": f"excite/{serial}", "held_out": f"held_out/{serial}"}
            fields = {"serial": serial, "boot": self._boots[k], "purpose": move.purpose, "motion": record}
            name = step.get(move.purpose, f"explore/{serial}")
            self._journal(move.end_s + 0.02, what="motion", step=name, **fields)

    def _estimates(self, motion: Motion, records: list[MotionRecord]) -> None:
        """Publish every agent's estimate of every exploration motion."""
        rests = {
            move.joint: r for move, r in zip(motion.moves, records, strict=True) if move.purpose == "rest"
        }
        explored = [
            (move, self._heard(move, record))
            for move, record in zip(motion.moves, records, strict=True)
            if move.purpose in ("constant", "windowed_sine")
        ]
        for k, serial in enumerate(self._robot.serials):
            history = _history(self._modules[k].rows)
            observer = Observer(serial, self._boots[k], IMU_PRIORS[self._plan.imu])
            for move, heard in explored:
                finding = observer.job(heard, history, rests[k])()
                estimate = Estimate(**self._head(k), **finding._asdict())
                self._add("publication", Leaf.ESTIMATE, move.end_s + 0.3, estimate)

    def _heard(self, move: Move, record: MotionRecord) -> JointMotion:
        """Return a motion as the agents of the other modules know it, with clocks mapped by arrivals."""
        serial, rows = self._robot.serials[move.joint], self._modules[move.joint].rows
        own = self._modules[move.joint].clock.module_ns(move.start_s)
        offsets = {
            other: int(self._modules[k].clock.module_ns(move.start_s + TRIP_S) - own)
            for k, other in enumerate(self._robot.serials)
        }
        assert record.end_row is not None
        return JointMotion(
            serial, self._boots[move.joint], record, rows[record.start_row : record.end_row], offsets
        )


def _history(rows: Any) -> History:
    history = History(len(rows))
    for *values, gyro, accel in rows.tolist():
        history.append((*values, *gyro, *accel))
    return history
