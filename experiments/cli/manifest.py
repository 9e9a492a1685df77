"""The manifest of a run folder: what was run, with which numbers, on what, and when."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from trackers.recordings.atomic import atomic_write, config_hash, json_text

PACKAGES = ("trackwright", "jax", "jaxlib", "numpy")


def write_manifest(
    out_dir: Path | str,
    command: Sequence[str],
    config: Mapping[str, Any],
    started: datetime,
    seeds: Sequence[int] = (),
    chunk: int | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """The path of `manifest.json` in the folder, written now, which is the end of the run.

    `started`: aware of its time zone. `chunk`: trajectories a batch is cut into, on which bit-identity depends.
    `extra`: further entries, as the files written. Raises UnusableInput where the folder cannot be written to.
    """
    manifest = {
        "command": list(command),
        "config": config,
        "config_sha256": config_hash(config),
        "seeds": list(seeds),
        "chunk": chunk,
        "versions": {name: _version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "device": jax.devices()[0].device_kind,
        "platform": jax.default_backend(),
        "n_devices": jax.device_count(),
        "started": started.astimezone(UTC).isoformat(timespec="milliseconds"),
        "ended": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **(extra or {}),
    }
    return atomic_write(Path(out_dir) / "manifest.json", lambda path: path.write_text(json_text(manifest), "utf-8"))


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
