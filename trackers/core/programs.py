"""Compiled programs, kept in a directory of the user for later processes under two keys.

jax looks a program up by its text, the compiler's version and options;
the name of the directory adds the processor, whose instructions the programs contain, so that machines may share a
home, and the version of Python, which from 3.14 on compresses them in another way that jax does not look up. jax's own
cache is not used: it writes files in place, never replaces a damaged one, and bounds their size only with another
package. Whoever can write to the directory can run code as its user.

The text of a program takes up to three seconds of tracing per tracker. So programs of ours have a second key, by which
a later command traces nothing: the pickled function with its arguments, arrays reduced to shape and type, and also the
text of our packages, all versions, the settings of jax and XLA, and the processor. The machine code is the traced
program's. A function or an argument that is not of our packages, or that cannot be pickled, is traced.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
import os
import pickle
import platform
import re
import stat
import sys
import threading
import uuid
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax.experimental import serialize_executable

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.jax_private import cache_opener, set_cache_opener, trace_settings

VARIABLE = "TRACKWRIGHT_CACHE"  # the environment variable that names the directory, or is `off`

LIMIT_BYTES = 512 * 2**20  # the most bytes of all programs; the least recently used are removed first

CHECKED_EVERY = 16  # programs written between two checks of the directory's size

DIGEST_BYTES = 16
FOLDER_PREFIX, PREFIX = "jaxlib-", "traced-"  # of a version's folder, and of the files of programs with the second key


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
    if cache_opener() is None or (present is not None and _store_of_jax() is None):
        return None
    root = Path(directory or os.environ.get(VARIABLE) or default_directory()).expanduser().absolute()
    folder = root / f"{FOLDER_PREFIX}{jax.lib.__version__}-{platform.python_version()}-{processor()}"
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
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").split("\n\n", 1)[0].splitlines()
        text += "".join(line for line in lines if line.startswith(("model name", "flags", "Features")))
    return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()


def _require_private(path: Path) -> None:
    """Creates the directory if missing; raises UnusableInput unless it is the user's and closed to other writers."""
    own = f"expected a directory of your own; set {VARIABLE}"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.stat()
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnusableInput(f"{path}: compiled programs cannot be kept there ({reason}); {own}") from error
    if os.name == "posix" and status.st_uid != os.geteuid():
        wrong, fix = f"it belongs to user {status.st_uid}", own
    elif os.name == "posix" and status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        wrong = f"others can write to it (mode {stat.S_IMODE(status.st_mode):04o})"
        fix = "expected mode 0700; run chmod 700"
    else:
        return
    raise UnusableInput(f"{path}: compiled programs are not kept there: {wrong}, and they run as code; {fix}")


def _store_of_jax() -> ProgramStore | None:
    """The store of `cache_programs`, None where jax has another cache or none."""
    store, present = cache_opener(), jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return store if isinstance(store, ProgramStore) and str(store._path) == present else None


def remove_oldest(root: Path, limit: int = LIMIT_BYTES) -> None:
    """Removes the least recently used programs, of other versions too, until nine tenths of the limit are left."""
    files = []
    for path in root.glob(f"{FOLDER_PREFIX}*/*"):
        with suppress(OSError):
            status = path.lstat()
            if stat.S_ISREG(status.st_mode):
                files.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in files)
    least = 0.9 * limit if total > limit else total
    for _, size, path in sorted(files):
        if total > least:
            with suppress(OSError):
                path.unlink()
                total -= size


Program = Callable[[Any, Any], Any]

_bypassed = threading.local()
"""`now`: whether this thread compiles a program that jax must not take from a store."""


