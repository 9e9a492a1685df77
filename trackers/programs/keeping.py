"""Compiled and traced programs of a process, kept for later ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.programs import traced_programs
from trackwright.trackers.programs.program_cache import cache_programs, store_in_use


def keep_programs(say: Callable[[str], object]) -> None:
    """Keeps programs in the user's cache directory; `say` gets a line where that is impossible."""
    # A program that jax cannot load is compiled and replaced.
    warnings.filterwarnings("ignore", message="Error reading persistent compilation cache entry")
    try:
        cache_programs(report=say)
    except UnusableInput as problem:
        say(str(problem))
    if (store := store_in_use()) is not None:
        traced_programs.use(store)
