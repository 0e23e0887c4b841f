"""A module's answer is read part by part, as it was asked for."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.session.information_requests import InformationRequests
from module_agent.wire.information_messages import Information


@pytest.mark.parametrize(
    ("offsets", "noted"), [((0, 4), []), ((0, 0), ["another part"]), ((4,), ["another part"])]
)
def test_a_part_that_was_not_asked_for_ends_the_questions_by_name(
    offsets: tuple[int, ...], noted: list[str]
) -> None:
    """Otherwise a module that repeats itself would be asked, and recorded, until patience ends."""
    notes: list[str] = []
    answers = [
        Information(
            serial="A",
            boot=1,
            seq=1,
            digest=bytes(32),
            motion_ids=(1,),
            total_bytes=8,
            offset=at,
            part=b"1234",
        )
        for at in offsets
    ]
    asked: list[int] = []

    async def ask(serial: str, leaf: object, request: Any) -> Information:
        asked.append(request["offset"])
        return answers.pop(0)

    messenger: Any = SimpleNamespace(ask=ask, next_seq=lambda: 1)
    recording: Any = SimpleNamespace(modules={"A": SimpleNamespace(boot=1)})
    requests = InformationRequests(messenger, recording, lambda: 0, "tester", notes.append)
    request: Any = SimpleNamespace(model_copy=lambda update: update)
    asyncio.run(requests._ask_one("A", request))
    assert not answers
    assert asked == [0, 4][: len(asked)]
    assert [word for word in noted if word in " ".join(notes)] == noted
    assert len(notes) == len(noted)
