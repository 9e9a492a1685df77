"""Tunables: parameters of a tracker, each with one physical value, stored unconstrained and found by name in the tree.

`tuning.fit` takes the names or patterns of those to tune; nothing is switched on or off here.
"""

from __future__ import annotations

import fnmatch
import re
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Literal, Self, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.errors import UnusableInput, near, require
from trackwright.trackers.core.model.state import path_name

Tree = TypeVar("Tree")

Role = Literal["process noise", "bias noise", "measurement noise"]
"""Role of a noise level: of the motion's driving noise, of slowly varying errors such as biases, or of a sensor."""

Axis = Literal["horizontal", "vertical", "all"]
"""Axes of space along which a noise acts; none for scalar noise, as of phases or ranges."""


class AbstractTunable(eqx.Module):
    """A tunable number or array: `raw` is unconstrained, `value` physical; `bounds`: of the values, in words."""

    bounds: ClassVar[str]
    raw: eqx.AbstractVar[Any]
    unit: eqx.AbstractVar[str]

    @property
    @abstractmethod
    def value(self) -> Any:
        """The physical value, in `unit`."""

    def with_value(self, value: Any) -> Self:
        """The same tunable with another physical value."""
        return type(self)(value, *(getattr(self, field.name) for field in fields(self) if field.name != "raw"))


def _numbers(kind: str, value: Any) -> tuple[Any, Any]:
    """The value of a tunable of this kind as an array of floats, and its module: NumPy, or `jax.numpy` if traced.

    Raises UnusableInput for anything but numbers; traced ones, as inside `jax.grad` and `jax.vmap`, cannot be checked.
    """
    if isinstance(value, jax.core.Tracer):
        return value.astype(jnp.result_type(float)), jnp
    numbers = np.asarray(value)
    require(numbers.dtype.kind in "biuf", f"a {kind}", value, "a number or an array of numbers")
    return numbers.astype(float), np


class Scale(AbstractTunable):
    """A positive number such as a standard deviation; tuned on a logarithmic scale.

    `role`, `axis`: of a noise level; coarse grids of starts depend on them, not on names.
    """

    bounds = "> 0"
    raw: Any
    unit: str = eqx.field(static=True)
    role: Role | None = eqx.field(static=True)
    axis: Axis | None = eqx.field(static=True)

    def __init__(self, value: Any, unit: str = "1", role: Role | None = None, axis: Axis | None = None):
        value, math = _numbers("Scale", value)
        if math is np and not (np.all(np.isfinite(value)) and np.all(value > 0)):
            raise UnusableInput(
                f"a Scale is positive and finite, found {value.tolist()}; a noise that is absent is left out, "
                "not set to zero"
            )
        self.raw = math.log(value)
        self.unit = unit
        self.role, self.axis = _checked(role, axis)

    @property
    def value(self) -> Any:
        return jnp.exp(self.raw)


class Fraction(AbstractTunable):
    """A number strictly between 0 and 1, such as a probability; tuned on the logit scale."""

    bounds = "0 to 1"
    raw: Any
    unit: str = eqx.field(static=True)

    def __init__(self, value: Any, unit: str = "1"):
        value, math = _numbers("Fraction", value)
        if math is np and not np.all((value > 0) & (value < 1)):
            raise UnusableInput(f"a Fraction lies strictly between 0 and 1, found {value.tolist()}")
        self.raw = math.log(value) - math.log1p(-value)
        self.unit = unit

    @property
    def value(self) -> Any:
        return jax.nn.sigmoid(self.raw)


class Real(AbstractTunable):
    """A number of either sign, such as an offset; tuned in units of `typical`, the size at which it matters."""

    bounds = ""
    raw: Any
    unit: str = eqx.field(static=True)
    typical: float = eqx.field(static=True)

    def __init__(self, value: Any, unit: str = "1", typical: float = 1.0):
        value, math = _numbers("Real", value)
        if math is np and not np.all(np.isfinite(value)):
            raise UnusableInput(f"a Real is finite, found {value.tolist()}")
        self.raw = value / typical
        self.unit = unit
        self.typical = typical

    @property
    def value(self) -> Any:
        return self.raw * self.typical


