"""Whatever modules say in a recording, it is identified, or ends with a sentence."""

import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import pytest

from coordinator.identification.identify import identify
from coordinator.recording.recording import Entry, Recording
from coordinator.recording.session_file import read_session
from module_agent.model.errors import RobotError
from tests.breadth import breadth
from tests.forgery import altered

# One process makes the recordings that all tests here alter.
pytestmark = pytest.mark.xdist_group("forged")


@pytest.fixture(scope="module")
def kept() -> dict[str, list[Entry]]:
    return {}


@pytest.fixture
def session(
    kept: dict[str, list[Entry]], rigs: Callable[..., Any], quick_plan: Any, tmp_path: Path
) -> Callable[[str], list[Entry]]:
    """Returns what was recorded as joint by joint moved, or all at once; made once."""

    def made(mode: str) -> list[Entry]:
        if mode not in kept:
            plan = quick_plan.model_copy(update={"mode": mode})
            rigs("thesis_171_horizontal", "lan", 3).session(tmp_path / mode, plan)
            kept[mode] = list(read_session(tmp_path / mode / "session.mcap"))
        return kept[mode]

    return made


@pytest.mark.parametrize("seed", [0, 1, 2, 3, *breadth(*range(4, 200))])
def test_a_recording_with_fields_that_are_otherwise_is_identified_or_ends_with_a_sentence(
    seed: int, session: Callable[[str], list[Entry]]
) -> None:
    draw = random.Random(seed)
    entries = session(draw.choice(("sequential", "simultaneous")))
    by_topic: dict[str, list[int]] = {}
    for place, entry in enumerate(entries):
        if entry.kind in ("publication", "reply"):
            by_topic.setdefault(entry.topic.rpartition("/")[2], []).append(place)
    topic = draw.choice(sorted(by_topic))
    places = draw.choices(by_topic[topic], k=draw.choice((1, 3, 20)))
    forged = {
        place: msgpack.packb(altered(msgpack.unpackb(entries[place].payload), draw)) for place in places
    }
    recording = Recording()
    for place, entry in enumerate(entries):
        recording.accept(entry._replace(payload=forged[place]) if place in forged else entry)
    with suppress(RobotError):
        identify(recording).result.model_dump_json()
