"""Process settings for speed: XLA flags, set before jax is imported, garbage collection, compiled programs kept."""

from __future__ import annotations

import atexit
import gc
import os
import warnings

# Our own modules are imported in functions: Ctrl-C is answered in a line within `main` alone, which imports this first.

EXTRA_OPTIONS = "--xla_backend_extra_options"

FLAGS = f"{EXTRA_OPTIONS}=xla_cpu_use_multi_output_fusion,xla_cpu_small_while_loop_byte_threshold=3000000"
"""Flags of XLA's CPU compiler.

Multi-output fusion computes terms shared within a filter step once, not once per use. A loop whose step moves few
bytes, as that of one trajectory, becomes one kernel, without hundreds of calls in each step.
"""

COLLECT_AFTER = 500_000
"""Allocations between garbage collections: imports and tracing make many lasting objects, 300,000 before a track."""


def set_flags() -> None:
    """Add `FLAGS` to XLA_FLAGS unless the user has set them there; collect garbage less often."""
    gc.set_threshold(COLLECT_AFTER, *gc.get_threshold()[1:])
    # What lives to the end needs no last collection, which took 0.6 s after jax was used.
    atexit.register(gc.freeze)
    # The allocator of polars, which is to give memory back while jax is imported.
    os.environ.setdefault("_RJEM_MALLOC_CONF", "dirty_decay_ms:100,muzzy_decay_ms:0")
    present = os.environ.get("XLA_FLAGS", "")
    if EXTRA_OPTIONS not in present:
        os.environ["XLA_FLAGS"] = f"{present} {FLAGS}".strip()


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
