"""Freed memory goes back to the system, or is kept; the import sets XLA's flags, but not over the user's."""

import ctypes
import os
import platform
import subprocess
import sys

import pytest

from trackwright.trackers.programs.process_settings import FLAGS, give_back

FAULTS = """
import resource, sys
import numpy as np
from trackwright.trackers.programs.process_settings import keep
if sys.argv[1] == "kept":
    keep()
np.ones(200_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    np.ones(200_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_memory_is_given_back_where_glibc_can(monkeypatch):
    calls = []

    class Library:
        def malloc_trim(self, padding):
            calls.append(padding)

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library())
    monkeypatch.setattr(sys, "platform", "linux")
    give_back()
    monkeypatch.setattr(sys, "platform", "darwin")
    give_back()
    assert calls == [0]


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_a_library_without_the_call_is_no_error(monkeypatch, error):
    def missing(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", missing)
    monkeypatch.setattr(sys, "platform", "linux")
    give_back()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="parameters of glibc")
def test_memory_that_is_kept_is_not_cleared_again_under_the_limit_of_dasks_workers():
    limited = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    faults = [
        int(subprocess.check_output([sys.executable, "-c", FAULTS, how], env=limited)) for how in ("given", "kept")
    ]
    assert faults[0] > 30_000
    assert faults[1] < 1_000


USERS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=2048"


@pytest.mark.parametrize(
    ("before", "after"),
    [(None, FLAGS), ("--xla_dump_to=x", f"--xla_dump_to=x {FLAGS}"), (USERS, USERS)],
    ids=["none", "another", "the same option"],
)
def test_the_import_adds_flags_unless_the_user_set_the_same_option(before, after):
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"} | (
        {} if before is None else {"XLA_FLAGS": before}
    )
    program = "import os, sys, trackwright; print(os.environ['XLA_FLAGS'], 'jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == f"{after} False"
