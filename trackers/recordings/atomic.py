"""Atomic writes, and strict JSON without NaN."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.beside import beside


def atomic_write(path: Path | str, writer: Callable[[Path], object]) -> Path:
    """Atomic write: `writer` writes a temporary file in the same folder, which is then renamed to `path`; returns it.

    After a failure no partial file remains, and an older file of that name is unchanged; what a killed process leaves
    is removed by the next one that writes to the folder. Raises UnusableInput for a full disk, missing permission or a
    missing folder.
    """
    path = Path(path)
    try:
        with beside(path) as temporary:
            writer(temporary)
            os.replace(temporary, path)
    except (OSError, pl.exceptions.PolarsError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise UnusableInput(
            f"cannot write {path}: {reason}; expected a folder with space that may be written to; choose another folder"
        ) from error
    return path


def json_text(value: Any) -> str:
    """The value as indented JSON: NumPy numbers as numbers, arrays as lists, NaN and infinity as null."""
    return json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def config_hash(config: Mapping[str, Any]) -> str:
    """The SHA-256 of a configuration, independent of the order of its keys."""
    canonical = json.dumps(json.loads(json_text(config)), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, np.generic) or hasattr(value, "__array__"):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (Sequence, set, frozenset)) and not isinstance(value, bytes):
        return [_plain(item) for item in value]
    return str(value)
