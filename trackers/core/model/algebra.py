"""Small linear algebra over scalars, for states of a dozen components and batches of thousands.

Each entry is a separate scalar, so that under `vmap` it becomes one long vector over trajectories and XLA fuses a
whole filter step; a matrix of shape (batch, n, n) would cost a pass over memory for every product. Structural zeros are
absent entries, structural ones the Python float 1.0: both cost nothing in the compiled program.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from trackwright.trackers.core import jax_private

Tree = TypeVar("Tree")

Scalar = Any
"""A traced or concrete number: one component of one trajectory."""

SparseRow = dict[int, Scalar]
"""One row of a matrix, column index -> entry; an absent column is a structural zero."""

# Kinds of an entry of a Jacobian: a structural zero, a structural one, any other number.
ZERO, ONE, VARIABLE = range(3)


class Jacobian(NamedTuple):
    """A Jacobian compressed by adding columns without a common row: `sums` (groups, outputs).

    `group` (inputs,): of each column. `structure` (outputs, inputs): the kind of each entry.
    """

    sums: jax.Array
    group: np.ndarray
    structure: np.ndarray

    def transposed(self, outputs: slice, inputs: slice) -> jax.Array:
        """The entries of some outputs and inputs, (inputs, outputs)."""
        return self.sums[self.group[inputs], outputs] * self._constant((self.structure[outputs, inputs] != ZERO).T)

    def squares(self, outputs: slice, inputs: slice) -> jax.Array:
        """The sum of squares of each output's entries over some inputs, (outputs,)."""
        weights = np.zeros(self.sums.shape[:2])
        for j in range(self.structure.shape[1])[inputs]:
            weights[self.group[j]] += self.structure[:, j] != ZERO
        return jnp.sum(jnp.square(self.sums) * self._constant(weights), axis=0)[outputs]

    def _constant(self, array: np.ndarray) -> jax.Array:
        """A constant in the type of the entries."""
        return jnp.asarray(array, self.sums.dtype)


@jax.tree_util.register_pytree_node_class
class Vector:
    """A vector of scalars with the usual arithmetic; a pytree of its components."""

    __slots__ = ("parts",)

    def __init__(self, *parts: Scalar):
        self.parts = parts

    @classmethod
    def of(cls, values: Iterable[Scalar]) -> Vector:
        """The vector of the given components, in order."""
        return cls(*values)

    def __iter__(self) -> Iterator[Scalar]:
        return iter(self.parts)

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, index: int) -> Scalar:
        return self.parts[index]

    def __repr__(self) -> str:
        return f"Vector{self.parts}"

    def __add__(self, other: Vector) -> Vector:
        return Vector.of(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Vector) -> Vector:
        return Vector.of(a - b for a, b in zip(self, other, strict=True))

    def __neg__(self) -> Vector:
        return Vector.of(-a for a in self)

    def __mul__(self, factor: Scalar) -> Vector:
        return Vector.of(a * factor for a in self)

    __rmul__ = __mul__

    def __truediv__(self, divisor: Scalar) -> Vector:
        return Vector.of(a / divisor for a in self)

    def dot(self, other: Iterable[Scalar]) -> Scalar:
        """The inner product with any sequence of equal length."""
        return total(a * b for a, b in zip(self, other, strict=True))

    def norm(self) -> Scalar:
        """The Euclidean norm; its derivative at zero is zero, not NaN."""
        square = self.dot(self)
        safe = jnp.where(square > 0, square, 1.0)
        return jnp.where(square > 0, jnp.sqrt(safe), 0.0)

    def cross(self, other: Vector) -> Vector:
        """The cross product of two vectors of three components."""
        (a, b, c), (x, y, z) = self, other
        return Vector(b * z - c * y, c * x - a * z, a * y - b * x)

    def array(self) -> jax.Array:
        """The components stacked along a new first axis."""
        return jnp.stack([jnp.asarray(a) for a in self])

    def tree_flatten(self) -> tuple[tuple[Scalar, ...], None]:
        return self.parts, None

    @classmethod
    def tree_unflatten(cls, _: None, parts: Sequence[Scalar]) -> Vector:
        return cls(*parts)


