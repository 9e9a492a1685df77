"""Freed memory goes back to the system, or is kept."""

import os
import platform
import sys
from subprocess import check_output

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


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="parameters of glibc")
def test_memory_that_is_kept_is_not_cleared_again_under_the_limit_of_dasks_workers():
    limited = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    given, kept = (int(check_output([sys.executable, "-c", FAULTS, x], env=limited)) for x in ("given", "kept"))
    assert given > 100_000
    assert kept < 1_000