class ProgramStore:
    """The programs in one folder, a file each: a digest, then the bytes that it is of; `loaded`: by the second key.

    Files are written atomically, and one with a wrong digest is removed, so that any number of processes may share the
    folder.
    """

    def __init__(self, folder: Path, report: Callable[[str], object]) -> None:
        self._path, self.report = folder, report  # jax reads `_path`
        self.writable, self.written = True, 0
        self.loaded: dict[bytes, Program] = {}

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
        with suppress(OSError):
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
            with suppress(OSError):
                temporary.unlink()
            self.report(
                f"{self._path}: compiled programs are not kept ({error.strerror}); the next run compiles them again; "
                f"check space and permissions, or set {VARIABLE}"
            )

    def program(
        self, function: Callable[[Any, Any], Any], model: Any, part: Any, options: dict[str, Any] | None = None
    ) -> Program | None:
        """The compiled `function(model, part)` for arguments of these types; None where they have no second key.

        `options`: of the compiler, a function of the arguments.
        """
        leaves, structure = jax.tree_util.tree_flatten((model, part))
        key = _key(function, (model, part))
        if key is None:
            return None
        if key not in self.loaded:
            name = PREFIX + hashlib.blake2b(key, digest_size=24).hexdigest()
            program = self._read(name, leaves)
            if program is None:
                # XLA loses functions of a program that it loads and serialises again.
                _bypassed.now = True
                try:
                    program = _compiled(function, leaves, structure, options)
                finally:
                    _bypassed.now = False
                self._write(name, *program)
            self.loaded[key] = _called(*program)
        return self.loaded[key]

    def _read(self, name: str, leaves: list[Any]) -> tuple[Any, Any] | None:
        content = self.get(name)
        if content is None:
            return None
        arguments = jax.tree_util.tree_structure((tuple(x for x in leaves if eqx.is_array(x)), {}))
        try:
            payload, result = pickle.loads(zlib.decompress(content))
            indices, outputs = jax.tree_util.tree_flatten(result)
            flat = jax.tree_util.tree_structure(list(indices))
            loaded = serialize_executable.deserialize_and_load(payload, arguments, flat)
        except Exception:  # a compiler raises anything for a program that it cannot load; it is compiled again
            return None
        # Loading frees 60 MB and more of a large program.
        give_back()
        return loaded, outputs

    def _write(self, name: str, compiled: Any, outputs: Any) -> None:
        try:
            payload = serialize_executable.serialize(compiled)[0]
            result = jax.tree_util.tree_unflatten(outputs, range(outputs.num_leaves))
            content = zlib.compress(pickle.dumps((payload, result)), 1)
        except (pickle.PicklingError, TypeError, AttributeError, ValueError):
            return
        self.put(name, content)


def _digest(program: bytes) -> bytes:
    return hashlib.blake2b(program, digest_size=DIGEST_BYTES).digest()


def compiled_program(
    function: Callable[[Any, Any], Any], model: Any, part: Any, options: dict[str, Any] | None = None
) -> Program:
    """The compiled `function(model, part)` for arguments of these types, which no store keeps."""
    return _called(*_compiled(function, *jax.tree_util.tree_flatten((model, part)), options))


def _compiled(
    function: Callable[[Any, Any], Any], leaves: list[Any], structure: Any, options: dict[str, Any] | None
) -> tuple[Any, Any]:
    """The compiled program of the arrays among the leaves, as a list, and the structure of its result."""
    structures = []

    def flat(*arrays: Any) -> list[Any]:
        numbers = iter(arrays)
        arguments = jax.tree_util.tree_unflatten(structure, [next(numbers) if eqx.is_array(x) else x for x in leaves])
        result, outputs = jax.tree_util.tree_flatten(function(*arguments))
        structures.append(outputs)
        return result

    compiled = jax.jit(flat).lower(*(x for x in leaves if eqx.is_array(x))).compile(options)
    return compiled, structures[-1]


def _called(compiled: Any, outputs: Any) -> Program:
    """The program as a function of model and part; `outputs`: the structure of its result."""

    def program(model: Any, part: Any) -> Any:
        arrays = (x for x in jax.tree_util.tree_leaves((model, part)) if eqx.is_array(x))
        return jax.tree_util.tree_unflatten(outputs, compiled(*arrays))

    return program


