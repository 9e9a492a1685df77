"""Freed memory goes back to the system, or is kept."""

import os
import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
from trackwright.trackers.core.programs import keep
if sys.argv[1] == "kept":
    keep()
size = 30_000_000  # larger than any hole in the heap, smaller than what is kept at most
b"x" * size
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    b"x" * size
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="parameters of glibc")
def test_memory_that_is_kept_is_not_cleared_again_under_the_limit_of_dasks_workers():
    limited = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    faults = [
        int(subprocess.check_output([sys.executable, "-c", FAULTS, how], env=limited)) for how in ("given", "kept")
    ]
    assert faults[0] > 100_000
    assert faults[1] < 1_000
