"""The true parameters and motion of a simulated robot, in files against which a run is scored.

`truth.json` holds the robot's constants, `truth.npz` the true motion, as a `TruthLog` records it. Files are
replaced atomically.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware.hardware import Readings
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.files import replacing, write_json
from module_agent.model.read_only import make_read_only, read_only
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors
from sim.robot.robot_file import Robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.sensors.module_clock import ModuleClock, module_time
from sim.world.world import TICK_NS, World
from sim.world.world_kernel import keep_truth

VERSION = 1
# The ticks of a call in which nothing else happens.
MANY_TICKS = 256
# Every how many ticks the true motion is recorded: as often as modules report theirs.
EVERY_TICKS = 4
# Rows of a block of a `TruthLog`: 16 s of every fourth tick.
_BLOCK_ROWS = 4096


class Truth(NamedTuple):
    """A robot's constants; frames and order as in `chain`.

    inertia: (n, 10) every body's parameters in the root frame at q = 0 (see
    `sim.robot.robot_tree.true_inertia`).
    clocks, imu_bias (n, 6; gyro, accelerometer) and sensor_errors are those of one world, or None.
    """

    robot: str
    module_types: tuple[str, ...]
    chain: Chain
    inertia: Array
    clocks: tuple[ModuleClock, ...] | None
    imu_bias: Array | None
    sensor_errors: SensorErrors | None = None


class Motion(NamedTuple):
    """The true motion of T instants, n joints, read-only; all of one row belongs to one instant.

    t_ns: (T,) world time. clock_ns: (T, n) the modules' clocks. q_rad, qd_rad_s, spring_torque_nm: (T, n).
    """

    serials: tuple[str, ...]
    t_ns: np.ndarray[Any, np.dtype[np.int64]]
    clock_ns: np.ndarray[Any, np.dtype[np.int64]]
    q_rad: Array
    qd_rad_s: Array
    spring_torque_nm: Array


def truth_of(robot: Robot, world: World | None = None) -> Truth:
    """Return the constants of a robot, as built in the world it lives in if there is one."""
    robot = robot if world is None else world.robot
    return Truth(
        robot=robot.name,
        module_types=tuple(m.type for m in robot.modules),
        chain=true_chain(robot),
        inertia=true_inertia(robot),
        clocks=None if world is None else world.sensors.clocks,
        imu_bias=None if world is None else world.sensors.errors.imu_bias,
        sensor_errors=None if world is None else world.sensors.errors,
    )


def write_truth(path: Path, robot: Robot, world: World | None = None) -> None:
    """Write `truth_of` as JSON, atomically."""
    truth = truth_of(robot, world)
    clocks, bias, errors = truth.clocks, truth.imu_bias, truth.sensor_errors
    document = truth._asdict() | {
        "chain": truth.chain.to_dict(),
        "inertia": truth.inertia.tolist(),
        "clocks": None if clocks is None else [clock._asdict() for clock in clocks],
        "imu_bias": None if bias is None else bias.tolist(),
        "sensor_errors": None if errors is None else {k: v.tolist() for k, v in errors._asdict().items()},
    }
    write_json(path, {"version": VERSION} | document)


def read_truth(path: Path) -> Truth:
    """Read what `write_truth` wrote.

    Raises:
        DataError: not such a file, or of another version.
    """
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict) or document.get("version") != VERSION:
        raise DataError(f"{path}: not a truth file of version {VERSION}")
    # Older files have the sensors' biases only.
    clocks, bias, errors = document["clocks"], document["imu_bias"], document.get("sensor_errors")
    return Truth(
        robot=document["robot"],
        module_types=tuple(document["module_types"]),
        chain=Chain.from_dict(document["chain"]),
        inertia=read_only(np.array(document["inertia"])),
        clocks=None if clocks is None else tuple(ModuleClock(**clock) for clock in clocks),
        imu_bias=None if bias is None else read_only(np.array(bias)),
        sensor_errors=None
        if errors is None
        else SensorErrors(**{k: read_only(np.array(v)) for k, v in errors.items()}),
    )


class TruthLog:
    """Steps `world` and records its true motion, every `every` ticks, or nothing of it with None.

    Rows are in blocks of a fixed size: what is recorded is not copied until `motion` is called, so that no
    tick waits for more than the memory of one block.

    Raises:
        DataError: `every` is less than 1.
    """

    def __init__(self, world: World, every: int | None = EVERY_TICKS):
        if every is not None and every < 1:
            raise DataError(f"every {every} ticks: at least 1")
        self.modules = world.modules
        self.world = world
        # Ticks so far, rows in the present block so far, and every how many ticks there is a row (0: never).
        self._counts = np.array([0, 0, every or 0])
        self._full: list[tuple[NDArray[np.int64], Array]] = []
        self._t_ns, self._rows = self._block(0 if every is None else _BLOCK_ROWS)

    def _block(self, rows: int) -> tuple[NDArray[np.int64], Array]:
        return np.zeros(rows, dtype=np.int64), np.zeros((rows, 3, len(self.modules)))

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Step the world, record the instant of its samples if it is due, and return its readings."""
        samples = self.world.exchange(pwm)
        keep_truth(self.world.plant_rows, self.world.t_ns - TICK_NS, self.begin_run(1))
        return samples

    @property
    def readings(self) -> Readings:
        """What the modules have read in the last tick; the next one overwrites it."""
        return self.world.readings

    @property
    def alteration(self) -> Any:
        """What a kernel has to alter in the readings, an `Alteration` as a plain tuple; None if nothing."""
        return None

    @property
    def ticks_ahead(self) -> int:
        """How many ticks a kernel can do as `exchange` does; 0 if none."""
        return MANY_TICKS if self.world.can_run_ahead else 0

    def begin_run(self, ticks: int) -> tuple[Any, ...]:
        """Return arrays with room for so many ticks: times, rows, and counts, as `keep_truth` takes them."""
        _, rows, every = self._counts.tolist()
        if every and rows + ticks > len(self._t_ns):
            self._full.append((self._t_ns[:rows], self._rows[:rows]))
            self._t_ns, self._rows = self._block(max(_BLOCK_ROWS, ticks))
            self._counts[1] = 0
        return self._t_ns, self._rows, self._counts

    def motion(self) -> Motion:
        """Return what has been recorded."""
        n = len(self.world.modules)
        rows = int(self._counts[1])
        times, blocks = zip(*self._full, (self._t_ns[:rows], self._rows[:rows]), strict=True)
        stamps, columns = np.concatenate(times), np.concatenate(blocks)
        clocks = [[module_time(clock, t) for clock in self.world.sensors.clocks] for t in stamps.tolist()]
        clock_ns = np.array(clocks, dtype=np.int64).reshape(-1, n)
        make_read_only((stamps, clock_ns, columns))
        return Motion(self.world.robot.serials, stamps, clock_ns, columns[:, 0], columns[:, 1], columns[:, 2])

    def save(self, path: Path) -> None:
        """Write the motion as an npz file, atomically; the fields are those of `Motion`."""
        fields: dict[str, Any] = self.motion()._asdict()
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **fields)


def read_motion(path: Path) -> Motion:
    """Read what `TruthLog.save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in Motion._fields}
    serials = tuple(str(s) for s in arrays.pop("serials"))
    make_read_only(arrays.values())
    return Motion(serials, **arrays)
