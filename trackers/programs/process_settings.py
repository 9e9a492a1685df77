"""A setting of the process: how much freed memory glibc's allocator keeps."""

from __future__ import annotations

import ctypes
import functools
import sys
from contextlib import suppress

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt."""

KEPT, LARGEST = 2**28, 2**25
"""Bytes of freed memory that are kept, and of the largest array that is kept: glibc's limit."""


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
