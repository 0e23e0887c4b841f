"""Work that another thread repeats while a test reads what it works on."""

import itertools
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SWITCH_S = 1e-6


@contextmanager
def repeating(work: Callable[[int], object]) -> Iterator[None]:
    """Call `work` with 0, 1, 2, ... in a thread until the context ends; threads switch as often as they can.

    Raises:
        Exception: what `work` raised.
    """
    stop, failures, before = threading.Event(), list[Exception](), sys.getswitchinterval()

    def work_on() -> None:
        try:
            for number in itertools.count():
                if stop.is_set():
                    return
                work(number)
        except Exception as failure:
            failures.append(failure)

    thread = threading.Thread(target=work_on)
    sys.setswitchinterval(SWITCH_S)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        sys.setswitchinterval(before)
    if failures:
        raise failures[0]
