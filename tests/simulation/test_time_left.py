"""A session says how long it still takes: the plan knows its length."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.excitation.plan import Plan

Rigs = Callable[..., Any]


class Clocked:
    """A screen that keeps when it was told how much time is left."""

    def __init__(self, now_ns: Callable[[], int]):
        self._now_ns = now_ns
        self.said: list[tuple[int, str, float | None]] = []

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        self.said.append((self._now_ns(), text, left_s))

    def note(self, text: str) -> None:
        pass


@pytest.mark.parametrize(
    "changes",
    [
        {"dynamics": True},
        {"dynamics": True, "excitation": "d-optimal", "excitation_motions": 2, "excitation_s": 3.0},
        {"mode": "simultaneous", "trial_speed_rad_s": 0.4},
    ],
    ids=["one by one", "designed", "all at once"],
)
def test_the_time_left_is_what_the_session_takes(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, changes: dict[str, Any]
) -> None:
    rig = rigs("thesis_171_horizontal", "lan", 3)
    run = rig.begin(tmp_path / "run", quick_plan.model_copy(update=changes))
    screen = run._screen = Clocked(lambda: rig.loop.now_ns)
    rig.run(run.run())
    (end_ns,) = [e.t_ns for e in run.recording.journal if e.what == "done" and e.step == "back"]
    told = [(1e-9 * (end_ns - t_ns), left_s) for t_ns, _, left_s in screen.said if left_s is not None]
    # From when the modules are known; the last step is the way back.
    assert len(screen.said) - len(told) == 2
    assert len(told) >= 5
    for taken_s, left_s in told:
        # Answers come sooner than is reckoned with: 0.4 s of every joint here.
        assert taken_s - 1.0 < left_s < 1.1 * taken_s + 1.0
