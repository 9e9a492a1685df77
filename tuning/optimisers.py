"""How a fit goes on from a point: optimisers that propose steps for S starts side by side; the fit judges the steps.

Everything of a start stands at its number along the first axis, so that starts never touch each other.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from tuning.problem import Evaluations

LONGEST = 2.0
"""The longest step in unconstrained coordinates: a noise level changes by a factor of seven at most."""


class AbstractOptimiser(eqx.Module):
    """`curved`: whether it takes a likelihood's curvature; `descends`: whether a step has to make things better."""

    curved: eqx.AbstractClassVar[bool]
    descends: eqx.AbstractClassVar[bool]

    @abstractmethod
    def begin(self, vectors: np.ndarray) -> Any:
        """What it remembers, for starts at vectors (S, p): a tree of arrays (S, …)."""

    @abstractmethod
    def direction(self, memory: Any, vectors: np.ndarray, found: Evaluations) -> tuple[Any, Any]:
        """From where the starts are: what `step` takes, and what is remembered."""

    @abstractmethod
    def step(self, direction: Any, attempt: int) -> np.ndarray:
        """The step (S, p), shorter with every attempt, from 0."""

    @abstractmethod
    def judged(self, memory: Any, attempts: np.ndarray) -> Any:
        """What is remembered, after the attempts (S,) that it took each start to move."""


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba 2015), whose rate falls from `rate` to a hundredth of it over `steps`.

    For objectives with noise of their own, of particles or minibatches.
    """

    steps: int = 60
    rate: float = 0.15
    curved: ClassVar[bool] = False
    descends: ClassVar[bool] = False

    def begin(self, vectors: np.ndarray) -> Any:
        return jax.vmap(_adam(self.steps, self.rate).init)(jnp.asarray(vectors))

    def direction(self, memory: Any, vectors: np.ndarray, found: Evaluations) -> tuple[Any, Any]:
        return _updated(_adam(self.steps, self.rate), found.gradients, memory, vectors)

    def step(self, direction: Any, attempt: int) -> np.ndarray:
        return np.asarray(direction / 2.0**attempt)

    def judged(self, memory: Any, attempts: np.ndarray) -> Any:
        return memory


@lru_cache
def _adam(steps: int, rate: float) -> Any:
    """Adam of optax; kept, since one made anew would be compiled anew."""
    # A filter on the brink of losing a track has enormous derivatives; one such step must not drown all others.
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(rate, steps, 0.01)))


_lbfgs = optax.scale_by_lbfgs()


class LBFGS(AbstractOptimiser):
    """Limited-memory BFGS (Liu and Nocedal 1989) of optax, its steps halved until they help."""

    curved: ClassVar[bool] = False
    descends: ClassVar[bool] = True

    def begin(self, vectors: np.ndarray) -> Any:
        return jax.vmap(_lbfgs.init)(jnp.asarray(vectors))

    def direction(self, memory: Any, vectors: np.ndarray, found: Evaluations) -> tuple[Any, Any]:
        first = np.asarray(memory.count) == 0
        steps, memory = _updated(_lbfgs, found.gradients, memory, vectors)
        # Nothing lengthens the first step, from which the later ones take their scale: a factor of e is one that helps
        # a noise level, and a shorter one is found by halving.
        length = np.linalg.norm(found.gradients, axis=1, keepdims=True)
        steepest = -found.gradients / np.where(length > 0, length, 1.0)
        uphill = np.sum(steps * found.gradients, axis=1) <= 0
        return _limited(np.where((first | uphill)[:, None], steepest, -steps)), memory

    def step(self, direction: Any, attempt: int) -> np.ndarray:
        return np.asarray(direction / 2.0**attempt)

    def judged(self, memory: Any, attempts: np.ndarray) -> Any:
        return memory


class Bowl(NamedTuple):
    """A quadratic model of S objectives: gradients (S, p), curvatures (S, p, p), and the damping (S,)."""

    gradients: np.ndarray
    curvatures: np.ndarray
    damping: np.ndarray


class GaussNewton(AbstractOptimiser):
    """Gauss–Newton on the innovations with Levenberg and Marquardt's damping (Marquardt 1963); for likelihoods."""

    curved: ClassVar[bool] = True
    descends: ClassVar[bool] = True

    def begin(self, vectors: np.ndarray) -> Any:
        return np.full(len(vectors), 1e-3)

    def direction(self, memory: Any, vectors: np.ndarray, found: Evaluations) -> tuple[Any, Any]:
        return Bowl(found.gradients, found.curvatures, memory), memory

    def step(self, direction: Any, attempt: int) -> np.ndarray:
        diagonal = np.einsum("spp->sp", direction.curvatures)
        # A number without curvature of its own is damped as the flattest of the others.
        flattest = np.min(np.where(diagonal > 0, diagonal, np.inf), axis=1, keepdims=True)
        diagonal = np.where(diagonal > 0, diagonal, np.where(np.isfinite(flattest), flattest, 1.0))
        damping = direction.damping * 10.0**attempt
        damped = direction.curvatures + damping[:, None, None] * np.einsum(
            "sp,pq->spq", diagonal, np.eye(diagonal.shape[1])
        )
        return _limited(-np.linalg.solve(damped, direction.gradients[..., None])[..., 0])

    def judged(self, memory: Any, attempts: np.ndarray) -> Any:
        return np.clip(memory * np.where(attempts > 0, 10.0**attempts, 0.1), 1e-6, 1e6)


def _limited(steps: np.ndarray) -> np.ndarray:
    """Steps (S, p) of at most the longest."""
    return steps / np.maximum(1.0, np.linalg.norm(steps, axis=1, keepdims=True) / LONGEST)


def _updated(transformation: Any, gradients: np.ndarray, memory: Any, vectors: np.ndarray) -> tuple[np.ndarray, Any]:
    """The updates (S, p) of optax and what it remembers, of one start after another.

    Not under `vmap`: XLA (jaxlib 0.10, multi-output fusion) aborts on the scatters that L-BFGS makes there.
    """
    of_starts = []
    for k, (gradient, vector) in enumerate(zip(gradients, vectors, strict=True)):
        mine = jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf[k]), memory)  # noqa: B023
        # Adam raises a float to the power of an integer count, which strict promotion would refuse.
        with jax.numpy_dtype_promotion("standard"):
            of_starts.append(_one(transformation, jnp.asarray(gradient), mine, jnp.asarray(vector)))
    steps, memories = zip(*of_starts, strict=True)
    return np.stack(steps).astype(float), jax.tree_util.tree_map(lambda *x: np.stack(x), *memories)


@eqx.filter_jit
def _one(transformation: Any, gradient: jax.Array, memory: Any, vector: jax.Array) -> tuple[jax.Array, Any]:
    return transformation.update(gradient, memory, vector)  # type: ignore[no-any-return]
