from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from module_agent.model.chain import Chain
from module_agent.wire.feedback_rows import ROW, Rows

Read = Callable[[Path, str], pd.DataFrame]


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    """Make Rerun raise where it would only warn."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture
def arm() -> Chain:
    """Two modules: the second 0.3 m up, its axis turned to -y, mounted by its output."""
    imu_home = np.tile(np.eye(4), (2, 1, 1))
    imu_home[0, :3, 3] = (0.025, 0.0, 0.003)
    imu_home[1, :3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    imu_home[1, :3, 3] = (0.025, 0.003, 0.3)
    return Chain(
        serials=("a", "b/1"),
        parent=(-1, 0),
        reversed=(False, True),
        axis=np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
        point=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]]),
        imu_home=imu_home,
        gravity=np.array([0.0, 0.0, 9.81]),
    )


@pytest.fixture
def types() -> dict[str, str]:
    return {"a": "X5-9", "b/1": "X5-4"}


@pytest.fixture
def read() -> Read:
    """Read what a file has at and below an entity, one line per time."""

    def of(path: Path, entity: str) -> pd.DataFrame:
        stored: Any = RrdReader(str(path)).stream().collect()
        return stored.reader(index="session_time", contents=entity).to_pandas()

    return of


@pytest.fixture
def make_rows() -> Callable[[int, int], Rows]:
    """Make rows whose every value tells which row it is."""

    def of(first: int, count: int) -> Rows:
        number = np.arange(first, first + count)
        rows = np.zeros(count, ROW)
        rows["position_rad"] = 0.001 * number
        rows["effort_nm"] = -number
        rows["gyro_rad_s"] = number[:, None] + np.array([0.0, 0.25, 0.5])
        rows["position_command_rad"] = np.nan
        rows["velocity_command_rad_s"] = 2.0 * number
        rows["effort_command_nm"] = np.nan
        rows["voltage_v"] = 36.0
        return rows

    return of
