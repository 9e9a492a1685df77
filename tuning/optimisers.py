"""Optimisers: each proposes the next steps of S starts; `tuning.optimisation` accepts, shortens or rejects them.

All arrays have the starts along the first axis; no start influences another.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

Vectors = Float[np.ndarray, "S p"]

MAX_STEP = 2.0
"""Longest step in unconstrained coordinates: a noise level changes by a factor of seven at most."""


class AbstractOptimiser(eqx.Module):
    """Proposes steps; `monotone`: whether a step that increases the objective is rejected."""

    monotone: eqx.AbstractClassVar[bool]

    @abstractmethod
    def init(self, vectors: Vectors) -> Any:
        """The optimiser's state for starts at vectors (S, p): a tree of arrays (S, …)."""

    @abstractmethod
    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        """The steps (S, p) from vectors (S, p) with gradients (S, p), and the optimiser's next state."""


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba 2015); its rate falls from `rate` to a hundredth of it over `steps` along a cosine.

    For noisy objectives, as of particle filters.
    """

    steps: int = 60
    rate: float = 0.15
    monotone: ClassVar[bool] = False

    @property
    def transformation(self) -> optax.GradientTransformation:
        # A filter about to lose a track has enormous derivatives; one such step must not dominate all others.
        rate = optax.cosine_decay_schedule(self.rate, self.steps, 0.01)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def init(self, vectors: Vectors) -> Any:
        return _initial(self, jnp.asarray(vectors))

    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        return _updated(self, gradients, state, vectors)


class LBFGS(AbstractOptimiser):
    """Limited-memory BFGS (Liu and Nocedal 1989) of optax with backtracking by halves."""

    monotone: ClassVar[bool] = True

    @property
    def transformation(self) -> optax.GradientTransformation:
        return optax.scale_by_lbfgs()

    def init(self, vectors: Vectors) -> Any:
        return _initial(self, jnp.asarray(vectors))

    def propose(self, state: Any, vectors: Vectors, gradients: Vectors) -> tuple[Vectors, Any]:
        first = np.asarray(state.count) == 0
        steps, state = _updated(self, gradients, state, vectors)
        # Later steps take their scale from the first, which backtracking can only shorten. Length 1, a factor of e in
        # a noise level, is long enough.
        length = np.linalg.norm(gradients, axis=1, keepdims=True)
        steepest = -gradients / np.where(length > 0, length, 1.0)
        uphill = np.sum(steps * gradients, axis=1) <= 0
        return _limited(np.where((first | uphill)[:, None], steepest, -steps)), state


def _limited(steps: Vectors) -> Vectors:
    """The steps (S, p), shortened to `MAX_STEP`."""
    return steps / np.maximum(1.0, np.linalg.norm(steps, axis=1, keepdims=True) / MAX_STEP)


def _updated(optimiser: Adam | LBFGS, gradients: Vectors, state: Any, vectors: Vectors) -> tuple[Vectors, Any]:
    """The updates (S, p) of an optimiser's transformation and its next state, one start after another.

    Not under `vmap`: XLA (jaxlib 0.10, multi-output fusion) aborts on the scatters of L-BFGS there.
    """
    updates = []
    for k, (gradient, vector) in enumerate(zip(gradients, vectors, strict=True)):
        of_start = jax.tree_util.tree_map(lambda leaf: jnp.asarray(np.asarray(leaf)[k]), state)  # noqa: B023
        # Adam raises a float to the power of an integer count, which strict promotion would refuse.
        with jax.numpy_dtype_promotion("standard"):
            updates.append(_update(optimiser, jnp.asarray(gradient), of_start, jnp.asarray(vector)))
    steps, states = zip(*updates, strict=True)
    return np.stack(steps).astype(float), jax.tree_util.tree_map(lambda *x: np.stack(x), *states)


@eqx.filter_jit
def _initial(optimiser: Adam | LBFGS, vectors: jax.Array) -> Any:
    return jax.vmap(optimiser.transformation.init)(vectors)


@eqx.filter_jit
def _update(optimiser: Adam | LBFGS, gradient: jax.Array, state: Any, vector: jax.Array) -> tuple[jax.Array, Any]:
    # Built while this is traced: a transformation as the argument would be compiled anew for every new object.
    return optimiser.transformation.update(gradient, state, vector)  # type: ignore[return-value]
