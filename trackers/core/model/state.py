"""States as pytrees with named fields, and their tangent components as a flat list, in which filters work.

A flat leaf (a number, or a one-dimensional array) is its own tangent. A curved leaf (`Heading`, `Rotation`) has
`retract` (state + small step) and `local` (small step between two states), so that the EKF on a state with such a leaf
is an error-state Kalman filter.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, Vector

State = Any
"""Any pytree: a NamedTuple or an equinox module whose leaves are scalars, vectors of scalars, or curved leaves."""


class AbstractCurved(eqx.Module):
    """A leaf of a state on a manifold, with small steps in its tangent space."""

    @property
    @abstractmethod
    def dimension(self) -> int:
        """The number of components of a small step."""

    @abstractmethod
    def retract(self, step: Sequence[Scalar]) -> AbstractCurved:
        """The element reached from this one by a small step; a zero step returns this one bit-identical."""

    @abstractmethod
    def local(self, other: Any) -> tuple[Scalar, ...]:
        """The small step that leads from this element to `other`, the inverse of `retract`."""

    @abstractmethod
    def perturbed(self, step: Sequence[Scalar]) -> AbstractCurved:
        """`retract` to first order in the step, for derivatives at zero; a zero step returns this one bit-identical."""

    @abstractmethod
    def step_of(self, change: Any) -> tuple[Scalar, ...]:
        """The small step of an infinitesimal change of this element's numbers, the derivative of `local` at itself."""


def wrap(angle: Scalar) -> Scalar:
    """The angle brought into (−π, π], radians."""
    turns = jnp.ceil(angle * (0.5 / jnp.pi) - 0.5)
    return angle - (2 * jnp.pi) * turns


class Heading(AbstractCurved):
    """An angle in a plane, radians, on the circle."""

    angle: Scalar

    @property
    def dimension(self) -> int:
        return 1

    def retract(self, step: Sequence[Scalar]) -> Heading:
        return Heading(self.angle + step[0])

    def local(self, other: Heading) -> tuple[Scalar, ...]:
        return (wrap(other.angle - self.angle),)

    def perturbed(self, step: Sequence[Scalar]) -> Heading:
        return self.retract(step)

    def step_of(self, change: Heading) -> tuple[Scalar, ...]:
        return (change.angle,)


class Rotation(AbstractCurved):
    """A rotation as a unit quaternion (w, x, y, z) that takes body vectors to world vectors.

    Steps are rotation vectors in body axes, radians.
    """

    w: Scalar
    x: Scalar
    y: Scalar
    z: Scalar

    @property
    def dimension(self) -> int:
        return 3

    @staticmethod
    def exp(vector: Sequence[Scalar]) -> Rotation:
        """The rotation about `vector` by its length (Solà 2017, equation 101), smooth at zero."""
        a, b, c = vector
        square = a * a + b * b + c * c
        small = square < 1e-8
        angle = jnp.sqrt(jnp.where(small, 1.0, square))
        half_sinc = jnp.where(small, 0.5 - square / 48.0, jnp.sin(angle / 2) / angle)
        cosine = jnp.where(small, 1.0 - square / 8.0, jnp.cos(angle / 2))
        return Rotation(cosine, a * half_sinc, b * half_sinc, c * half_sinc)

    def log(self) -> tuple[Scalar, ...]:
        """The rotation vector of length at most π, the inverse of `exp`."""
        sign = jnp.where(self.w < 0, -1.0, 1.0)
        w, x, y, z = (sign * q for q in (self.w, self.x, self.y, self.z))
        square = x * x + y * y + z * z
        small = square < 1e-8
        sine = jnp.sqrt(jnp.where(small, 1.0, square))
        factor = jnp.where(small, 2.0 - 2.0 * square / 3.0 + (1.0 - w) * 2.0, 2.0 * jnp.arctan2(sine, w) / sine)
        return x * factor, y * factor, z * factor

    def __matmul__(self, other: Rotation) -> Rotation:
        """The rotation that applies `other` first, then this one (the Hamilton product)."""
        a, b, c, d = self.w, self.x, self.y, self.z
        w, x, y, z = other.w, other.x, other.y, other.z
        return Rotation(
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )

    def inverse(self) -> Rotation:
        """The opposite rotation."""
        return Rotation(self.w, -self.x, -self.y, -self.z)

    def normalised(self) -> Rotation:
        """The same rotation with its length brought back to one, against rounding over many steps."""
        scale = 1.0 / jnp.sqrt(self.w**2 + self.x**2 + self.y**2 + self.z**2)
        return Rotation(self.w * scale, self.x * scale, self.y * scale, self.z * scale)

    def apply(self, vector: Vector) -> Vector:
        """The vector in world axes of a vector given in body axes."""
        q = Vector(self.x, self.y, self.z)
        twice = q.cross(vector) * 2.0
        return vector + twice * self.w + q.cross(twice)

    def retract(self, step: Sequence[Scalar]) -> Rotation:
        return self @ Rotation.exp(step)

    def local(self, other: Rotation) -> tuple[Scalar, ...]:
        return (self.inverse() @ other).log()

    def perturbed(self, step: Sequence[Scalar]) -> Rotation:
        w, x, y, z = self.w, self.x, self.y, self.z
        a, b, c = (0.5 * s for s in step)
        return Rotation(
            w - (x * a + y * b + z * c),
            x + (w * a + y * c - z * b),
            y + (w * b + z * a - x * c),
            z + (w * c + x * b - y * a),
        )

    def step_of(self, change: Rotation) -> tuple[Scalar, ...]:
        turned = self.inverse() @ change
        return 2.0 * turned.x, 2.0 * turned.y, 2.0 * turned.z


