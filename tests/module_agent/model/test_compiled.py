"""Machine code that is kept is that of the files as they are."""

import os
import subprocess
import sys
from pathlib import Path

KERNEL = """
from typing import NamedTuple

import numpy as np

from module_agent.model.compiled import compiled


class {name}(NamedTuple):
    values: np.ndarray


@compiled
def total(some: {name}) -> float:
    return {factor} * some.values.sum()


print(total({name}(np.ones(3))))
"""


def test_code_that_was_kept_for_types_that_are_gone_is_compiled_anew(tmp_path: Path) -> None:
    """As after an update of the files in place."""
    module = tmp_path / "kernel.py"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    for name, factor, expected in (("Before", 1.0, "3.0"), ("After", 2.0, "6.0"), ("After", 2.0, "6.0")):
        module.write_text(KERNEL.format(name=name, factor=factor))
        done = subprocess.run(
            [sys.executable, "-c", "import kernel"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stdout.strip()) == (0, expected), done.stderr
    # It was kept, in one index of code.
    assert len(list((tmp_path / "__pycache__").glob("*.nbi"))) == 1
