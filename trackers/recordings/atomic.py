"""Atomic writes, the temporary files and folders that they need, and strict JSON without NaN."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from pydantic_core import to_json

from trackwright.trackers.core.errors import UnusableInput

PREFIX = ".trackwright-"

Content = pl.DataFrame | str | bytes


def atomic_write(path: Path | str, writer: Callable[[Path], object]) -> Path:
    """Has `writer` write a file beside `path` that becomes it when whole; raises UnusableInput where it cannot."""
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


def write_whole(path: Path, content: Content) -> Path:
    """Writes a table, a text or bytes, and its folder; returns the path. Raises UnusableInput as `atomic_write`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"{path.parent}: cannot be created ({error.strerror}); choose another --out") from error
    if isinstance(content, pl.DataFrame):
        return atomic_write(path, lambda temporary: content.write_parquet(temporary, compression_level=1))
    data = content.encode() if isinstance(content, str) else content
    return atomic_write(path, lambda temporary: temporary.write_bytes(data))


def json_text(value: Any) -> str:
    """The value as indented JSON: NumPy numbers as numbers, arrays as lists, NaN and infinity as null."""
    return to_json(value, indent=2, inf_nan_mode="null", fallback=_plain).decode() + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return np.asarray(value).tolist() if hasattr(value, "__array__") else str(value)


def config_hash(config: Mapping[str, Any]) -> str:
    """The SHA-256 of a configuration, independent of the order of its keys."""
    canonical = json.dumps(json.loads(json_text(config)), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


@contextmanager
def beside(path: Path, make: Callable[[Path], object] = Path.touch) -> Iterator[Path]:
    """A new file (`Path.mkdir`: folder) beside `path`, to be renamed to it within the block, and removed otherwise."""
    temporary = path.with_name(f"{PREFIX}{uuid.uuid4().hex[:8]}-{path.name}")
    try:
        make(temporary)
        yield temporary
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    with suppress(OSError):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
