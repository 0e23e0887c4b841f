"""Single keys of a terminal, without Enter, as calls on an event loop."""

import asyncio
import os
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def key_presses(loop: asyncio.AbstractEventLoop, actions: Mapping[str, Callable[[], None]]) -> Iterator[bool]:
    """Call an action on the loop when its key is pressed in the block; yield whether keys can be pressed.

    Without a terminal on standard input there are none. Ctrl-C stays what it is.
    """
    if not sys.stdin.isatty():
        yield False
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def read() -> None:
        for key in os.read(terminal, 64).decode(errors="ignore"):
            if key.lower() in actions:
                actions[key.lower()]()

    tty.setcbreak(terminal)
    loop.add_reader(terminal, read)
    try:
        yield True
    finally:
        if not loop.is_closed():
            loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
