"""The least of an objective: by gradient from many starts at once, and by grids to see what that is worth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from tuning.design.layouts import WEIGHT

Objective = Callable[..., Any]
"""Of theta and, where it isn't to be its own, the weight of the constraints."""

EASED = 1000.0
"""By how much the constraints' weight rises during a descent."""

_BATCH = 1024


class Found(NamedTuple):
    """The best `theta`, its `value`, and how many `evaluations` of the objective, or of it with its gradient."""

    theta: np.ndarray
    value: float
    evaluations: int


def descend(
    objective: Objective, project: Callable[[Any], Any], starts: np.ndarray, steps: int = 150, rate: float = 0.05
) -> Found:
    """Adam (Kingma & Ba 2015) from all `starts` (s, …) in one call, each step projected; the best of all ends.

    The `rate` falls to zero along a cosine while the constraints' weight, the objective's second argument, rises by
    `EASED` to its own: walls that stand from the beginning leave most starts where they can't get out. A slope that
    isn't finite counts as none.
    """
    optimiser = optax.scale_by_adam()

    def one(theta: Any) -> tuple[Any, Any]:
        def step(carry: Any, done: Any) -> tuple[Any, None]:
            theta, state = carry
            slope = jax.grad(objective)(theta, WEIGHT * EASED ** (done - 1.0))
            slope = jnp.where(jnp.all(jnp.isfinite(slope)), slope, 0.0)
            # Adam raises a float to the power of an integer count, which strict promotion would refuse.
            with jax.numpy_dtype_promotion("standard"):
                update, state = optimiser.update(slope, state, theta)
            return (project(theta - 0.5 * rate * (1.0 + jnp.cos(jnp.pi * done)) * update), state), None

        (theta, _), _ = jax.lax.scan(step, (theta, optimiser.init(theta)), jnp.arange(steps) / steps)
        return theta, objective(theta)

    ends, values = jax.jit(jax.vmap(one))(jnp.asarray(starts))
    return _best(np.asarray(ends), np.asarray(values), len(starts) * (steps + 1))


def exhaust(objective: Objective, choices: np.ndarray, ways: Iterable[tuple[int, ...]]) -> Found:
    """The best of all `ways` to put things on some of the `choices` (c, d), each the numbers of the chosen."""
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    every, best, number = iter(ways), None, 0
    while chosen := list(islice(every, _BATCH)):
        # The last batch is filled up, so that one program serves all.
        filled = chosen + [chosen[-1]] * (_BATCH - len(chosen))
        thetas = choices[np.array(filled)]
        number += len(chosen)
        found = _best(thetas, np.asarray(evaluate(jnp.asarray(thetas))), number)
        best = found if best is None or found.value < best.value else best
    assert best is not None
    return best._replace(evaluations=number)


def exchange(objective: Objective, choices: np.ndarray, starts: Sequence[np.ndarray], sweeps: int = 20) -> Found:
    """Things in turn moved to the best of all `choices` (c, d), until none moves: where all combinations are too many.

    From each of the `starts`, numbers (n,) of choices; Fedorov's exchange (1972) on a grid.
    """
    evaluate = jax.jit(jax.vmap(lambda theta: objective(theta)))
    best, number = None, 0
    for start in starts:
        chosen, value = np.array(start), np.inf
        for _ in range(sweeps):
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
            best = Found(choices[chosen], value, number)
    assert best is not None
    return best._replace(evaluations=number)


def _best(thetas: np.ndarray, values: np.ndarray, evaluations: int) -> Found:
    k = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    return Found(thetas[k], float(values[k]), evaluations)