def _leaves(state: State) -> tuple[list[Any], Any]:
    return jax.tree_util.tree_flatten(state, is_leaf=lambda x: isinstance(x, AbstractCurved))


def _dimension(leaf: Any) -> int:
    if isinstance(leaf, AbstractCurved):
        return leaf.dimension
    return jnp.shape(leaf)[0] if jnp.ndim(leaf) else 1


def dimension(state: State) -> int:
    """The number of tangent components of the state, which is the size of its covariance."""
    return sum(_dimension(leaf) for leaf in _leaves(state)[0])


def component_names(state: State) -> list[str]:
    """A name for each tangent component, as `position.0`, `attitude.2`, in the order of the covariance."""
    paths, _ = jax.tree_util.tree_flatten_with_path(state, is_leaf=lambda x: isinstance(x, AbstractCurved))
    names = []
    for path, leaf in paths:
        base = path_name(path)
        curved_or_array = isinstance(leaf, AbstractCurved) or jnp.ndim(leaf)
        names += [f"{base}.{k}" for k in range(_dimension(leaf))] if curved_or_array else [base]
    return names


def path_name(path: Iterable[Any]) -> str:
    """The name of a leaf by its path in a tree: fields, keys and indices with dots between them."""
    return ".".join(str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", k)))) for k in path)


def retract(state: State, step: Sequence[Scalar]) -> State:
    """The state moved by a small step, component by component in the order of the covariance."""
    leaves, structure = _leaves(state)
    moved = [
        leaf.retract(part) if isinstance(leaf, AbstractCurved) else leaf + _flat(leaf, part)
        for leaf, part in _parts(leaves, step)
    ]
    return jax.tree_util.tree_unflatten(structure, moved)


def _parts(leaves: Sequence[Any], values: Sequence[Scalar]) -> Iterator[tuple[Any, Sequence[Scalar]]]:
    """Each leaf with the values of its components."""
    start = 0
    for leaf in leaves:
        yield leaf, values[start : start + _dimension(leaf)]
        start += _dimension(leaf)


def _flat(leaf: Any, part: Sequence[Scalar]) -> Any:
    """The values in the shape of a flat leaf."""
    return jnp.stack(list(part)) if jnp.ndim(leaf) else part[0]


def local(origin: State, other: State) -> list[Scalar]:
    """The small step from `origin` to `other`, component by component: other − origin for flat leaves."""
    steps: list[Scalar] = []
    for a, b in zip(_leaves(origin)[0], _leaves(other)[0], strict=True):
        if isinstance(a, AbstractCurved):
            steps += a.local(b)
        elif jnp.ndim(a):
            steps += list(b - a)
        else:
            steps.append(b - a)
    return steps


def local_after(origin: State, before: State, values: Sequence[Scalar], after: State) -> list[Scalar]:
    """`local(origin, after)`, where `before` was built from the coordinates `values` about `origin`.

    A curved leaf that passed from `before` to `after` unchanged returns its coordinates, so that its Jacobian is exact.
    """
    steps, leaves = local(origin, after), _leaves(before)[0]
    start = 0
    for a, b in zip(leaves, _leaves(after)[0], strict=True):
        size = _dimension(a)
        if a is b and isinstance(a, AbstractCurved):
            steps[start : start + size] = values[start : start + size]
        start += size
    return steps


def steps_of(state: State, change: State) -> list[Scalar]:
    """The small step of an infinitesimal change of the state's numbers: the change itself for flat leaves."""
    steps: list[Scalar] = []
    for a, b in zip(_leaves(state)[0], _leaves(change)[0], strict=True):
        steps += a.step_of(b) if isinstance(a, AbstractCurved) else list(b) if jnp.ndim(b) else [b]
    return steps


def coordinates(state: State) -> tuple[list[Scalar], Any]:
    """Coordinates of the state and the function that rebuilds a state from such coordinates.

    A flat leaf is its own coordinates, so that the traced program of a flat state has no sums with zero; a curved leaf
    has zeros, the small step from itself. For derivatives: curved leaves are rebuilt to first order.
    """
    leaves, structure = _leaves(state)
    point: list[Scalar] = []
    for leaf in leaves:
        if isinstance(leaf, AbstractCurved):
            zero = jnp.zeros_like(jax.tree_util.tree_leaves(leaf)[0])
            point += [zero] * leaf.dimension
        else:
            point += list(leaf) if jnp.ndim(leaf) else [leaf]

    def rebuild(values: Sequence[Scalar]) -> State:
        rebuilt = [
            leaf.perturbed(part) if isinstance(leaf, AbstractCurved) else _flat(leaf, part)
            for leaf, part in _parts(leaves, values)
        ]
        return jax.tree_util.tree_unflatten(structure, rebuilt)

    return point, rebuild