def total(terms: Iterable[Scalar]) -> Scalar:
    """The sum of the terms, without the leading zero that `sum` adds to a traced program."""
    result: Scalar = None
    for term in terms:
        result = term if result is None else result + term
    return 0.0 if result is None else result


def product(a: Any, b: Any) -> jax.Array:
    """The matrix product a @ b in the full precision of its type.

    By default some accelerators round the factors of single-precision products to ten bits.
    """
    return jnp.matmul(a, b, precision="highest")


def times(a: Scalar, b: Scalar) -> Scalar:
    """a·b, where the Python float 1.0 costs no operation."""
    if isinstance(a, float) and a == 1.0:
        return b
    if isinstance(b, float) and b == 1.0:
        return a
    return a * b


def compute_once(tree: Tree) -> Tree:
    """The same numbers, bit-identical, computed once however many fused loops use them (a CSE barrier).

    XLA's CPU compiler recomputes additions and sines in every loop that uses them; it never duplicates divisions. So
    this is a division by one, a one that is hidden from XLA but not from LLVM, which removes the division.
    """
    return jax.tree_util.tree_map(_once, tree)


def _once(x: Any) -> Any:
    floating = hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.floating)
    return _marked(x) if floating else x


def _divided(x: jax.Array) -> jax.Array:
    one, two = (jnp.full_like(x, v) for v in (1, 2))
    return x / jax.lax.select(x < jnp.full_like(x, -jnp.inf), two, one)


_marked = jax_private.identity("compute_once", _divided)


def stored(x: jax.Array) -> jax.Array:
    """The same array, bit-identical, written to memory before anything uses it.

    XLA's CPU compiler fuses the products of small matrices into whatever uses them, where they are computed entry by
    entry, often twice. It fuses nothing with a condition.
    """
    result: jax.Array = _stored(x)
    return result


def _by_condition(x: jax.Array) -> jax.Array:
    """The array, by a condition that never holds, which XLA does not know."""
    return jax.lax.cond(x[(0,) * x.ndim] < -jnp.inf, lambda x: -x, lambda x: x, x)


# Elsewhere a condition costs more than it saves.
_stored = jax_private.identity("stored", _by_condition, platform="cpu")


def mark_dependent(tree: Tree, numbers: Any) -> Tree:
    """Identity that makes the initial carry of a scan formally depend on `numbers`, for jax to type it in one trace.

    Without it jax traces the step again whenever another part of the carry turns out to have a tangent or to be
    batched, which takes seconds for large states.
    """
    arrays = [x for x in jax.tree_util.tree_leaves(numbers) if hasattr(x, "dtype") and x.size]
    floating = [jnp.ravel(x)[0] for x in arrays if jnp.issubdtype(x.dtype, jnp.floating)]
    if not floating:
        return tree
    number = total(floating)

    def of(x: Any) -> Any:
        other = number if jnp.issubdtype(x.dtype, jnp.floating) else number > 0
        return jax.lax.select(jnp.zeros(x.shape, bool), jnp.broadcast_to(other.astype(x.dtype), x.shape), x)

    return jax.tree_util.tree_map(of, tree)


def select(condition: Scalar, yes: Any, no: Any) -> Any:
    """The tree `yes` where the condition holds, else `no`."""
    return jax.tree_util.tree_map(lambda a, b: jnp.where(condition, a, b), yes, no)


@custom_vmap
def where_mostly(condition: Scalar, yes: Any, no: Any) -> Any:
    """`select` without a copy where the condition holds in all trajectories, for large trees."""
    return select(condition, yes, no)


@where_mostly.def_vmap
def _in_trajectories(size: int, batched: Any, condition: Any, yes: Any, no: Any) -> tuple[Any, Any]:
    def spread(x: Any, has: bool) -> Any:
        return x if has else jnp.broadcast_to(x[None], (size, *x.shape))

    condition, yes, no = jax.tree_util.tree_map(spread, (condition, yes, no), tuple(batched))
    chosen = jax.lax.cond(jnp.all(condition), lambda: yes, lambda: jax.vmap(select)(condition, yes, no))
    return chosen, jax.tree_util.tree_map(lambda _: True, chosen)


