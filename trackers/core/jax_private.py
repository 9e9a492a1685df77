"""The parts of jax that a release may change or drop, and what is done without them: the same numbers, more slowly.

Nothing else of ours imports `jax._src`, `jax.extend` or `jax.interpreters`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax

MISSING = ImportError, AttributeError  # what is raised where a release of jax lacks a part

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


EXTRA = "trackwright_extra_options"
"""The key among the options of a compilation at which `extra_options` stand, as a part of XLA's serialized options."""


def extra_options(options: dict[str, str]) -> dict[str, bytes]:
    """Entries of XLA's `xla_backend_extra_options` for one compilation; nothing where this release of jax lacks a way.

    XLA refuses this table among options given by name, so jax's options get it in serialized form: before the entries
    of XLA_FLAGS, which thus prevail.
    """
    try:
        compiler: Any = import_module("jax._src.compiler")
        caller = import_module("jax._src.interpreters.pxla").create_compile_options
        if "get_compile_options" not in caller.__code__.co_names:
            return {}
        if not hasattr(compiler.get_compile_options, EXTRA):
            compiler.get_compile_options = _taking_extra(compiler.get_compile_options)
    except MISSING:
        return {}
    entries = (_field(500, _field(1, k.encode()) + _field(2, v.encode())) for k, v in options.items())
    return {EXTRA: _field(3, _field(3, b"".join(entries)))}


def _taking_extra(given: Callable[..., Any]) -> Callable[..., Any]:
    """jax's function that makes the options of a compilation, which also takes `EXTRA` among them."""

    def get_compile_options(*args: Any, env_options_overrides: Any = None, **kwargs: Any) -> Any:
        overrides = dict(env_options_overrides or {})
        extra = overrides.pop(EXTRA, None)
        options = given(*args, env_options_overrides=overrides or None, **kwargs)
        return options if extra is None else options.ParseFromString(extra + options.SerializeAsString())

    setattr(get_compile_options, EXTRA, True)
    return get_compile_options


def _field(number: int, content: bytes) -> bytes:
    """A field of a protocol buffer: its key and length as numbers of seven bits a byte, and its content."""

    def number_of(value: int) -> bytes:
        return bytes([value]) if value < 128 else bytes([value % 128 + 128]) + number_of(value // 128)

    return number_of(number * 8 + 2) + number_of(len(content)) + content


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
