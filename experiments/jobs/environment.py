"""What the bits of a result depend on beside its arguments: versions, flags, number format, kind of device."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from trackwright.trackers.core.errors import UnusableInput

# jax and the modules that import it are imported in functions: in a worker after the XLA flags are set.

PACKAGES = ("jax", "jaxlib", "numpy")
SOURCES = ("trackers", "sim", "tuning", "experiments")
SET = ("x64", "programs kept")


def environment() -> dict[str, Any]:
    """What the bits of a result depend on beside its arguments: versions, flags, number format, kind of device. The
    `SET` ones are set in a worker for each part: the number format, and whether compiled programs are kept."""
    import jax

    return {
        "trackwright": f"{_version('trackwright')}, sources {_sources()}",
        **{name: _version(name) for name in PACKAGES},
        "XLA flags": os.environ.get("XLA_FLAGS", ""),
        "device": jax.devices()[0].device_kind,
        "vector instructions": _vector_instructions(),
        "x64": bool(jax.config.jax_enable_x64),  # type: ignore[attr-defined]
        "programs kept": jax.config.jax_compilation_cache_dir is not None,  # type: ignore[attr-defined]
    }


def require_same(expected: Mapping[str, Any], actual: Any, worker: str) -> None:
    """Refuse a worker whose environment differs from the caller's."""
    if isinstance(actual, BaseException):
        why = f"{type(actual).__name__}: {actual}"
        raise UnusableInput(f"{worker}: cannot import trackwright ({why}); install the caller's packages there")
    for key in expected:
        if key not in SET and actual.get(key) != expected[key]:
            here = f"expected as here: {expected[key] or 'none'}; the bits would differ"
            fix = "give the worker the caller's environment, and start it anew"
            raise UnusableInput(f"{worker}: {key}: {actual.get(key) or 'none'}; {here}; {fix}")


@functools.cache
def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


@functools.cache
def _sources() -> str:
    """A digest of the package's source files: two checkouts of one version may differ."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for path in sorted(path for package in SOURCES for path in (root / package).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


@functools.cache
def _vector_instructions() -> str:
    """The processor's widest vector instructions: NumPy has other sines and logarithms for others, with other bits."""
    try:
        flags = set(re.findall(r"\w+", Path("/proc/cpuinfo").read_text("utf-8")))
    except OSError:
        flags = set()
    widest = next((name for name in ("avx512f", "avx2", "avx") if name in flags), "")
    return f"{platform.machine()} {widest}".strip()
