"""A module answers what its own torques say: in parts, once it is computed, and the same as from all rows."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation

from module_agent.firmware.feedback import History
from module_agent.model.chain import Chain
from module_agent.model.information import JointInformation, compress, merge
from module_agent.model.regressor import torque_regressor
from module_agent.peers.row_collection import MotionCollection, OwnRows, Track
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import JointMotion, filtered_motion, resample
from module_agent.signals.torque_terms import term_columns
from module_agent.torque_information.module_information import coupled, own_information
from module_agent.torque_information.serialisation import chain_of, chain_part, clock_part, clocks_of, unpack
from module_agent.torque_information.service import InformationService
from module_agent.wire.information_messages import (
    MAX_PART_BYTES,
    CollectRequest,
    InformationRequest,
    RowRange,
    SpanPart,
)
from module_agent.wire.refusal import Refusal, WireError

STEP_NS, CUTOFF_HZ, ROWS = 4_000_000, 12.0, 900
BOOT, SENDER = 7, "c"
# Two motions, each with room for the spline and the low-pass; the second one at the end of the history.
SPANS = ((1, 100, 300), (2, 450, 350))


def tree(rng: Generator, parent: tuple[int, ...]) -> Chain:
    joints = len(parent)
    axis = rng.normal(size=(joints, 3))
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    return Chain(
        serials=tuple(f"J{k}" for k in range(joints)),
        parent=parent,
        reversed=(False,) * joints,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-0.3, 0.3, (joints, 3)),
        imu_home=home,
        gravity=np.array([1.0, -2.0, 9.5]),
    )


class Robot:
    """Modules with clocks of their own, that have moved for a while."""

    def __init__(self, parent: tuple[int, ...], seed: int = 1):
        rng = default_rng(seed)
        self.chain = tree(rng, parent)
        joints = len(parent)
        drift = rng.uniform(-1e-5, 1e-5, joints)
        self.clocks = [ClockMap(0, 1e9 * rng.uniform(-5.0, 0.0), d, 0.0) for d in drift]
        start = 10**10
        self.t_ns = [
            start + STEP_NS * np.arange(ROWS) + int(rng.integers(0, STEP_NS)) - round(clock.offset_ns)
            for clock in self.clocks
        ]
        self.first_ns = max(int(c.to_session(t)[0]) for c, t in zip(self.clocks, self.t_ns, strict=True))
        self.q = np.cumsum(rng.normal(size=(ROWS, joints)), axis=0) * 0.02
        self.tau = rng.normal(size=(ROWS, joints)).astype("<f4")

    def own_rows(self) -> dict[str, OwnRows]:
        found = {}
        for k, serial in enumerate(self.chain.serials):
            history = History(ROWS)
            for t, q, tau in zip(self.t_ns[k], self.q[:, k], self.tau[:, k], strict=True):
                history.append((int(t), int(t), 0, 0, q, 0.0, tau, *[0.0] * 15))
            found[serial] = OwnRows(BOOT, history)
        return found

    def collect_requests(self) -> list[CollectRequest]:
        rows = tuple(RowRange(serial=s, boot=BOOT, first_row=0, end_row=ROWS) for s in self.chain.serials)
        return [
            CollectRequest(serial="J0", boot=BOOT, seq=1, sender=SENDER, motion_id=number, rows=rows)
            for number, *_ in SPANS
        ]

    def request(self, **changes: Any) -> InformationRequest:
        motions = []
        for number, first, samples in SPANS:
            begin = self.first_ns + STEP_NS * first
            end = begin + STEP_NS * samples
            motions.append(
                SpanPart(motion_id=number, start_ns=begin, end_ns=end, first_ns=begin, samples=samples)
            )
        request = InformationRequest(
            serial="J0",
            boot=BOOT,
            seq=1,
            sender=SENDER,
            chain=chain_part(self.chain),
            clocks=tuple(map(clock_part, self.clocks)),
            motions=tuple(motions),
            step_ns=STEP_NS,
            cutoff_hz=CUTOFF_HZ,
        )
        return request.model_copy(update=changes)

    def tracks(self) -> dict[str, Track]:
        return {
            s: Track(self.t_ns[k], self.q[:, k], self.tau[:, k]) for k, s in enumerate(self.chain.serials)
        }

    def by_all_rows(self) -> tuple[JointInformation, ...]:
        """The information of all joints at once, from the rows of all modules."""
        total: tuple[JointInformation, ...] = ()
        for _, first, samples in SPANS:
            common = self.first_ns + STEP_NS * (first + np.arange(samples))
            times, signals = [], []
            for k, clock in enumerate(self.clocks):
                session = clock.to_session(self.t_ns[k])
                near = (session >= common[0] - 10 * STEP_NS) & (
                    session <= common[0] + STEP_NS * (samples + 10)
                )
                times.append(session[near])
                signals.append(np.column_stack([self.q[near, k], self.tau[near, k]]))
            both = resample(times, signals, common)
            found = self._information(
                filtered_motion(common, both[..., 0], None, both[..., 1], 250.0, CUTOFF_HZ)
            )
            total = merge(total, found) if total else found
        return total

    def _information(self, motion: JointMotion) -> tuple[JointInformation, ...]:
        bodies = torque_regressor(self.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
        terms = term_columns(motion, 250.0, CUTOFF_HZ)
        return compress(np.concatenate([bodies, terms], axis=2), motion.tau_nm)


class Deferred:
    """A worker whose job is done when the test says so."""

    def __init__(self) -> None:
        self.jobs: list[Callable[[], None]] = []

    def submit(self, job: Callable[[], Any], done: Callable[[Any], None]) -> None:
        self.jobs.append(lambda: done(job()))

    def check(self) -> None:
        pass


def far(one: JointInformation, other: JointInformation) -> float:
    assert one.samples == other.samples
    said = [(i.r.T @ i.r, i.r.T @ i.z, np.atleast_1d(i.z @ i.z + i.rest)) for i in (one, other)]
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(*said, strict=True))


def service(robot: Robot, worker: Deferred) -> InformationService:
    found = InformationService("J0", MotionCollection(), worker)
    for request in robot.collect_requests():
        found.collect(request, robot.own_rows(), 0)
    return found


def refusal(found: InformationService, request: InformationRequest) -> WireError:
    with pytest.raises(WireError) as caught:
        found.answer(request)
    return caught.value


@pytest.mark.parametrize("parent", [(-1,), (-1, 0, 1), (-1, 0, 0, 2, -1)])
def test_a_modules_own_information_equals_that_from_the_rows_of_all_modules(
    parent: tuple[int, ...],
) -> None:
    robot = Robot(parent)
    whole = robot.by_all_rows()
    for k, serial in enumerate(robot.chain.serials):
        needed = {robot.chain.serials[i] for i in coupled(robot.chain, k)}
        # What neither carries it nor is carried by it need not be there.
        tracks = {s: t for s, t in robot.tracks().items() if s in needed}
        own = own_information(serial, robot.request(), dict.fromkeys((1, 2), tracks))
        # Both resample, filter and differentiate alike; the bar is 1e-10.
        assert far(own, whole[k]) < 1e-12


def test_joints_depend_on_those_that_carry_them_and_those_they_carry() -> None:
    chain = tree(default_rng(0), (-1, 0, 0, 2, -1))
    assert [coupled(chain, k) for k in range(5)] == [(0, 1, 2, 3), (0, 1), (0, 2, 3), (0, 2, 3), (4,)]


def test_an_answer_is_not_ready_before_it_is_computed_and_is_computed_once() -> None:
    robot, worker = Robot((-1, 0)), Deferred()
    found = service(robot, worker)
    for _ in range(3):
        assert refusal(found, robot.request()).reason is Refusal.BUSY
    assert len(worker.jobs) == 1
    # Meanwhile no other request is begun.
    assert refusal(found, robot.request(cutoff_hz=11.0)).reason is Refusal.BUSY
    worker.jobs[0]()
    assert len(worker.jobs) == 1
    answer = found.answer(robot.request(seq=9))
    assert answer.motion_ids == (1, 2)
    assert far(unpack(answer.part), robot.by_all_rows()[0]) < 1e-12


def test_the_answer_of_many_bodies_comes_in_parts_that_fit_a_message() -> None:
    robot, worker = Robot(tuple(range(-1, 15))), Deferred()
    found = service(robot, worker)
    refusal(found, robot.request())
    worker.jobs[0]()
    block, count, total = b"", 0, 1
    while len(block) < total:
        answer = found.answer(robot.request(offset=len(block)))
        total = answer.total_bytes
        assert 0 < len(answer.part) <= MAX_PART_BYTES
        block += answer.part
        count += 1
    # 164 columns: 13530 doubles and what is about them.
    assert count == 2
    assert len(worker.jobs) == 1
    assert far(unpack(block), robot.by_all_rows()[0]) < 1e-12
    assert refusal(found, robot.request(offset=total)).reason is Refusal.RANGE


def test_a_motion_that_was_not_collected_is_named() -> None:
    robot, worker = Robot((-1, 0)), Deferred()
    found = InformationService("J0", MotionCollection(), worker)
    error = refusal(found, robot.request())
    assert error.reason is Refusal.GONE
    assert "motion 1 was not collected here" in error.detail
    assert worker.jobs == []


def test_a_request_that_cannot_be_computed_is_refused_with_the_reason() -> None:
    robot = Robot((-1, 0))
    late = robot.request().motions[0].model_copy(update={"first_ns": 0})
    for wrong, why in (
        ({"clocks": robot.request().clocks[:1]}, "with 1 clocks"),
        ({"motions": (late,)}, "nothing is extrapolated"),
        ({"chain": chain_part(robot.chain).model_copy(update={"parent": (0, -1)})}, "before its children"),
    ):
        worker = Deferred()
        found = service(robot, worker)
        refusal(found, robot.request(**wrong))
        worker.jobs[0]()
        error = refusal(found, robot.request(**wrong))
        assert error.reason is Refusal.UNFIT
        assert why in error.detail


def test_a_module_keeps_no_motion_without_its_own_rows() -> None:
    robot = Robot((-1, 0))
    found = InformationService("X", MotionCollection(), Deferred())
    with pytest.raises(WireError, match="own rows of X"):
        found.collect(robot.collect_requests()[0], robot.own_rows(), 0)


def test_a_chain_and_its_clocks_survive_the_message_to_the_last_bit() -> None:
    robot = Robot((-1, 0, 0))
    again = chain_of(chain_part(robot.chain))
    assert again[:3] == robot.chain[:3]
    assert all(np.array_equal(a, b) for a, b in zip(again[3:], robot.chain[3:], strict=True))
    for one, other in zip(clocks_of(robot.request().clocks), robot.clocks, strict=True):
        assert one[:3] == other[:3]
