"""The regressor against pinocchio's: equality, and processor time in the same process.

Pinocchio is a development dependency; without it only our own time is measured.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from coordinator.dynamics.pseudo_inertia import parameter_transform
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import (
    PER_BODY,
    RegressorStream,
    inverse_dynamics,
    regressor_chunks,
    torque_regressor,
)
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, largest, ratio
from sim.geometry.pose import pose

JOINTS, SAMPLES, CHUNK = 7, 4000, 50
_TREES, _TREE_SAMPLES = 5, 20
# In pinocchio's order: mass, first moments, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
_PINOCCHIO = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]


class RegressorTrial(NamedTuple):
    """Microseconds per sample, minima of repeats.

    batch_us: of `regressor_chunks` for all samples; array_us: into new memory; chunks_us: of `CHUNK` samples.
    stream_us: one after the other. torque_us: of inverse dynamics. loop_us: of pinocchio's loop.
    difference: largest difference from pinocchio's regressor on random trees, relative to the largest entry.
    loop_us and difference are None if pinocchio is not installed.
    """

    batch_us: float
    array_us: float
    chunks_us: float
    stream_us: float
    torque_us: float
    loop_us: float | None
    difference: float | None


def regressor_trial(seed: int, repeats: int) -> RegressorTrial:
    """Compare the regressor on random trees, and time it on one chain of `JOINTS` joints."""
    rng = np.random.default_rng(seed)
    chain = _tree(rng, JOINTS, tuple(range(-1, JOINTS - 1)))
    motion = _motion(rng, SAMPLES, JOINTS)
    phi = rng.normal(size=PER_BODY * JOINTS)
    stream = RegressorStream(chain)

    def batch() -> None:
        for _ in regressor_chunks(chain, *motion):
            pass

    def array() -> None:
        torque_regressor(chain, *motion)

    def one_by_one() -> None:
        for sample in zip(*motion, strict=True):
            stream.rows(*sample)

    def torque() -> None:
        inverse_dynamics(chain, phi, *motion)

    def chunks() -> None:
        for begin in range(0, SAMPLES, CHUNK):
            torque_regressor(chain, *(signal[begin : begin + CHUNK] for signal in motion))

    works: list[Callable[[], None]] = [batch, array, chunks, one_by_one, torque]
    try:
        import pinocchio as pin
    except ImportError:
        return RegressorTrial._make([*_costs_us(works, repeats), None, None])
    model = _model(pin, chain)
    data = model.createData()

    def loop() -> None:
        for q, qd, qdd in zip(*motion, strict=True):
            pin.computeJointTorqueRegressor(model, data, q, qd, qdd)

    difference = max(_difference(pin, rng) for _ in range(_TREES))
    return RegressorTrial._make([*_costs_us([*works, loop], repeats), difference])


def _costs_us(works: Sequence[Callable[[], None]], repeats: int) -> list[float]:
    """Return the least processor time of each, measured in turns: other processes only add to it."""
    for work in works:
        work()  # compiled, or loaded, here
    least = [float("inf")] * len(works)
    for _ in range(repeats):
        for k, work in enumerate(works):
            begun = time.process_time()
            work()
            least[k] = min(least[k], time.process_time() - begun)
    return [1e6 * spent / SAMPLES for spent in least]


def _tree(rng: np.random.Generator, joints: int, parents: tuple[int, ...]) -> Chain:
    axis = rng.normal(size=(joints, 3))
    return Chain(
        serials=tuple(f"J{i}" for i in range(joints)),
        parent=parents,
        reversed=(False,) * joints,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-0.5, 0.5, (joints, 3)),
        imu_home=np.tile(np.eye(4), (joints, 1, 1)),
        gravity=rng.normal(size=3) * 5.0,
    )


def _motion(rng: np.random.Generator, samples: int, joints: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = rng.uniform(-3.0, 3.0, (3, samples, joints))
    return q, qd, qdd


def _model(pin: Any, chain: Chain) -> Any:
    """Return pinocchio's model: joint frames parallel to the root frame at q = 0, origins on the axes."""
    model = pin.Model()
    model.gravity.linear = -chain.gravity
    for i, parent in enumerate(chain.parent):
        below = np.zeros(3) if parent < 0 else chain.point[parent]
        joint = pin.JointModelRevoluteUnaligned(chain.axis[i])
        placement = pin.SE3(np.eye(3), chain.point[i] - below)
        model.addJoint(parent + 1, joint, placement, chain.serials[i])
    return model


def _difference(pin: Any, rng: np.random.Generator) -> float:
    joints = int(rng.integers(2, 10))
    chain = _tree(rng, joints, tuple(int(rng.integers(-1, i)) if i else -1 for i in range(joints)))
    motion = _motion(rng, _TREE_SAMPLES, joints)
    model = _model(pin, chain)
    data = model.createData()
    ours = torque_regressor(chain, *motion)
    # From ten parameters about the root's origin to those about a point of the axis, axes parallel.
    into = [parameter_transform(pose(-point)) for point in chain.point]
    worst = 0.0
    for row, q, qd, qdd in zip(ours, *motion, strict=True):
        theirs = np.atleast_2d(pin.computeJointTorqueRegressor(model, data, q, qd, qdd))
        blocks = [
            theirs[:, PER_BODY * j : PER_BODY * (j + 1)][:, _PINOCCHIO] @ into[j] for j in range(joints)
        ]
        worst = max(worst, float(np.abs(row - np.hstack(blocks)).max() / np.abs(row).max()))
    return worst


EQUAL_BELOW = 1e-12
# Alone on a machine it is 0.12; trials run next to one another.
BATCH_SHARE = 0.25
CHUNK_US = 20.0
_REPEATS = 9


def regressor_cases(seed: int) -> list[Case]:
    """Return the one case; it compares with pinocchio where that is installed."""
    name = f"regressor, {JOINTS} joints, {SAMPLES} samples"
    return [Case(name, [Trial(regressor_trial, (seed, _REPEATS), 4.0)], _summary, "none", "the true model")]


def _summary(trials: Sequence[RegressorTrial]) -> Summary:
    compared = [trial for trial in trials if trial.loop_us is not None]
    chunks_us = largest([trial.chunks_us for trial in trials])
    rows = [Row(f"in chunks of {CHUNK} [us a sample]", chunks_us, CHUNK_US)]
    if compared:
        difference = largest([trial.difference for trial in compared])
        share = largest([ratio(trial.batch_us, trial.loop_us) for trial in compared])
        rows += [
            Row("difference from pinocchio's [relative]", difference, EQUAL_BELOW),
            Row("cost of a batch over pinocchio's loop", share, BATCH_SHARE),
        ]
    return Summary(rows)
