"""Disk cache of compiled programs, keyed by function and argument types, so that a later command traces nothing.

jax looks a program up by its text, which takes up to three seconds of tracing per tracker. The key here is the pickled
function with its arguments, arrays reduced to shape and type, and also the text of our packages, all versions, the
settings of jax and XLA, and the processor. The machine code is the traced program's. A function or an argument
that is not of our packages, or that cannot be pickled, is traced.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import platform
import re
import sys
import warnings
import zlib
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax.experimental import serialize_executable

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.jax_private import trace_settings
from trackwright.trackers.programs.program_cache import (
    ProgramStore,
    cache_programs,
    compiling_anew,
    give_back,
    processor,
    store_in_use,
)

OURS = ("trackers", "tuning", "sim", "experiments/monte_carlo")
OTHERS = ("builtins", "collections", "copyreg", "equinox", "functools", "jax", "jaxlib", "numpy")
KNOWN = tuple(f"{name}." for name in (*(f"trackwright.{x.replace('/', '.')}" for x in OURS), *OTHERS))
"""The packages whose classes and functions may occur in a key, since it has their text or version."""

USERS_FILE = "trackwright_"
"""Prefix of the modules that are files of users, which may replace any function of ours."""

PREFIX = "traced-"

Program = Callable[[Any, Any], Any]


class TracedPrograms:
    """The programs that this process has loaded or compiled, and earlier processes' in `store`."""

    def __init__(self, store: ProgramStore) -> None:
        self.store = store
        self.loaded: dict[bytes, Program] = {}
        self.base = _base()
        self.modules: tuple[tuple[int, str], bool] = ((0, ""), False)

    def program(
        self, function: Callable[[Any, Any], Any], model: Any, part: Any, options: dict[str, Any] | None = None
    ) -> Program | None:
        """The compiled `function(model, part)` for arguments of these types; None where they have no key.

        `options`: of the compiler, a function of the arguments.
        """
        leaves, structure = jax.tree_util.tree_flatten((model, part))
        key = self._key(function, (model, part))
        if key is None:
            return None
        if key not in self.loaded:
            name = PREFIX + hashlib.blake2b(key, digest_size=24).hexdigest()
            program = self._read(name, leaves)
            if program is None:
                # XLA loses functions of a program that it loads and serialises again.
                with compiling_anew():
                    program = _compiled(function, leaves, structure, options)
                self._write(name, *program)
            self.loaded[key] = _called(*program)
        return self.loaded[key]

    def _key(self, function: Any, arguments: Any) -> bytes | None:
        if jax.local_device_count() > 1 or jax.default_backend() != "cpu":
            return None
        settings = trace_settings()
        if settings is None or self._users_files():
            return None
        made_of = io.BytesIO()
        try:
            # The objects, not jax's structure of them: that compares some static fields by identity.
            _KeyPickler(made_of, protocol=5).dump((function, types_of(arguments)))
        except (pickle.PicklingError, TypeError, AttributeError):
            return None
        return b"".join((self.base, _text(settings).encode(), made_of.getvalue()))

    def _users_files(self) -> bool:
        """Whether files of users were imported."""
        # There are hundreds of modules: they are searched again only when one was imported.
        modules = len(sys.modules), next(reversed(sys.modules))
        if modules != self.modules[0]:
            self.modules = modules, any(name.startswith(USERS_FILE) for name in [*sys.modules])
        return self.modules[1]

    def _read(self, name: str, leaves: list[Any]) -> tuple[Any, Any] | None:
        content = self.store.get(name)
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
        self.store.put(name, content)


def types_of(arguments: Any) -> Any:
    """The arguments of a program with each array reduced to its shape and type."""
    return jax.tree_util.tree_map(
        lambda x: (x.shape, str(x.dtype), getattr(x, "weak_type", False)) if eqx.is_array(x) else x, arguments
    )


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


_in_use: TracedPrograms | None = None


def use(store: ProgramStore) -> None:
    """Load programs from this store from now on; for processes that replace no function of ours."""
    global _in_use
    _in_use = TracedPrograms(store)


def kept_program(
    function: Callable[[Any, Any], Any], model: Any, part: Any, options: dict[str, Any] | None
) -> Program | None:
    """The compiled `function(model, part)` from the store in use; None without a store, or where it must be traced."""
    return None if _in_use is None else _in_use.program(function, model, part, options)


def keep_programs(say: Callable[[str], object]) -> None:
    """Keeps programs in the user's cache directory; `say` gets a line where that is impossible."""
    # A program that jax cannot load is compiled and replaced.
    warnings.filterwarnings("ignore", message="Error reading persistent compilation cache entry")
    try:
        cache_programs(report=say)
    except UnusableInput as problem:
        say(str(problem))
    if (store := store_in_use()) is not None:
        use(store)
