"""Settings of the process: flags of XLA's CPU compiler, and how much freed memory glibc's allocator keeps.

jax reads the flags from the environment when it first computes.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from contextlib import suppress

EXTRA_OPTIONS = "--xla_backend_extra_options"

FLAGS = f"{EXTRA_OPTIONS}=xla_cpu_use_multi_output_fusion,xla_cpu_small_while_loop_byte_threshold=3000000"
"""Multi-output fusion computes terms shared within a filter step once, not once per use. A loop whose step moves few
bytes, as that of one trajectory, becomes one kernel, without hundreds of calls in each step. Neither can be given to a
single compilation."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt."""

KEPT, LARGEST = 2**28, 2**25
"""Bytes of freed memory that are kept, and of the largest array that is kept: glibc's limit."""


def set_flags() -> None:
    """Add `FLAGS` to XLA_FLAGS, unless extra options are set there; without effect on a jax that has computed."""
    present = os.environ.get("XLA_FLAGS", "")
    if EXTRA_OPTIONS not in present:
        os.environ["XLA_FLAGS"] = f"{present} {FLAGS}".strip()


@functools.cache
def keep() -> None:
    """Keep freed memory for the next arrays; nothing happens without glibc.

    The system clears every page that it hands out, which took a third of a study's processor time in workers of Dask,
    whose limit is low.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).mallopt(M_TRIM_THRESHOLD, KEPT)
            ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGEST)


def give_back() -> None:
    """Return freed memory to the system, within milliseconds; nothing happens without glibc."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
