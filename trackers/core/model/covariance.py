"""Covariances in two forms: a scalar for each entry for many trajectories, one matrix for few.

For hundreds of trajectories a covariance is its upper triangle, row by row, as a tuple of scalars: each entry is one
vector over trajectories, and structural zeros cost nothing. With few trajectories an operation costs the same whether
it works on one entry or on a matrix, and thousands of operations compile for minutes: there it is an array (n, n). The
functions here take either form and return the same; both agree to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import isqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.jax_private import extra_options
from trackwright.trackers.core.model.algebra import (
    ZERO,
    Jacobian,
    Scalar,
    SparseRow,
    Vector,
    compute_once,
    dense,
    full,
    stored,
    total,
    triangle,
)
from trackwright.trackers.core.model.state import State

FEW = 8  # most trajectories whose covariances are matrices; docs/performance.md has the times of both forms

AnyCovariance = tuple[Scalar, ...] | jax.Array
"""A covariance: its upper triangle, entry by entry, or its matrix (n, n)."""


def few(trajectories: int) -> bool:
    """Whether the covariances of this number of trajectories are matrices."""
    return trajectories <= FEW


ONE_KERNEL = 128
"""Most trajectories whose loop over rows is one kernel; of more it takes up to twice as long as dozens of kernels."""


def compiler_options(trajectories: int) -> dict[str, Any]:
    """The `compiler_options` of `jax.jit` with which XLA compiles a filter of so many trajectories best on a CPU.

    A loop whose step moves few bytes becomes one kernel, without hundreds of calls in each step; products of matrices
    are compiled inline, since a loop that calls a library stays many kernels. Multi-output fusion computes terms shared
    within a step once, not once per use; in derivatives of up to `ONE_KERNEL` trajectories, whose loop stores several
    arrays of one shape, it would copy these whole in every step.
    """
    extra = {"xla_cpu_small_while_loop_byte_threshold": "3000000"}
    if trajectories > ONE_KERNEL:
        extra["xla_cpu_use_multi_output_fusion"] = ""
    return {"xla_cpu_experimental_ynn_fusion_type": "", **extra_options(extra)}


MOST = 4096  # most trajectories of a turn on a GPU: enough to occupy it, few enough for its memory


def side_by_side(on_cpu: int, size: int) -> int:
    """Of `size` trajectories `on_cpu`, which suit the processor's cache; on other devices up to `MOST`.

    There a turn takes as long for a few trajectories as for thousands, since its kernels are started one by one.
    """
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    platform = jax.default_backend() if device is None else getattr(device, "platform", device)
    return min(on_cpu if platform == "cpu" else MOST, size)


class OneArray:
    """A tree of arrays (…, B) packed into one array, so that a loop over rows stores one array, not a hundred."""

    structure: Any
    leaves: Sequence[Any]

    def packed(self, tree: Any) -> jax.Array:
        """The leaves of the tree stacked, (numbers, B), in the type of the first."""
        self.leaves, self.structure = jax.tree_util.tree_flatten(tree)
        kind = self.leaves[0].dtype
        return jnp.concatenate([x.reshape(-1, x.shape[-1]).astype(kind) for x in self.leaves])

    def unpacked(self, array: jax.Array) -> Any:
        """The tree of an array (T, numbers, B), with its leaves (T, …, B)."""
        return self.unpacked_from(lambda start, end: array[:, start:end])

    def unpacked_from(self, part: Callable[[int, int], jax.Array]) -> Any:
        """The tree whose numbers from `start` to `end` are `part(start, end)`, (T, numbers, B) of any B."""
        ends = np.cumsum([0, *(x.size // x.shape[-1] for x in self.leaves)])
        parts = [part(int(start), int(end)) for start, end in pairwise(ends)]
        leaves = [
            rows.reshape(len(rows), *x.shape[:-1], rows.shape[-1]).astype(x.dtype)
            for x, rows in zip(self.leaves, parts, strict=True)
        ]
        return jax.tree_util.tree_unflatten(self.structure, leaves)


def as_scalars(cov: AnyCovariance) -> tuple[Scalar, ...]:
    """The upper triangle as a tuple of scalars."""
    return cov if isinstance(cov, tuple) else tuple(cov[..., i, j] for i, j in triangle(cov.shape[-1]))


def entries(cov: AnyCovariance) -> AnyCovariance:
    """The upper triangle: a tuple of scalars, or one array (entries,) of a matrix."""
    return cov if isinstance(cov, tuple) else cov[np.triu_indices(len(cov))]


def by_entry(covs: Any) -> tuple[jax.Array, ...]:
    """The `entries` of all time steps and trajectories, a tuple or (T, entries, B), entry by entry."""
    return covs if isinstance(covs, tuple) else tuple(covs[:, k] for k in range(covs.shape[1]))


def size_of(upper: Sequence[Any]) -> int:
    """The number of components n of a covariance with n(n + 1)/2 entries."""
    return (isqrt(8 * len(upper) + 1) - 1) // 2


def variance(cov: AnyCovariance, component: int) -> Scalar:
    """The variance of one component."""
    if not isinstance(cov, tuple):
        return cov[component, component]
    n = size_of(cov)
    return cov[component * n - component * (component - 1) // 2]


def added(cov: AnyCovariance, deviations: Sequence[Scalar]) -> AnyCovariance:
    """The covariance with independent errors of these standard deviations added."""
    if not isinstance(cov, tuple):
        return cov + jnp.diag(jnp.stack(list(deviations)) ** 2)
    pairs = zip(cov, triangle(len(deviations)), strict=True)
    return tuple(entry + deviations[i] ** 2 if i == j else entry for entry, (i, j) in pairs)


def leading(cov: AnyCovariance, n: int, size: int) -> AnyCovariance:
    """The leading block of `size` components of the covariance of n."""
    kept = [k for k, (_, j) in enumerate(triangle(n)) if j < size]
    return tuple(cov[k] for k in kept) if isinstance(cov, tuple) else cov[:size, :size]


def matrix(cov: AnyCovariance) -> jax.Array:
    """The symmetric matrix (…, n, n)."""
    return dense(cov, size_of(cov)) if isinstance(cov, tuple) else cov


def matched(
    weights: Sequence[Scalar], covs: Sequence[AnyCovariance], deviations: Sequence[Sequence[Scalar]]
) -> AnyCovariance:
    """The covariance Σ w (P + ddᵀ) of a mixture whose components deviate from its mean by d."""
    if isinstance(covs[0], tuple):
        return tuple(
            total(w * (P[k] + d[i] * d[j]) for w, P, d in zip(weights, covs, deviations, strict=True))
            for k, (i, j) in enumerate(triangle(len(deviations[0])))
        )
    parts = zip(weights, map(jnp.asarray, covs), [compute_once(jnp.stack(list(d))) for d in deviations], strict=True)
    # Arrays of one trajectory, or of many, which are last.
    cov: jax.Array = total(jnp.expand_dims(w, (0, 1)) * (P + d[:, None] * d[None]) for w, P, d in parts)
    return cov


def propagated(cov: jax.Array, jacobian: Jacobian) -> jax.Array:
    """F P Fᵀ + G Gᵀ of a covariance as a matrix, with the Jacobian (F G); of tuples: `algebra.congruence`."""
    n, inputs = jacobian.structure.shape
    present = jacobian.structure != ZERO
    shared = present[:, n:].astype(int) @ present[:, n:].T
    # The rows of F that differ from the unit matrix, and those with common noise.
    at = _span((jacobian.structure[:, :n] != np.eye(n)).any(axis=1) | (shared.sum(axis=1) > np.diag(shared)))
    alone = np.ones(n)
    alone[at] = 0.0
    apart = jnp.diag(jnp.asarray(alone, cov.dtype) * jacobian.squares(slice(n), slice(n, inputs)))
    if at.start == at.stop:
        return cov + apart
    needed, noisy = (_span(present[at, part].any(axis=0)) for part in (slice(n), slice(n, inputs)))
    F = stored(jacobian.transposed(at, needed))
    G = stored(jacobian.transposed(at, slice(n + noisy.start, n + noisy.stop)))
    FP = stored(transposed_product(F, cov[needed]))
    half = stored(0.5 * (transposed_product(FP[:, needed].T, F) + transposed_product(G, G)))
    # Both triangles are computed, and rounding must not make them differ.
    rows = stored(jnp.concatenate([FP[:, : at.start], half + half.T, FP[:, at.stop :]], axis=1))
    others = jnp.concatenate([cov[:, : at.start], rows.T, cov[:, at.stop :]], axis=1)
    return jnp.concatenate([others[: at.start], rows, others[at.stop :]]) + apart


def transposed_product(A: jax.Array, B: jax.Array) -> jax.Array:
    """AᵀB by sums, contiguous in the columns of B; a sum of outer products for many trajectories, last in each."""
    # XLA calls a library for reductions, and a loop with calls does not become one kernel.
    result: jax.Array = total(a[:, None] * b[None] for a, b in zip(A, B, strict=True))
    return result


def _span(which: np.ndarray) -> slice:
    """The range from the first to the last true entry; slices are cheaper than a selection."""
    at = np.flatnonzero(which)
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 0)


def zero_of(cov: AnyCovariance) -> Scalar:
    """A zero of the type of the entries."""
    return jnp.zeros_like(cov[0]) if isinstance(cov, tuple) else jnp.zeros((), cov.dtype)


def zeros(cov: AnyCovariance, n: int) -> Any:
    """A zero vector of n components, a `Vector` or an array."""
    return Vector.of([zero_of(cov)] * n) if isinstance(cov, tuple) else jnp.zeros((n,), cov.dtype)


def row_for(cov: AnyCovariance, h: SparseRow, n: int) -> SparseRow | jax.Array:
    """A sparse row in the form that products with this covariance take: itself, or an array (n,) for a matrix."""
    return h if isinstance(cov, tuple) else jnp.stack([jnp.asarray(h.get(j, 0.0), cov.dtype) for j in range(n)])


def dot(h: SparseRow | jax.Array, x: Any) -> Scalar:
    """hᵀx of a row of a Jacobian and a vector."""
    return total(x[j] * v for j, v in h.items()) if isinstance(h, dict) else jnp.sum(h * x)


def product(cov: AnyCovariance, h: SparseRow | jax.Array, n: int) -> Any:
    """P h, a `Vector` or an array (n,)."""
    if not isinstance(cov, tuple):
        return total(row * x for row, x in zip(cov, jnp.asarray(h), strict=True))
    P, entries = full(cov, n), dict(h)
    return Vector.of(compute_once([total(P[i][j] * v for j, v in entries.items()) for i in range(n)]))


def unconnected(cov: AnyCovariance, h: SparseRow | jax.Array, n: int) -> Scalar:
    """hᵀDh with D the diagonal of P: the size of the terms of hᵀPh, and of its rounding error where they cancel."""
    if not isinstance(cov, tuple):
        return jnp.sum(jnp.asarray(h) ** 2 * jnp.diagonal(cov))
    return total(variance(cov, j) * (v * v) for j, v in dict(h).items())


def updated(
    cov: AnyCovariance, Ph: Any, h: SparseRow | jax.Array, a: Scalar, noise: Scalar
) -> tuple[Any, AnyCovariance]:
    """The gain k = Ph/(a + `noise`) of a scalar reading with a = hᵀPh, and the covariance after it.

    For scalars in Joseph's form, (I − khᵀ) P (I − khᵀ)ᵀ + `noise` kkᵀ. For a matrix P − (a + `noise`) kkᵀ, the same to
    rounding and symmetric to the bit.
    """
    k = Ph / (noise + a)
    if not isinstance(cov, tuple):
        root = Ph / jnp.sqrt(noise + a)
        return k, cov - root[:, None] * root[None]
    # B = (I − khᵀ)P, then B(I − khᵀ)ᵀ + noise kkᵀ as a rank-one update of B, n² products. Bh from the rounded B
    # corrects its rounding errors as the product of three matrices does.
    n, P, entries = len(Ph), full(cov, len(Ph)), dict(h)
    B = {(i, j): P[i][j] - k[i] * Ph[j] for i in range(n) for j in range(n) if j >= i or j in entries}
    Bh_noise = compute_once([total(B[i, j] * v for j, v in entries.items()) - noise * k[i] for i in range(n)])
    return k, tuple(B[i, j] - Bh_noise[i] * k[j] for i, j in triangle(n))


class Gaussian(NamedTuple):
    """A Gaussian belief: the mean state and the covariance of the small step about it, upper triangle row by row."""

    mean: State
    cov: AnyCovariance


def with_covariances(belief: Any, change: Callable[[AnyCovariance], Any]) -> Any:
    """A belief of any form with the covariance of each Gaussian in it changed."""

    def one(part: Any) -> Any:
        return part._replace(cov=change(part.cov)) if isinstance(part, Gaussian) else part

    return jax.tree_util.tree_map(one, belief, is_leaf=lambda part: isinstance(part, Gaussian))
