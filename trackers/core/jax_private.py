"""The parts of jax that a release may change or drop, and what is done without them: the same numbers, more slowly.

Nothing else of ours imports `jax._src`, `jax.extend` or `jax.interpreters`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax

MISSING = ImportError, AttributeError
"""What is raised where a release of jax lacks a part."""

CACHE = "jax._src.compilation_cache"


def identity(name: str, written: Callable[[Any], Any], platform: str | None = None) -> Callable[[Any], Any]:
    """A function that returns its array and that XLA compiles as `written`, on one platform or all.

    To jax it is one linear operation, elementwise under `vmap`. Without primitives: a function that returns its array.
    """
    try:
        from jax.extend.core import Primitive
        from jax.interpreters import ad, batching, mlir

        primitive = Primitive(name)
        primitive.def_impl(jax.jit(written) if platform is None else lambda x: x)
        primitive.def_abstract_eval(lambda x: x)
        ad.deflinear2(primitive, lambda cotangent, _: [primitive.bind(cotangent)])
        batching.defvectorized(primitive)
        if platform is not None:
            mlir.register_lowering(primitive, lambda _, x: [x])
        mlir.register_lowering(primitive, mlir.lower_fun(written, multiple_results=False), platform=platform)
    except MISSING:
        return lambda x: x
    return primitive.bind


def is_literal(atom: Any) -> bool:
    """Whether an atom of a jaxpr is a constant, in `atom.val`, and no variable."""
    return hasattr(atom, "val")


def live_part(jaxpr: Any) -> tuple[Any, list[bool]]:
    """The jaxpr without equations that no output needs, and which inputs are left; all of it without that pass."""
    try:
        from jax.interpreters.partial_eval import dce_jaxpr

        live, used = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
        return live, list(used)
    except MISSING:
        return jaxpr, [True] * len(jaxpr.invars)


def trace_settings() -> Any:
    """The settings of jax that a traced program depends on; None where they cannot be read."""
    try:
        return import_module("jax._src.config").trace_context()
    except MISSING:
        return None


def cache_opener() -> Any:
    """jax's function that opens a directory of compiled programs, from a path to a cache and its path; None without."""
    try:
        return import_module(CACHE).get_file_cache
    except MISSING:
        return None


def set_cache_opener(opener: Any) -> None:
    """Has jax open directories by `opener` from now on, where it has a function for that."""
    module: Any = import_module(CACHE)
    module.reset_cache()
    module.get_file_cache = opener
