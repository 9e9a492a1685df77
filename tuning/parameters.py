"""The tuned parameters of a tracker as one unconstrained vector and back, the bounds of its numbers, and their prior.

The prior: Student's t distributions of the unconstrained numbers about their values before the fit. A fit to some
recordings of a site is run on others. What its own do not tell stays at the values before the fit, the defaults, about
which sites vary by `SPREADS`. Few sites are far off, and are not held back: tails are heavy.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from trackwright.trackers.core.errors import UnusableInput, require
from trackwright.trackers.core.model.tunable import (
    AbstractGiven,
    AbstractTunable,
    Covariance,
    Real,
    matching,
    replaced,
    role_of,
    tunables,
)
from trackwright.trackers.core.run.tracker import AbstractTracker

Tree = TypeVar("Tree")

Vector = Float[Array | np.ndarray, " p"]  # unconstrained numbers, on the host or traced

TIED = "tied:"


class Parameter(eqx.Module):
    """One tunable, or several tied to be equal: `names` in the tracker, and an `example` with unit and constraint.

    `label`: the tunable's name, or the pattern of tied ones.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    example: AbstractTunable
    label: str = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of its unconstrained numbers."""
        return np.shape(self.example.raw)

    @property
    def size(self) -> int:
        """The number of its unconstrained numbers."""
        return int(np.prod(self.shape, dtype=int))


def noise_levels(tracker: AbstractTracker) -> tuple[str, ...]:
    """The names of the noise levels of motion and sensors.

    These are the tunables with a `role`, and those named `sigma_…` outside of start and filter, which few recordings
    determine. Raises UnusableInput for a tracker without noise levels.
    """
    nodes = tunables(tracker)
    names = []
    for name, node in nodes.items():
        *parts, last = name.split(".")
        if role_of(node) is not None or (last.startswith("sigma_") and not {"start", "filter"} & {*parts}):
            names.append(name)
    if not names:
        raise UnusableInput(
            "this tracker has no noise level of motion or sensors to tune; name what to tune by --tune; it has: "
            f"{', '.join(nodes) or 'no tunable'}"
        )
    return tuple(names)


def tuned_by_default(tracker: AbstractTracker, needs_truth: bool) -> tuple[str, ...]:
    """The `noise_levels`, and for an objective that `needs_truth` latencies, which readings alone do not determine.

    For others the shape of readings' errors, dof and skew, which decides on their level.
    """
    last = ("latency",) if needs_truth else ("dof", "positive_skew")
    levels, names = noise_levels(tracker), tunables(tracker)
    return (*levels, *(name for name in names if name.rpartition(".")[2] in last and name.startswith("sensors.")))


def select_parameters(
    tracker: AbstractTracker, patterns: str | Sequence[str], frozen: Sequence[str] = (), thresholds: bool = False
) -> list[Parameter]:
    """The parameters that match the patterns, without the `frozen`; `tied:PATTERN` ties all its matches into one.

    `thresholds`: whether tunables without a derivative are among them, as for a sweep. Raises ValueError for a pattern
    without match, for one that matches only thresholds where these are left out, for tied tunables of different units
    or shapes, and where no parameter is left.
    """
    parameters: list[Parameter] = []
    taken: set[str] = set(matching(tracker, frozen)) if frozen else set()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = matching(tracker, pattern.removeprefix(TIED))
        if not thresholds:
            matches = _that_fits_change(pattern, matches)
        matches = {k: v for k, v in matches.items() if k not in taken}
        taken.update(matches)
        if pattern.startswith(TIED) and matches:
            if not _same_kind(list(matches.values())):
                raise ValueError(f"'{pattern}' ties tunables of different units or shapes: {', '.join(matches)}")
            label = pattern.removeprefix(TIED) if len(matches) > 1 else next(iter(matches))
            parameters.append(Parameter(tuple(matches), next(iter(matches.values())), label))
        else:
            parameters += [Parameter((name,), node, name) for name, node in matches.items()]
    if not parameters:
        raise ValueError("there is nothing to tune: no pattern matches a tunable that is not frozen")
    return parameters


def _that_fits_change(pattern: str, nodes: Mapping[str, AbstractTunable]) -> dict[str, AbstractTunable]:
    differentiable = {name: node for name, node in nodes.items() if not isinstance(node, AbstractGiven)}
    if not differentiable:
        raise ValueError(
            f"'{pattern}' matches only {', '.join(nodes)}: no objective has a derivative with respect to a threshold, "
            "and the standard deviation of an unknown parameter is not fitted; use a sweep"
        )
    return differentiable


def _same_kind(nodes: Sequence[AbstractTunable]) -> bool:
    """Whether equal unconstrained numbers are equal values of all nodes, in the same unit."""
    first = nodes[0]
    return all(
        type(node) is type(first)
        and node.unit == first.unit
        and np.shape(node.raw) == np.shape(first.raw)
        and np.array_equal(with_raw(node, np.ones_like(node.raw)).value, with_raw(first, np.ones_like(node.raw)).value)
        for node in nodes
    )


def component_names(parameters: Sequence[Parameter]) -> list[str]:
    """A name for each unconstrained number: the parameter's label, with indices where it has several."""
    return [".".join([p.label, *map(str, index)]) for p in parameters for index in np.ndindex(*p.shape)]


