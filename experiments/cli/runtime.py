"""What begins and ends a run: garbage collected less often, memory given back, programs kept; the manifest."""

from __future__ import annotations

import atexit
import gc
import os
import platform
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

# Our own modules are imported in functions: Ctrl-C is answered in a line within `main` alone, which imports this first.

COLLECT_AFTER = 500_000
"""Allocations between garbage collections: imports and tracing make many lasting objects, 300,000 before a track."""

LEFT_OUT = 3
"""The exit code where recordings were left out, and the others done."""

PACKAGES = ("jax", "jaxlib", "numpy")  # those whose versions a manifest names, beside our own


def settle_memory() -> None:
    """Collect garbage less often, let polars give memory back, and keep alarms of XLA off the terminal."""
    gc.set_threshold(COLLECT_AFTER, *gc.get_threshold()[1:])
    # What lives to the end needs no last collection, which took 0.6 s after jax was used.
    atexit.register(gc.freeze)
    # The allocator of polars, which is to give memory back while jax is imported.
    os.environ.setdefault("_RJEM_MALLOC_CONF", "dirty_decay_ms:100,muzzy_decay_ms:0")
    # XLA reports a slow compilation as an error; those that fail reach us as exceptions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


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


def write_manifest(
    out_dir: Path | str, command: Sequence[str], config: Mapping[str, Any], started: datetime,
    seeds: Sequence[int] = (), chunk: int | None = None, extra: Mapping[str, Any] | None = None,
) -> Path:  # fmt: skip
    """Writes `manifest.json` at the end of a run and returns its path; raises UnusableInput where it cannot. `chunk`:
    trajectories per chunk, on which bit-identity depends."""
    import jax

    from trackwright import __version__
    from trackwright.trackers.recordings.atomic import atomic_write, config_hash, json_text

    versions = {"trackwright": __version__, **{name: version(name) for name in PACKAGES}}
    manifest = {
        "command": list(command),
        "config": config,
        "config_sha256": config_hash(config),
        "seeds": list(seeds),
        "chunk": chunk,
        "versions": versions | {"python": platform.python_version()},
        "device": jax.devices()[0].device_kind,
        "platform": jax.default_backend(),
        "n_devices": jax.device_count(),
        "started": started.astimezone(UTC).isoformat(timespec="milliseconds"),
        "ended": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **(extra or {}),
    }
    return atomic_write(Path(out_dir) / "manifest.json", lambda path: path.write_text(json_text(manifest), "utf-8"))
