"""Tests. Linear algebra uses one thread, as in the programs: processes find the same to the last digit."""

import os

# Read as numpy is loaded: this module is the first of all tests.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")