def flatten(parameters: Sequence[Parameter]) -> Float[np.ndarray, " p"]:
    """The unconstrained vector of the parameters' present values."""
    return np.concatenate([np.zeros(0), *(np.ravel(np.asarray(p.example.raw, float)) for p in parameters)])


def parse_bounds(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Bounds by pattern, from texts such as `sensors.*.sigma_p=0.01:1`; raises ValueError."""
    bounds = {}
    for text in texts:
        pattern, _, numbers = text.partition("=")
        low, _, high = numbers.partition(":")
        if pattern in bounds:
            raise ValueError(f"{text}: duplicate bound of '{pattern}'; expected one")
        try:
            bounds[pattern] = float(low), float(high)
        except ValueError as error:
            raise ValueError(f"{text}: expected PATTERN=LOWEST:HIGHEST, as 'sensors.*.sigma_p=0.01:1'") from error
    return bounds


def limits(
    parameters: Sequence[Parameter], bounds: Mapping[str, tuple[float, float]]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """The lowest and highest unconstrained vector (p,) for physical bounds by pattern, infinite elsewhere.

    Raises ValueError for a pattern without match, for empty bounds, and for values outside the parameter's constraint.
    """
    low = [np.full(p.shape, -np.inf) for p in parameters]
    high = [np.full(p.shape, np.inf) for p in parameters]
    for pattern, (lowest, highest) in bounds.items():
        matches = [k for k, p in enumerate(parameters) if fnmatch.filter((*p.names, p.label), pattern)]
        if not matches:
            labels = ", ".join(p.label for p in parameters)
            raise ValueError(f"bounds for '{pattern}': no tuned number matches; tuned are {labels}")
        if not lowest < highest:
            raise ValueError(f"bounds for '{pattern}': {lowest:g} is not below {highest:g}")
        for k in matches:
            example = parameters[k].example
            try:
                low[k], high[k] = (
                    np.asarray(example.with_value(np.full(parameters[k].shape, x)).raw) for x in (lowest, highest)
                )
            except ValueError as error:
                raise ValueError(f"bounds for '{pattern}': {error}") from error
    return np.concatenate([np.ravel(x) for x in low]), np.concatenate([np.ravel(x) for x in high])


def require_start_within(parameters: Sequence[Parameter], bounds: Mapping[str, tuple[float, float]]) -> None:
    """Raise ValueError for bounds that don't fit the parameters, or that exclude their present values."""
    low, high = limits(parameters, bounds)
    vector = flatten(parameters)
    outside = (vector < low) | (vector > high)
    if outside.any():
        k, values = outside.argmax(), np.concatenate([np.ravel(x) for x in physical(parameters, vector)])
        raise ValueError(
            f"{component_names(parameters)[k]} begins outside, at {values[k]:.4g}; give another starting value"
        )


def with_raw(node: AbstractTunable, raw: Array | np.ndarray) -> AbstractTunable:
    """The tunable with another unconstrained value."""
    return eqx.tree_at(lambda n: n.raw, node, raw)


def split(parameters: Sequence[Parameter], vector: Shaped[Array | np.ndarray, " p"]) -> Iterator[tuple[Parameter, Any]]:
    """Each parameter with its part of an unconstrained vector, or of what belongs to its numbers, in its shape."""
    start = 0
    for parameter in parameters:
        yield parameter, vector[start : start + parameter.size].reshape(parameter.shape)
        start += parameter.size


def with_parameters(tracker: Tree, parameters: Sequence[Parameter], vector: Vector) -> Tree:
    """The tracker with the parameters of an unconstrained vector; differentiable with respect to it."""
    nodes = tunables(tracker)
    new = {name: with_raw(nodes[name], raw) for parameter, raw in split(parameters, vector) for name in parameter.names}
    return replaced(tracker, new)


def physical(parameters: Sequence[Parameter], vector: Vector) -> list[Array]:
    """The physical value of each parameter."""
    return [with_raw(parameter.example, jnp.asarray(raw)).value for parameter, raw in split(parameters, vector)]


def by_label(parameters: Sequence[Parameter], vector: Float[np.ndarray, " p"]) -> dict[str, np.ndarray]:
    """The physical values by the parameters' labels."""
    values = physical(parameters, vector)
    return {p.label: np.asarray(v, float) for p, v in zip(parameters, values, strict=True)}


def physical_errors(
    parameters: Sequence[Parameter], vector: Float[np.ndarray, " p"], cov: Float[np.ndarray, "p p"],
    missing: Bool[np.ndarray, " p"],
) -> list[np.ndarray]:  # fmt: skip
    """Standard errors of the physical values, by the delta method from the covariance of the unconstrained vector.

    NaN for values that depend on a `missing` number, as both entries of a covariance on one of its factor.
    """
    jacobians = map(np.asarray, jax.jacfwd(lambda v: physical(parameters, v))(jnp.asarray(vector)))
    errors = ((j, np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", j, cov, j), 0))) for j in jacobians)
    return [np.where((j[..., missing] != 0).any(axis=-1), np.nan, e) for j, e in errors]


PriorKind = Literal["sites", "flat"]

# Scales of the distributions between sites by the last part of a tunable's name, and by none of all others. Of the
# logarithm of a noise level or another positive number, and of the logit of a fraction; of other numbers in their
# unit, as the latency of fixes in s.
SPREADS = {"": 0.35, "dof": 0.5, "positive_skew": 0.5, "latency": 1.0}

DOF = 3.0  # degrees of freedom of these distributions


class Penalty(NamedTuple):
    """Negative log density without its constant, nats, at S vectors: (S,), and its gradients (S, p)."""

    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]


class Prior(NamedTuple):
    """Independent distributions of p unconstrained numbers by mean and scale⁻², zero where it is flat."""

    mean: Float[np.ndarray, " p"]
    precision: Float[np.ndarray, " p"]
    dof: float = DOF

    @classmethod
    def of(cls, parameters: Sequence[Parameter], kind: PriorKind = "sites") -> Prior:
        """The prior of the parameters about their present values.

        Flat where `kind` is, for matrices, and for the levels of `trackers.linear`, which no site tells.
        """
        require(kind in get_args(PriorKind), "fit", kind, "the prior 'sites' or 'flat'")
        spreads = [np.full(p.size, np.inf if kind == "flat" else _spread(p)) for p in parameters]
        return cls(flatten(parameters), np.concatenate([np.zeros(0), *spreads]) ** -2.0)

    def penalty(self, vectors: Float[np.ndarray, "*S p"]) -> Penalty:
        """The penalty at vectors (S, p)."""
        away = np.atleast_2d(np.asarray(vectors, float)) - self.mean
        values = 0.5 * (self.dof + 1) * np.log1p(away**2 * self.precision / self.dof).sum(axis=1)
        return Penalty(values, away * self.weights(vectors))

    def weights(self, vectors: Float[np.ndarray, "*S p"]) -> Float[np.ndarray, "S p"]:
        """The precisions of normal distributions with the same slopes at vectors (S, p)."""
        away = np.atleast_2d(np.asarray(vectors, float)) - self.mean
        return (self.dof + 1) * self.precision / (self.dof + away**2 * self.precision)


def _spread(parameter: Parameter) -> float:
    """The scale of the distribution of a parameter's unconstrained numbers."""
    example, last = parameter.example, parameter.names[0].rpartition(".")[2]
    if isinstance(example, Covariance) or {"Q", "R"} & {*parameter.names[0].split(".")}:
        return np.inf
    if isinstance(example, Real):
        return SPREADS[last] / example.typical if last in SPREADS else 1.0
    return SPREADS.get(last, SPREADS[""])