OURS = ("trackers", "tuning", "sim", "experiments/monte_carlo")
OTHERS = ("builtins", "collections", "copyreg", "equinox", "functools", "jax", "jaxlib", "numpy")
KNOWN = tuple(f"{name}." for name in (*(f"trackwright.{x.replace('/', '.')}" for x in OURS), *OTHERS))
"""The packages whose classes and functions may occur in a key, since it has their text or version."""

USERS_FILE = "trackwright_"  # prefix of the modules that are files of users, which may replace any function of ours


def _key(function: Any, arguments: Any) -> bytes | None:
    """The second key of a program, None where it must be traced."""
    settings = trace_settings()
    elsewhere = jax.local_device_count() > 1 or jax.default_backend() != "cpu"
    if elsewhere or settings is None or _has_users_file(len(sys.modules), next(reversed(sys.modules))):
        return None
    made_of = io.BytesIO()
    try:
        # The objects, not jax's structure of them: that compares some static fields by identity.
        _KeyPickler(made_of, protocol=5).dump((function, types_of(arguments)))
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    return b"".join((_base(), _text(settings).encode(), made_of.getvalue()))


@lru_cache(maxsize=1)
def _has_users_file(modules: int, last: str) -> bool:
    """Whether a user's file is among so many modules; hundreds are searched again only when one was imported."""
    return any(name.startswith(USERS_FILE) for name in [*sys.modules])


def types_of(arguments: Any) -> Any:
    """The arguments of a program with each array reduced to its shape and type."""
    return jax.tree_util.tree_map(
        lambda x: (x.shape, str(x.dtype), getattr(x, "weak_type", False)) if eqx.is_array(x) else x, arguments
    )


class _KeyPickler(pickle.Pickler):
    """A pickler that refuses objects of packages whose text or version is not part of the key."""

    def reducer_override(self, obj: Any) -> Any:
        module = getattr(obj if isinstance(obj, type) or callable(obj) else type(obj), "__module__", None) or ""
        if not f"{module}.".startswith(KNOWN):
            raise pickle.PicklingError(f"{obj!r}: of {module}")
        return NotImplemented


@cache
def _text(settings: Any) -> str:
    """The settings of jax as text, without addresses."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(settings))


@cache
def _base() -> bytes:
    """The part of the key that all programs of this process share."""
    root = Path(__file__).parents[2]
    parts = [platform.python_version(), processor(), os.environ.get("XLA_FLAGS", "")]
    parts += [f"{name} {version(name)}" for name in ("jax", "jaxlib", "numpy", "equinox")]
    digest = hashlib.blake2b("\n".join(parts).encode(), digest_size=24)
    for package in OURS:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.digest()


_in_use: ProgramStore | None = None


def kept_program(
    function: Callable[[Any, Any], Any], model: Any, part: Any, options: dict[str, Any] | None
) -> Program | None:
    """The compiled `function(model, part)` from the store in use; None without a store, or where it must be traced."""
    return None if _in_use is None else _in_use.program(function, model, part, options)


def keep_programs(say: Callable[[str], object]) -> None:
    """Keeps programs, in processes that replace no function of ours; `say` gets a line where that is impossible."""
    global _in_use
    # A program that jax cannot load is compiled and replaced.
    warnings.filterwarnings("ignore", message="Error reading persistent compilation cache entry")
    try:
        cache_programs(report=say)
    except UnusableInput as problem:
        say(str(problem))
    _in_use = _store_of_jax() or _in_use


KEPT, LARGEST = 2**28, 2**25
"""Bytes of freed memory that are kept, and of the largest array that is kept: glibc's limit."""


def _glibc(function: str, *arguments: int) -> None:
    """Calls a function of glibc; nothing happens without it."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            getattr(ctypes.CDLL(None), function)(*arguments)


def keep() -> None:
    """Keep freed memory for the next arrays.

    The system clears every page that it hands out, which took a third of a study's processor time in workers of Dask,
    whose limit is low.
    """
    for parameter, value in ((-1, KEPT), (-3, LARGEST)):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
        _glibc("mallopt", parameter, value)


def give_back() -> None:
    """Return freed memory to the system, within milliseconds."""
    _glibc("malloc_trim", 0)