def triangle(n: int) -> list[tuple[int, int]]:
    """Index pairs (row, column) of an upper triangle, row by row: the order in which covariances are stored."""
    return [(i, j) for i in range(n) for j in range(i, n)]


def full(upper: Sequence[Scalar], n: int) -> list[list[Scalar]]:
    """The symmetric n × n nested list of an upper triangle in `triangle` order."""
    position = {pair: k for k, pair in enumerate(triangle(n))}
    return [[upper[position[min(i, j), max(i, j)]] for j in range(n)] for i in range(n)]


def dense(upper: Sequence[Any], n: int, stack: Callable[..., Any] = jnp.stack) -> Any:
    """The symmetric matrices of an upper triangle as one array (..., n, n)."""
    return stack([stack(row, axis=-1) for row in full(upper, n)], axis=-2)


def densify(rows: Sequence[SparseRow], columns: int, zero: Scalar) -> Any:
    """Sparse rows as one array (rows, columns) of the type of `zero`."""
    return jnp.stack([jnp.stack([zero + row.get(j, 0.0) for j in range(columns)]) for row in rows])


def diagonal(variances: Sequence[Scalar], zero: Scalar) -> tuple[Scalar, ...]:
    """The upper triangle of a diagonal covariance, every entry shaped like `zero`."""
    return tuple(variances[i] + zero if i == j else zero for i, j in triangle(len(variances)))


def congruence(rows: Sequence[SparseRow], upper: Sequence[Scalar], added: Sequence[SparseRow]) -> tuple[Scalar, ...]:
    """F P Fᵀ + G Gᵀ as an upper triangle; F = `rows`, P = `upper`, G = `added`, all without their structural zeros."""
    n = len(rows)
    P = full(upper, n)
    # Only the columns of F P that later rows use: little more than half of them for a chain of integrators.
    needed = [sorted({j for later in rows[i:] for j in later}) for i in range(n)]
    products = [{k: total(times(f, P[j][k]) for j, f in rows[i].items()) for k in needed[i]} for i in range(n)]
    # Each enters many sums. Recomputing it there doubled the compile time of 15 states and took ten times as long to
    # run.
    FP = [compute_once(entries) if len(row) > 1 else entries for row, entries in zip(rows, products, strict=True)]
    result = []
    for i, k in triangle(n):
        terms = [times(f, FP[i][j]) for j, f in rows[k].items()]
        terms += [times(g, added[k][q]) for q, g in added[i].items() if q in added[k]]
        result.append(total(terms))
    return tuple(result)


def cholesky(
    upper: dict[tuple[int, int], Scalar], columns: Sequence[int], tolerance: float
) -> dict[tuple[int, int], Scalar]:
    """Lower Cholesky factor of a semi-definite matrix; a pivot below `tolerance` × its diagonal gives a zero column.

    Directions without variance thus drop out instead of becoming infinite.
    """
    L: dict[tuple[int, int], Scalar] = {}
    for a, j in enumerate(columns):
        previous = columns[:a]
        pivot = upper[j, j] - total(L[j, k] * L[j, k] for k in previous)
        positive = pivot > tolerance * upper[j, j]
        root = jnp.sqrt(jnp.where(positive, pivot, 1.0))
        L[j, j] = jnp.where(positive, root, 0.0)
        for i in columns[a + 1 :]:
            remainder = upper[j, i] - total(L[i, k] * L[j, k] for k in previous)
            L[i, j] = jnp.where(positive, remainder / root, 0.0)
    return L


def solve_lower(L: Mapping[tuple[int, int], Scalar], values: Sequence[Scalar]) -> list[Scalar]:
    """L⁻¹x by forward substitution, with x = `values`; a zero on the diagonal gives a zero component."""
    solution: list[Scalar] = []
    for i, x in enumerate(values):
        solution.append((x - total(L[i, j] * solution[j] for j in range(i))) * inverse_or_zero(L[i, i]))
    return solution


def inverse_or_zero(x: Scalar) -> Scalar:
    """1/x, and 0 where x is zero."""
    return jnp.where(x == 0, 0.0, 1.0 / jnp.where(x == 0, 1.0, x))
