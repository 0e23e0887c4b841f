"""The low-pass that is chosen: where the motion and the friction are, below the noise of differentiation."""

from typing import Any

import pytest
from numpy.random import default_rng

from coordinator.arm_fit.cutoff import CutoffPoint, chosen_cutoff_hz, cutoff_curve
from coordinator.arm_fit.data_file import JointLog
from coordinator.arm_fit.problem import ModelChoice
from coordinator.description.urdf_reader import read_urdf
from module_agent.model.errors import UsageError

RATE_HZ = 400.0
SHARED = ModelChoice(coupled=((1, 2),), tried=())


def test_the_noisier_the_encoder_the_lower_the_cut_off(recording: Any) -> None:
    robot = read_urdf(recording.urdf)
    chosen = []
    for noise_rad in (1e-5, 1e-3):
        shaken = recording.q_rad + noise_rad * default_rng(5).normal(size=recording.q_rad.shape)
        curve = cutoff_curve(robot, JointLog(RATE_HZ, shaken, None, recording.tau_nm), SHARED)
        chosen.append(chosen_cutoff_hz(curve))
        best = min(point.raw for point in curve)
        assert next(p.raw for p in curve if p.cutoff_hz == chosen[-1]) < 1.1 * best
        # The ladder shows the way down and up.
        assert curve[0].raw > best
        assert curve[-1].raw > best
    assert chosen[1] < 0.5 * chosen[0]


def test_the_lowest_of_those_that_do_equally_well_is_chosen() -> None:
    curve = tuple(
        CutoffPoint(hz, 0.08, raw) for hz, raw in ((5.0, 0.19), (10.0, 0.153), (20.0, 0.150), (40.0, 0.16))
    )
    # 0.150^2 + 0.2 0.08^2 = 0.1542^2.
    assert chosen_cutoff_hz(curve) == 10.0


def test_a_recording_too_short_for_any_is_refused(recording: Any) -> None:
    log = JointLog(RATE_HZ, recording.q_rad[:60], None, recording.tau_nm[:60])
    with pytest.raises(UsageError, match=r"too short: 0\.15 s at 400 Hz"):
        cutoff_curve(read_urdf(recording.urdf), log, SHARED)
