"""What was imported is no part of later collections."""

import subprocess
import sys

PROGRAM = """
import gc, weakref
from module_agent.model.garbage import leave_out_imports
import numpy
class Ring:
    def __init__(self):
        self.own = self
gc.disable()
dead = weakref.ref(Ring())
leave_out_imports()
assert gc.get_freeze_count() > 10_000
assert dead() is None, "garbage of before is kept"
kept = gc.get_freeze_count()
later = [[] for _ in range(1000)]
leave_out_imports()
assert gc.get_freeze_count() <= kept, "what came later is kept"
dead = weakref.ref(Ring())
gc.collect()
assert dead() is None, "later garbage is kept"
"""


def test_what_lives_before_is_left_out_and_what_comes_later_is_collected() -> None:
    # In a process of its own: what is left out stays so.
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
