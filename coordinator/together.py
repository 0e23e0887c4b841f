"""Several things done at once, all to their end."""

import asyncio
from collections.abc import Coroutine, Iterable


async def together(work: Iterable[Coroutine[None, None, object]]) -> None:
    """Do all of it at once, all to its end; raise what the first of those that failed raised."""
    for outcome in await asyncio.gather(*work, return_exceptions=True):
        if isinstance(outcome, BaseException):
            raise outcome
