"""Process settings for speed: garbage collection, memory given back, compiled programs kept."""

from __future__ import annotations

import atexit
import gc
import os
import warnings

# Our own modules are imported in functions: Ctrl-C is answered in a line within `main` alone, which imports this first.

COLLECT_AFTER = 500_000
"""Allocations between garbage collections: imports and tracing make many lasting objects, 300,000 before a track."""


def settle_memory() -> None:
    """Collect garbage less often, and let polars give memory back."""
    gc.set_threshold(COLLECT_AFTER, *gc.get_threshold()[1:])
    # What lives to the end needs no last collection, which took 0.6 s after jax was used.
    atexit.register(gc.freeze)
    # The allocator of polars, which is to give memory back while jax is imported.
    os.environ.setdefault("_RJEM_MALLOC_CONF", "dirty_decay_ms:100,muzzy_decay_ms:0")


def keep_programs() -> None:
    """Keep compiled programs for later commands, as `cache_programs`; a notice where that is impossible."""
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.core.errors import UnusableInput
    from trackwright.trackers.programs import traced_programs
    from trackwright.trackers.programs.program_cache import cache_programs, store_in_use

    # A program that jax cannot load is compiled and replaced.
    warnings.filterwarnings("ignore", message="Error reading persistent compilation cache entry")
    try:
        cache_programs(report=lambda text: notice(f"notice: {text}"))
    except UnusableInput as problem:
        notice(f"notice: {problem}")
    store = store_in_use()
    if store is not None:
        traced_programs.use(store)
