"""The simulator as a library: one call gives recording, result and truth."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sim
from sim import simulate
from sim.scoring.chain_score import link_errors, topology_differences
from sim.scoring.score import score

ROBOT = "thesis_171_horizontal"


def test_a_simulated_robot_is_identified_in_ten_lines() -> None:
    run = simulate(ROBOT, dynamics=False, seed=1)
    chain, truth = run.identified.kinematics.fit.chain, run.truth.chain
    assert topology_differences(chain, truth) == []
    error = link_errors(chain, truth, child=1)
    assert error is not None
    # Of an IMU as delivered, anywhere within a millimetre of its place.
    (claimed,) = run.identified.result.links
    assert abs(error.length_m) < 3e-3 * claimed.link_length_sigma_mm
    assert claimed.link_length_sigma_mm < 2.0
    assert run.identified.inertia is None
    (link,) = run.score().links
    assert link.link_length_error_mm == pytest.approx(1e3 * error.length_m)
    assert run.folder is None
    # The true motion is apart from what was measured of it, and covers the session.
    assert run.motion.q_rad.shape == (len(run.motion.t_ns), 2)
    assert np.ptp(run.motion.t_ns) * 1e-9 > 20.0


def test_a_simulation_that_is_written_is_a_run_like_any_other(tmp_path: Path) -> None:
    run = simulate(ROBOT, noise="ideal", dynamics=False, out=tmp_path / "run")
    assert run.folder == tmp_path / "run"
    written = score(run.folder)
    assert written.topology_correct
    assert run.score().links == written.links
    assert run.identified.result.links[0].link_length_mm == pytest.approx(171.0, abs=0.5)


def test_importing_the_package_loads_neither_physics_nor_numerics() -> None:
    code = "import sys, sim; print(*sorted({'numpy', 'pybullet', 'numba'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_an_unknown_name_is_answered_with_those_that_exist() -> None:
    with pytest.raises(AttributeError, match="'simulat'; its library has Simulation, load_robot, simulate"):
        _ = sim.simulat  # type: ignore[attr-defined]
