"""Fixtures for all tests. What needs the simulator imports it late: estimators are tested without physics."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator

from coordinator.excitation.plan import Plan
from coordinator.identification.result import ChainPart, Result, write_result
from coordinator.recording.run_folder import RESULT
from tests import random_chains


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with what takes longest: processes in real time, which stay on one worker, and whole sessions."""

    def later(item: pytest.Item) -> int:
        group = item.get_closest_marker("xdist_group")
        if group is not None and group.args == ("integration",):
            return 0
        return 1 if item.path.parent.name == "simulation" or item.path.name == "test_examples.py" else 2

    items.sort(key=later)


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(20261121)


@pytest.fixture
def robots() -> SimpleNamespace:
    """Random robots and what their IMUs measure."""
    return SimpleNamespace(
        build=random_chains.build,
        random=random_chains.random_robot,
        root_pose=random_chains.root_pose,
        topology=random_chains.topology_of,
        circle=random_chains.circle,
        rest=random_chains.rest_of,
        observe=random_chains.observe,
        positions=random_chains.random_positions,
        gravity_m_s2=random_chains.G,
    )


@pytest.fixture
def physics() -> str | None:
    """The physics engine of the rigs, None for the default; `BOTH_ENGINES` runs tests with each."""
    return None


@pytest.fixture
def rigs(physics: str | None) -> Iterator[Callable[..., Any]]:
    """Makes rigs and closes them."""
    # Late: what does not simulate needs no physics.
    from tests.rig import Rig

    made: list[Any] = []

    def make(*args: Any, **kwargs: Any) -> Rig:
        made.append(Rig(*args, **{"physics": physics, **kwargs}))
        return made[-1]

    yield make
    for rig in reversed(made):
        rig.close()


@pytest.fixture
def page_port() -> int:
    """A free port of 127.0.0.1, the next one free too: those of the kernel's choice are seldom neighbours."""
    from coordinator.viewer.viewer_process import free_port, listens

    return next(port for port in iter(free_port, 0) if not listens("127.0.0.1", port + 1))


@pytest.fixture
def known_folder(tmp_path: Path) -> Callable[..., Path]:
    """Makes the folder of a run that found out without error what a robot is and weighs."""

    from sim.robot.robot_file import load_robot
    from sim.robot.robot_tree import true_chain, true_inertia

    def make(robot: str, **changes: object) -> Path:
        folder = tmp_path / f"known-{robot}"
        folder.mkdir(exist_ok=True)
        known = load_robot(robot)
        dynamics = {
            "phi": true_inertia(known).reshape(-1).tolist(),
            "rank": 1,
            "parameters": 10 * len(known.modules),
            "condition": 1.0,
            "sigma": [],
            "identifiable": [],
            "residual_rms_nm": {},
            "held_out": None,
        }
        document: dict[str, object] = {
            "robot": robot,
            "serials": known.serials,
            "types": {module.serial: module.type for module in known.modules},
            "topology_confidence": 1.0,
            "chain": ChainPart(**true_chain(known).to_dict()),
            "rank": 1,
            "condition": 1.0,
            "reduced_chi2": 1.0,
            "product_of_exponentials": {"screws": [], "tips": []},
            "dynamics": dynamics,
            "robot_time_s": 0.0,
            "wall_time_s": None,
            "trace_hash": "",
            "unresolved": [],
            "null_basis": [],
            "chain_covariance": [],
            "links": [],
            "transforms": [],
            "pairs": [],
            "denavit_hartenberg": [],
            "notes": [],
            **changes,
        }
        write_result(folder / RESULT, Result.model_validate(document))
        return folder

    return make


@pytest.fixture(scope="session")
def quick_plan() -> Plan:
    """Half the thesis' durations: enough for topology, kinematics and every fault."""
    from sim.virtual_time.run import QUICK_PLAN

    return QUICK_PLAN
