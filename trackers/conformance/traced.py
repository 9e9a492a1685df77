"""Calls of a user's functions as a filter makes them, with what goes wrong as a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.conformance.contract import BrokenContract
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.inputs import Input, Inputs, Need
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.run.requirements import GivenInputs, MissingInputError

Tree = TypeVar("Tree")


@contextmanager
def attributes_named(what: str, role: str, given: Any) -> Iterator[None]:
    """Raises `BrokenContract` for an attribute that `given`, the view or the state, or a vector lacks."""
    try:
        yield
    except AttributeError as error:
        if error.obj is given:
            fields = ", ".join(dict.fromkeys(part.partition(".")[0] for part in component_names(given)))
            has = f"the {role}, a {type(given).__name__}, which has {fields}"
        elif isinstance(error.obj, Vector):
            has = f"a vector; expected its components by number, [0] to [{len(error.obj) - 1}]"
        else:
            raise
        raise BrokenContract(f"{what} reads '{error.name}' of {has}; usual fix: one of these") from None


def known_inputs(what: str, declared: Sequence[Input], channels: int, view: Any, inputs: Inputs | None) -> GivenInputs:
    """The inputs as arrays; raises `BrokenContract` for a declared one that is missing or of another shape."""
    there = GivenInputs(arrays(dict(inputs or {})), what)
    planar = len(getattr(view, "position", ())) == 2
    for one in declared:
        expected = f"expected {one.name}, shape {one.row_shape(channels)}, {one.unit or '1'}: {one.about}"
        if one.name not in there and (one.need is Need.ALWAYS or (one.need is Need.PLANAR and planar)):
            raise BrokenContract(
                f"{what} reads the input '{one.name}', found {', '.join(there) or 'no input'}; {expected}; usual fix: "
                f"inputs={{'{one.name}': …}} in the call of this check"
            )
        if one.name in there and np.shape(there[one.name]) != one.row_shape(channels):
            raise BrokenContract(
                f"{what} reads the input '{one.name}', found shape {np.shape(there[one.name])}; {expected}; usual fix: "
                "the input of one row"
            )
    return there


def arrays(tree: Tree) -> Tree:
    """The tree with its floats as arrays of jax's default precision, as in a run."""
    kind = jnp.zeros(0).dtype

    def cast(x: Any) -> Any:
        if isinstance(x, (bool, int)) or not (hasattr(x, "dtype") or isinstance(x, float)):
            return x
        return jnp.asarray(x, kind) if np.issubdtype(np.asarray(x).dtype, np.floating) else jnp.asarray(x)

    return jax.tree_util.tree_map(cast, tree)


def called(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a jitted function; raises `BrokenContract` if jax cannot trace it, or for a missing input."""
    try:
        return function(*arguments)
    except MissingInputError as missing:
        raise BrokenContract(
            f"{missing.reader} reads the input '{missing.name}', which is neither declared nor given; expected it in "
            "the property `inputs`, and in the argument `inputs` of this check; usual fix: add it to both"
        ) from None
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        reason = str(error).splitlines()[0]
        raise BrokenContract(
            f"{what} cannot be traced ({reason}); usual fix: jnp.where instead of if, jnp instead of math and numpy"
        ) from error


def same_bits(a: Any, b: Any) -> bool:
    """Whether the numbers of two trees are bit-identical."""
    leaves = zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True)
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in leaves)


def shapes_of(tree: Any) -> list[tuple[int, ...]]:
    """The shapes of all numbers of a tree."""
    return [np.shape(x) for x in jax.tree_util.tree_leaves(tree)]


def described(tree: Any) -> str:
    """The type of a tree and its shapes, in words."""
    return f"{type(tree).__name__} with shapes {shapes_of(tree)}"


def unlike(found: Any, expected: Any) -> str:
    """What is found, in words that tell it from what is expected."""
    if type(found) is not type(expected):
        same = " of another class of that name, whose file was run twice" * (
            type(found).__name__ == type(expected).__name__
        )
        return described(found) + same
    fields: Sequence[str] = getattr(expected, "_fields", ()) or getattr(expected, "__dataclass_fields__", ())
    pairs = [(field, getattr(found, field), getattr(expected, field)) for field in fields]
    kinds = [
        f"{field}: {type(one).__name__} for {type(other).__name__}"
        for field, one, other in pairs
        if type(one) is not type(other) and not eqx.is_array_like(other)
    ]
    return described(found) + (f" ({', '.join(kinds)})" if kinds else "")


def require_finite(what: str, values: Any, names: Sequence[str]) -> None:
    """Raises for the first non-finite entry; `values`: one row, or one number, per name."""
    bad = np.argwhere(~np.isfinite(np.asarray(values)))
    if len(bad):
        raise BrokenContract(
            f"{what} is not finite at {names[bad[0, 0]]}; usual fix: jnp.where around the argument of a root, "
            "division or arctangent, not only around its result"
        )
