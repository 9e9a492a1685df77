"""The manifest of an output folder: command, configuration, versions, device and times of a run."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from trackwright.trackers.recordings.atomic import atomic_write, config_hash, json_text

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
    """Writes `manifest.json` at the end of a run and returns its path.

    `started`: with its time zone. `chunk`: trajectories per chunk, on which bit-identity depends. `extra`: further
    entries. Raises UnusableInput if the folder cannot be written to.
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
