"""Atomic writes, the temporary files and folders that they need, and strict JSON without NaN.

Each temporary is beside what it becomes, and locked (flock) while its process runs; the system ends the lock with the
process, however that ends. What has the prefix and no lock is abandoned, and is removed by the next process that writes
to the folder.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput

try:
    import fcntl
except ImportError:  # Windows has no such locks: what a killed process left there stays
    fcntl = None  # type: ignore[assignment]

PREFIX = ".trackwright-"
Content = pl.DataFrame | str | bytes


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


def write_whole(path: Path, content: Content) -> Path:
    """Writes a table, a text or bytes, and its folder; returns the path. Raises UnusableInput as `atomic_write`.

    Tables are packed in 60 % of the time of the default level, into files that are 1/7 larger.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"{path.parent}: cannot be created ({error.strerror}); choose another --out") from error

    def writer(temporary: Path) -> None:
        if isinstance(content, pl.DataFrame):
            content.write_parquet(temporary, compression_level=1)
        else:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)

    return atomic_write(path, writer)


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


@contextmanager
def beside(path: Path, make: Callable[[Path], object] = Path.touch) -> Iterator[Path]:
    """A new file beside `path`, to be renamed to it within the block, and removed otherwise; `Path.mkdir`: a folder.

    The first one in a folder removes what killed processes left there. Raises OSError where it cannot be made.
    """
    _clear_once(path.absolute().parent)
    temporary = path.with_name(f"{PREFIX}{uuid.uuid4().hex[:8]}-{path.name}")
    lock = None
    try:
        lock = _made(temporary, make)
        yield temporary
    finally:
        with suppress(OSError):  # missing or unreadable folder, which the first error reports
            _remove(temporary)
        if lock is not None:
            os.close(lock)


def remove_abandoned(folder: Path) -> None:
    """Removes the temporary files and folders in there whose process no longer runs."""
    if fcntl is None:
        return
    for path in folder.glob(f"{PREFIX}*"):
        with suppress(OSError):  # in use, or gone
            lock = _opened(path)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove(path)
            finally:
                os.close(lock)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keeps other processes that ask for it out of a folder; raises UnusableInput where one has it."""
    if fcntl is None:
        yield
        return
    lock = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            fix = "wait until that has ended, or choose another folder"
            raise UnusableInput(f"{folder}: another command writes to it; {fix}") from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(lock)


# Of the folders written to last: a command may write to thousands.
_clear_once = functools.lru_cache(maxsize=64)(remove_abandoned)


def _made(path: Path, make: Callable[[Path], object]) -> int | None:
    """Makes the file or folder; the descriptor that holds its lock, None where the system has none."""
    while True:
        make(path)
        if fcntl is None:
            return None
        # Another process may take it for abandoned before it is locked.
        with suppress(FileNotFoundError):
            lock = _opened(path)
            with suppress(OSError):  # a file system without locks: nobody takes it for abandoned
                fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists():
                return lock
            os.close(lock)


def _opened(path: Path) -> int:
    # NFS gives exclusive locks to writers alone, and nobody can write to a folder.
    return os.open(path, (os.O_RDONLY if path.is_dir() else os.O_RDWR) | os.O_NOFOLLOW)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
