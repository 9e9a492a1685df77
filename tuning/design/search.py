"""Minimisation of a layout's cost: by gradient from many starts, and by grid searches for comparison."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

from trackwright.trackers.core.model.algebra import Scalar
from trackwright.tuning.design.layouts import WEIGHT, Theta

Objective = Callable[..., Scalar]
"""Cost as a function of theta, and optionally of the weight of the violations."""

WEIGHT_INCREASE = 1000.0
"""Factor by which the weight of violations rises during a descent."""

_BATCH = 1024

MOST_SWEEPS = 20


class SearchResult(NamedTuple):
    """The best `theta`, its `value`, and the number of `evaluations` of the cost or its gradient."""

    theta: Float[np.ndarray, "elements coordinates"]
    value: float
    evaluations: int


def descend(
    objective: Objective,
    project: Callable[[Theta], Theta],
    starts: Float[np.ndarray, "s elements coordinates"],
    steps: int = 150,
    rate: float = 0.05,
) -> SearchResult:
    """The best result of Adam (Kingma & Ba 2015) with projected steps from all `starts` (s, …), in one call.

    The `rate` falls to zero along a cosine while the weight of violations, the cost's second argument, rises by
    `WEIGHT_INCREASE` to its final value: full weight from the beginning would trap most starts. A non-finite gradient
    counts as zero.
    """
    optimiser = optax.scale_by_adam()

    def descent(theta: Theta) -> tuple[Theta, Scalar]:
        def step(carry: Any, done: Any) -> tuple[Any, None]:
            theta, state = carry
            gradient = jax.grad(objective)(theta, WEIGHT * WEIGHT_INCREASE ** (done - 1.0))
            gradient = jnp.where(jnp.all(jnp.isfinite(gradient)), gradient, 0.0)
            # Adam raises a float to the power of an integer count, which strict promotion would refuse.
            with jax.numpy_dtype_promotion("standard"):
                update, state = optimiser.update(gradient, state, theta)
            return (project(theta - 0.5 * rate * (1.0 + jnp.cos(jnp.pi * done)) * update), state), None

        (theta, _), _ = jax.lax.scan(step, (theta, optimiser.init(theta)), jnp.arange(steps) / steps)
        return theta, objective(theta)

    ends, values = jax.jit(jax.vmap(descent))(jnp.asarray(starts))
    return _best(np.asarray(ends), np.asarray(values), len(starts) * (steps + 1))


def exhaust(
    objective: Objective, choices: Float[np.ndarray, "c coordinates"], ways: Iterable[tuple[int, ...]]
) -> SearchResult:
    """The best of all `ways` to place elements on a grid of `choices` (c, d); a way is the indices of its choices."""
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    remaining, best, number = iter(ways), None, 0
    while chosen := list(islice(remaining, _BATCH)):
        # The last batch is padded to the shape of the others.
        filled = chosen + [chosen[-1]] * (_BATCH - len(chosen))
        thetas = choices[np.array(filled)]
        number += len(chosen)
        best_of_batch = _best(thetas, np.asarray(evaluate(jnp.asarray(thetas))), number)
        best = best_of_batch if best is None or best_of_batch.value < best.value else best
    assert best is not None
    return best._replace(evaluations=number)


def exchange(objective: Objective, choices: np.ndarray, starts: Sequence[np.ndarray]) -> SearchResult:
    """Fedorov's exchange (1972) on a grid: elements move in turn to the best of all `choices` (c, d), until none moves.

    For too many combinations to try all. From each of the `starts`, indices (n,) of choices.
    """
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    best, number = None, 0
    for start in starts:
        chosen, value = np.array(start), np.inf
        for _ in range(MOST_SWEEPS):
            before = chosen.copy()
            for k in range(len(chosen)):
                tried = np.repeat(chosen[None], len(choices), axis=0)
                tried[:, k] = np.arange(len(choices))
                values = np.asarray(evaluate(jnp.asarray(choices[tried])))
                number += len(choices)
                values = np.where(np.isfinite(values), values, np.inf)
                chosen, value = tried[int(np.argmin(values))], float(values.min())
            if np.array_equal(chosen, before):
                break
        if best is None or value < best.value:
            best = SearchResult(choices[chosen], value, number)
    assert best is not None
    return best._replace(evaluations=number)


def _best(thetas: np.ndarray, values: np.ndarray, evaluations: int) -> SearchResult:
    k = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return SearchResult(thetas[k], float(values[k]), evaluations)
