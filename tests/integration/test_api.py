"""The library on a live robot: it is found, held, moved and released by a few lines of Python."""

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from coordinator import connect
from module_agent.model.errors import LostError

ROBOT, SERIALS = "thesis_171_horizontal", ("X-00009", "X-00010")
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "subscribe_feedback.py"


def test_a_robot_is_found_held_moved_and_released(launcher: Any, endpoint: str) -> None:
    robot = launcher()
    robot.start_world()
    robot.start_agents()

    async def move() -> tuple[float, float]:
        async with connect(ROBOT, listen=endpoint, expect=2, timeout_s=60.0) as arm:
            assert arm.serials == SERIALS
            await arm.hold()
            before = float(arm.latest("X-00010")["position_rad"][-1])
            await arm.move_to({"X-00010": before + 0.2})
            return before, float(arm.latest("X-00010")["position_rad"][-1])

    before, after = asyncio.run(move())
    # The spring holds the link to a few hundredths of a radian under its weight.
    assert after - before == pytest.approx(0.2, abs=0.05)


def test_a_robot_that_is_not_there_is_said_with_its_name(endpoint: str) -> None:
    async def find() -> None:
        async with connect("no_such_robot", listen=endpoint, timeout_s=0.3):
            pass

    with pytest.raises(LostError, match=r"of robot 'no_such_robot' expected within 0\.3 s"):
        asyncio.run(find())


def test_feedback_is_printed_by_plain_zenoh_and_numpy(launcher: Any, endpoint: str) -> None:
    robot = launcher()
    robot.start_world()
    robot.start_agents()

    async def listen() -> str:
        async with connect(ROBOT, listen=endpoint, expect=2, timeout_s=60.0):
            command = [sys.executable, str(EXAMPLE), endpoint, "2"]
            return await asyncio.to_thread(
                lambda: (
                    subprocess.run(
                        command, capture_output=True, text=True, timeout=60, check=True, env={**os.environ}
                    ).stdout
                )
            )

    printed = asyncio.run(listen())
    for serial in SERIALS:
        assert f"{serial}: " in printed, json.dumps(printed[-500:])