class Covariance(AbstractTunable):
    """A symmetric positive definite matrix, tuned through its Cholesky factor with the logarithm of its diagonal.

    `role`, `axis`: as of a `Scale`.
    """

    bounds = "positive definite"
    raw: Any
    unit: str = eqx.field(static=True)
    role: Role | None = eqx.field(static=True)
    axis: Axis | None = eqx.field(static=True)

    def __init__(self, value: Any, unit: str = "1", role: Role | None = None, axis: Axis | None = None):
        value, math = _numbers("Covariance", value)
        square = value.ndim == 2 and value.shape[0] == value.shape[1]
        try:
            if not (square and (math is jnp or np.allclose(value, value.T, rtol=1e-9))):
                raise np.linalg.LinAlgError
            factor = math.linalg.cholesky(value)
        except np.linalg.LinAlgError as error:
            raise UnusableInput(f"a Covariance is symmetric positive definite, found {value}") from error
        diagonal = math.diag(factor)
        self.raw = factor - math.diag(diagonal) + math.diag(math.log(diagonal))
        self.unit = unit
        self.role, self.axis = _checked(role, axis)

    @property
    def value(self) -> Any:
        n = self.raw.shape[0]
        factor = [[self.raw[i, j] if j < i else jnp.exp(self.raw[i, i]) for j in range(i + 1)] for i in range(n)]
        entries = [[sum(factor[i][k] * factor[j][k] for k in range(min(i, j) + 1)) for j in range(n)] for i in range(n)]
        return jnp.stack([jnp.stack(row) for row in entries])


class AbstractGiven(AbstractTunable):
    """A number that is set by name and swept as other tunables are, but no fit changes it."""

    raw: Any
    unit: str = eqx.field(static=True, default="1")

    def __init__(self, value: Any, unit: str = "1"):
        value, math = _numbers(type(self).__name__, value)
        if math is np:
            self.check(value)
        self.raw = value
        self.unit = unit

    @staticmethod
    @abstractmethod
    def check(value: np.ndarray) -> None:
        """Raises UnusableInput for a value out of bounds."""

    @property
    def value(self) -> Any:
        return self.raw


class Threshold(AbstractGiven):
    """A positive limit that a comparison is made with, so that derivatives are zero; np.inf disables it."""

    bounds = "> 0, inf: off"

    @staticmethod
    def check(value: np.ndarray) -> None:
        if not np.all(value > 0):
            raise UnusableInput(f"a Threshold is positive, np.inf to disable it, found {value.tolist()}")


class Considered(AbstractGiven):
    """The standard deviation of a parameter that is neither known nor estimated; 0 once that one is given: `known`.

    Its name is the parameter's and "_std".
    """

    bounds = ">= 0"

    @staticmethod
    def check(value: np.ndarray) -> None:
        if not np.all((value >= 0) & np.isfinite(value)):
            raise UnusableInput(f"a standard deviation is positive, or 0 for what is known, found {value.tolist()}")


class Constant(eqx.Module):
    """The value of a tunable, frozen for a run so that it is not recomputed at each step."""

    value: Any


def role_of(node: AbstractTunable) -> Role | None:
    """The role of a noise level; None for any other tunable."""
    return node.role if isinstance(node, (Scale, Covariance)) else None


def _checked(role: Role | None, axis: Axis | None) -> tuple[Role | None, Axis | None]:
    for value, expected in ((role, Role), (axis, Axis)):
        if value is not None and value not in get_args(expected):
            choices = ", ".join(f"'{x}'" for x in get_args(expected))
            raise UnusableInput(f"the role of a noise level: found '{value}'; expected one of {choices}, or None")
    return role, axis


def is_tunable(node: Any) -> bool:
    """Whether the node of a tree is a tunable number."""
    return isinstance(node, AbstractTunable)


def freeze(tree: Tree) -> Tree:
    """The tree with every tunable replaced by its value."""
    return jax.tree_util.tree_map(lambda x: Constant(x.value) if is_tunable(x) else x, tree, is_leaf=is_tunable)


def tunables(tree: Any) -> dict[str, AbstractTunable]:
    """Every tunable of the tree by its dotted name, as `motion.sigma_a` or `sensors.north.sigma_p`.

    A tracker by name, as `build` makes, has the tunables of its tracker.
    """
    tree = tree.tracker if hasattr(tree, "only_batch") else tree
    paths, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_tunable)
    return {path_name(path): node for path, node in paths if is_tunable(node)}


