"""Disk cache of compiled programs in a directory of the user, shared by later processes.

jax looks a program up by its text, the compiler's version and options; the name of the directory adds the processor,
whose instructions the programs contain, so that machines may share a home, and the version of Python, which from 3.14
on compresses them in another way that jax does not look up. jax's own cache is not used: it writes files in place,
never replaces a damaged one, and bounds their size only with another package. Whoever can write to the directory can
run code as its user.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import stat
import sys
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import jax

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.jax_private import cache_opener, set_cache_opener

VARIABLE = "TRACKWRIGHT_CACHE"
"""The environment variable that names the directory, or is `off`."""

LIMIT_BYTES = 512 * 2**20
"""The most bytes of all programs; the least recently used are removed first."""

CHECKED_EVERY = 16
"""Programs written between two checks of the directory's size."""

DIGEST_BYTES = 16
PREFIX = "jaxlib-"


def cache_programs(directory: str | Path | None = None, report: Callable[[str], object] = warnings.warn) -> Path | None:
    """Keep compiled programs in a directory and use earlier processes'; returns the directory in use.

    `directory`: by default the value of TRACKWRIGHT_CACHE, else `trackwright` in the user's cache directory; created
    with mode 0700. `report` gets one line if a program cannot be written, after which none is. Returns None and
    changes nothing where TRACKWRIGHT_CACHE is `off`, where jax has a cache already, or where its release lets none be
    added. Numbers are the same with and without.
    Raises UnusableInput for a directory that cannot be created, is another user's, or that others can write to.
    """
    if directory is None and os.environ.get(VARIABLE) == "off":
        return None
    present = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if cache_opener() is None or (present is not None and store_in_use() is None):
        return None
    root = Path(directory or os.environ.get(VARIABLE) or default_directory()).expanduser().absolute()
    folder = root / f"{PREFIX}{jax.lib.__version__}-{platform.python_version()}-{processor()}"
    for path in (root, folder):
        _require_private(path)
    if present != str(folder):
        set_cache_opener(ProgramStore(folder, report))
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return folder


def default_directory() -> Path:
    """The user's cache directory, by the platform's convention."""
    if sys.platform == "darwin":
        return Path("~/Library/Caches/trackwright")
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path("~/.cache")) / "trackwright"


def processor() -> str:
    """A short digest of the processor's model and instructions."""
    text = f"{platform.machine()} {platform.processor()}"
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").split("\n\n", 1)[0].splitlines()
        text += "".join(line for line in lines if line.startswith(("model name", "flags", "Features")))
    return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()


def _require_private(path: Path) -> None:
    """Creates the directory if missing; raises UnusableInput unless it is the user's and closed to other writers."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.stat()
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UnusableInput(
            f"{path}: compiled programs cannot be kept there ({reason}); expected a directory of your own; "
            f"set {VARIABLE}"
        ) from error
    if os.name != "posix":
        return
    if status.st_uid != os.geteuid():
        raise UnusableInput(
            f"{path}: compiled programs are not kept there: it belongs to user {status.st_uid}, and they run as code; "
            f"expected a directory of your own; set {VARIABLE}"
        )
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise UnusableInput(
            f"{path}: compiled programs are not kept there: others can write to it (mode "
            f"{stat.S_IMODE(status.st_mode):04o}), and they run as code; expected mode 0700; run chmod 700"
        )


_bypassed = threading.local()


@contextlib.contextmanager
def compiling_anew() -> Iterator[None]:
    """Bypass all stores in this thread."""
    _bypassed.now = True
    try:
        yield
    finally:
        _bypassed.now = False


class ProgramStore:
    """The programs in one folder, a file each: a digest, then the bytes that it is of.

    Files are written atomically, and one with a wrong digest is removed, so that any number of processes may share the
    folder.
    """

    def __init__(self, folder: Path, report: Callable[[str], object]) -> None:
        self._path = folder
        self.report = report
        self.writable = True
        self.written = 0

    def __call__(self, path: str) -> tuple[ProgramStore, str]:
        """In place of jax's function that opens a cache directory."""
        return self, path

    def get(self, key: str) -> bytes | None:
        """The program, None where it is missing or damaged."""
        if getattr(_bypassed, "now", False):
            return None
        path = self._path / key
        try:
            content = path.read_bytes()
        except OSError:
            return None
        digest, program = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
        damaged = digest != _digest(program)
        with contextlib.suppress(OSError):
            # The modification time records the last use.
            path.unlink() if damaged else os.utime(path)
        return None if damaged else program

    def put(self, key: str, value: bytes) -> None:
        """Write a program; the first failure is reported and ends all writing."""
        if not self.writable or getattr(_bypassed, "now", False):
            return
        temporary = self._path / f".{uuid.uuid4().hex[:16]}"
        try:
            temporary.write_bytes(_digest(value) + value)
            temporary.replace(self._path / key)
            if self.written % CHECKED_EVERY == 0:
                remove_oldest(self._path.parent)
            self.written += 1
        except OSError as error:
            self.writable = False
            with contextlib.suppress(OSError):
                temporary.unlink()
            self.report(
                f"{self._path}: compiled programs are not kept ({error.strerror}); the next run compiles them again; "
                f"check space and permissions, or set {VARIABLE}"
            )


def store_in_use() -> ProgramStore | None:
    """The store of `cache_programs`, None where jax has another cache or none."""
    store, present = cache_opener(), jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return store if isinstance(store, ProgramStore) and str(store._path) == present else None


def remove_oldest(root: Path, limit: int = LIMIT_BYTES) -> None:
    """Removes the least recently used programs, of other versions too, until nine tenths of the limit are left."""
    files = []
    for path in root.glob(f"{PREFIX}*/*"):
        with contextlib.suppress(OSError):
            status = path.lstat()
            if stat.S_ISREG(status.st_mode):
                files.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in files)
    if total <= limit:
        return
    for _, size, path in sorted(files):
        with contextlib.suppress(OSError):
            path.unlink()
            total -= size
        if total <= 0.9 * limit:
            return


def _digest(program: bytes) -> bytes:
    return hashlib.blake2b(program, digest_size=DIGEST_BYTES).digest()


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
