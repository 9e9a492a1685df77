"""The tuned numbers of a tracker as one unconstrained vector, and back."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import AbstractTunable, matching, replaced, tunables

TIED = "tied:"


@dataclass(frozen=True)
class Parameter:
    """One tunable, or several tied to be equal: `names` of the tracker's tree, `example` for unit and constraint.

    `label`: under what it is reported, its name, or for tied ones the pattern that found them.
    """

    names: tuple[str, ...]
    example: AbstractTunable
    label: str


def select_parameters(
    tracker: AbstractTracker, patterns: str | Sequence[str], frozen: Sequence[str] = ()
) -> list[Parameter]:
    """The parameters that the patterns name, but for the `frozen`; `tied:PATTERN` makes one of all that match.

    Raises ValueError when there is no pattern, one matches nothing, tied tunables have different units or shapes, or
    nothing is left that is not frozen.
    """
    parameters: list[Parameter] = []
    taken: set[str] = set(matching(tracker, frozen)) if frozen else set()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = {k: v for k, v in matching(tracker, pattern.removeprefix(TIED)).items() if k not in taken}
        taken.update(found)
        if pattern.startswith(TIED) and found:
            kinds = {(jax.tree_util.tree_structure(v), np.shape(v.raw)) for v in found.values()}
            if len(kinds) > 1:
                raise ValueError(f"'{pattern}' ties tunables of different units or shapes: {', '.join(found)}")
            label = pattern.removeprefix(TIED) if len(found) > 1 else next(iter(found))
            parameters.append(Parameter(tuple(found), next(iter(found.values())), label))
        else:
            parameters += [Parameter((name,), node, name) for name, node in found.items()]
    if not parameters:
        raise ValueError("no pattern is given that names anything but what is frozen, so nothing would be tuned")
    return parameters


def flatten(parameters: Sequence[Parameter]) -> np.ndarray:
    """The unconstrained vector of the parameters' present values."""
    return np.concatenate([np.ravel(np.asarray(p.example.raw, float)) for p in parameters])


def limits(parameters: Sequence[Parameter], bounds: Mapping[str, tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest unconstrained vector (p,), of physical bounds by pattern, infinite elsewhere.

    Raises ValueError for a pattern that no parameter matches, and bounds without room or that the number can't have.
    """
    low = [np.full(np.shape(p.example.raw), -np.inf) for p in parameters]
    high = [np.full(np.shape(p.example.raw), np.inf) for p in parameters]
    for pattern, (lowest, highest) in bounds.items():
        found = [k for k, p in enumerate(parameters) if fnmatch.filter((*p.names, p.label), pattern)]
        if not found:
            raise ValueError(
                f"bounds for '{pattern}': no tuned number matches; tuned are {', '.join(p.label for p in parameters)}"
            )
        if not lowest < highest:
            raise ValueError(f"bounds for '{pattern}': {lowest:g} is not below {highest:g}")
        for k in found:
            shape = np.shape(parameters[k].example.raw)
            try:
                low[k], high[k] = (
                    np.asarray(parameters[k].example.with_value(np.full(shape, x)).raw) for x in (lowest, highest)
                )
            except ValueError as error:
                raise ValueError(f"bounds for '{pattern}': {error}") from error
    return np.concatenate([np.ravel(x) for x in low]), np.concatenate([np.ravel(x) for x in high])


def with_raw(node: AbstractTunable, raw: Any) -> AbstractTunable:
    """The tunable with another unconstrained value."""
    return eqx.tree_at(lambda n: n.raw, node, raw)


def with_parameters(tracker: Any, parameters: Sequence[Parameter], vector: Any) -> Any:
    """The tracker with the parameters taken from an unconstrained vector; differentiable in the vector."""
    own = tunables(tracker)
    new: dict[str, AbstractTunable] = {}
    start = 0
    for parameter in parameters:
        shape = np.shape(parameter.example.raw)
        size = int(np.prod(shape, dtype=int))
        raw = vector[start : start + size].reshape(shape)
        new |= {name: with_raw(own[name], raw) for name in parameter.names}
        start += size
    return replaced(tracker, new)


def physical(parameters: Sequence[Parameter], vector: Any) -> list[Any]:
    """The physical value of each parameter."""
    values, start = [], 0
    for parameter in parameters:
        shape = np.shape(parameter.example.raw)
        size = int(np.prod(shape, dtype=int))
        values.append(with_raw(parameter.example, jnp.asarray(vector[start : start + size]).reshape(shape)).value)
        start += size
    return values


def physical_vector(parameters: Sequence[Parameter], vector: Any) -> np.ndarray:
    """The physical values of all parameters, one after another, where the unconstrained vector has them."""
    return np.concatenate([np.ravel(np.asarray(x, float)) for x in physical(parameters, vector)])


def physical_errors(parameters: Sequence[Parameter], vector: np.ndarray, cov: np.ndarray) -> list[np.ndarray]:
    """Standard errors of the physical values, by the delta method from the covariance of the unconstrained vector."""
    jacobians = jax.jacfwd(lambda v: physical(parameters, v))(jnp.asarray(vector))
    return [np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", j, cov, j), 0)) for j in map(np.asarray, jacobians)]