def matching(tree: Any, patterns: str | Sequence[str]) -> dict[str, AbstractTunable]:
    """The tunables whose names match one of the shell patterns (`sensors.*.sigma_p`).

    Raises UnusableInput, listing the tunables, for a pattern that matches none.
    """
    patterns = [patterns] if isinstance(patterns, str) else list(patterns)
    by_name = tunables(tree)
    for pattern in patterns:
        if not fnmatch.filter(by_name, pattern):
            raise UnusableInput(
                f"the pattern '{pattern}' matches no tunable{near(pattern, by_name)}; this tracker has: "
                f"{', '.join(by_name) or 'none'}"
            )
    return {name: node for name, node in by_name.items() if any(fnmatch.fnmatchcase(name, p) for p in patterns)}


def replaced(tree: Tree, new: Mapping[str, AbstractTunable]) -> Tree:
    """The tree with the named tunables replaced; names as in `tunables`."""

    def exchange(path: Any, node: Any) -> Any:
        return new.get(path_name(path), node) if is_tunable(node) else node

    return jax.tree_util.tree_map_with_path(exchange, tree, is_leaf=is_tunable)


def known(tree: Tree, names: Iterable[str]) -> Tree:
    """The tree without the standard deviations that these tunables, being `Considered`, have while not known."""
    spreads, by_name = [f"{name}_std" for name in names], tunables(tree)
    return replaced(tree, {x: by_name[x].with_value(0.0) for x in spreads if isinstance(by_name.get(x), Considered)})


def with_values(tree: Tree, values: Mapping[str, Any], source: object = "values") -> Tree:
    """The tree with physical values set by tunable name or shell pattern; what is given is `known`.

    Raises UnusableInput, naming `source`, for a pattern that matches nothing and a value of another shape or range.
    """
    by_name = tunables(tree)
    new = {}
    for pattern, value in values.items():
        names = [pattern] if pattern in by_name else fnmatch.filter(by_name, pattern)
        if not names:
            raise UnusableInput(
                f"{source}: this tracker has no '{pattern}'{near(pattern, by_name)}; it has: {', '.join(by_name)}"
            )
        for name in names:
            if np.shape(by_name[name].raw) == () and np.ndim(value) == 1:
                raise UnusableInput(
                    f"{source}: '{pattern}' has {len(value)} numbers, separated by commas, the tracker's {name} one; "
                    "decimals have a point, as 0.1"
                )
            if np.shape(value) != np.shape(by_name[name].raw):
                raise UnusableInput(
                    f"{source}: '{pattern}' has shape {np.shape(value)}, the tracker's {name} "
                    f"{np.shape(by_name[name].raw)}"
                )
            try:
                new[name] = by_name[name].with_value(value)
            except ValueError as error:
                raise UnusableInput(f"{source}: '{pattern}': {error}") from error
    return replaced(known(tree, new), new)


def meanings(tree: Any) -> dict[str, str]:
    """A sentence on every tunable of the tree by its dotted name; empty where no docstring mentions it.

    The sentence is the first with the field's name in backticks (of a list, the field's clause) in the docstring of the
    innermost object around the tunable that has one.
    """
    sentence_of = {}
    for path, node in jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_tunable)[0]:
        if is_tunable(node):
            owners = list(_owners(tree, path))
            sentences = (_sentence(owner, owners[-1][1]) for owner, _ in reversed(owners))
            sentence_of[path_name(path)] = next(filter(None, sentences), "")
    return sentence_of


def _owners(tree: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, str]]:
    """The objects on the path to a leaf, each with the name of the field that leads on."""
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            yield tree, key.name
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.key if isinstance(key, jax.tree_util.DictKey) else key.idx]


def _sentence(owner: Any, name: str) -> str:
    """The first sentence of the docstrings of an object's class and its bases that names the field."""
    for kind in type(owner).__mro__:
        text = " ".join((kind.__dict__.get("__doc__") or "").split())
        for sentence in re.split(r"(?<=\.) (?=[A-Z`])", text):
            if f"`{name}`" in sentence:
                # A list of `name`: meaning; `other`: meaning.
                clauses = [part for part in sentence.split("; ") if re.match(rf"(`\w+`, )*`{name}`", part)]
                clause = (clauses or [sentence])[0].rstrip(".")
                if not re.fullmatch(rf"`{name}`: as in `\w+`", clause):
                    return clause.replace("`", "")
    return ""
