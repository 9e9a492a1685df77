"""Priors of parameters: normal distributions of their unconstrained values."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.tunable import Fraction, Real, Scale
from trackwright.tuning.parameters import Parameter

NUMBER = r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)"
FORM = re.compile(rf"(?P<pattern>[^=\s]+)\s*=\s*{NUMBER}\s*(?P<kind>x|\+-)\s*{NUMBER}")


class Penalty(NamedTuple):
    """Negative log density without its constant, nats, at S vectors: (S,), and its gradients (S, p)."""

    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]


@dataclass(frozen=True)
class Prior:
    """A prior of the parameters that match the shell `pattern`, with its median `centre` in their unit.

    Either `factor`: the interval centre ÷ factor … centre × factor of a Scale holds 68 % (log-normal), likewise for the
    odds of a Fraction; or `deviation`: the standard deviation of a Real, in its unit. Raises ValueError for neither or
    both, and for a factor up to 1 or a deviation that isn't positive.
    """

    pattern: str
    centre: float
    factor: float | None = None
    deviation: float | None = None

    def __post_init__(self) -> None:
        if (self.factor is None) == (self.deviation is None):
            raise ValueError(f"the prior of '{self.pattern}' has either a factor or a deviation")
        if self.factor is not None and not 1.0 < self.factor < math.inf:
            raise ValueError(f"the prior of '{self.pattern}' has a factor above 1, found {self.factor}")
        if self.deviation is not None and not 0.0 < self.deviation < math.inf:
            raise ValueError(f"the prior of '{self.pattern}' has a deviation above 0, found {self.deviation}")

    def raw(self, parameter: Parameter) -> tuple[float, float]:
        """Mean and standard deviation of the parameter's unconstrained numbers; ValueError for another kind of it."""
        example = parameter.example
        if isinstance(example, Real) and self.deviation is not None:
            return self.centre / example.typical, self.deviation / example.typical
        if isinstance(example, (Scale, Fraction)) and self.factor is not None:
            return float(np.asarray(type(example)(self.centre).raw)), math.log(self.factor)
        wanted = "a deviation, as '0+-0.1'" if isinstance(example, Real) else "a factor, as '0.2x2'"
        kind = type(example).__name__
        if kind == "Covariance":
            raise ValueError(f"{parameter.label} is a matrix, for which there is no prior; tune it without")
        raise ValueError(f"{parameter.label} is a {kind}, whose prior has {wanted}")


def penalty(priors: Sequence[Prior], parameters: Sequence[Parameter], vectors: Float[np.ndarray, "*S p"]) -> Penalty:
    """The penalty of the priors at vectors (S, p); several priors of one parameter add up.

    Raises ValueError for a prior without a matching parameter, or of another kind than its parameter.
    """
    vectors = np.atleast_2d(np.asarray(vectors, float))
    values, gradients = np.zeros(len(vectors)), np.zeros(vectors.shape)
    for prior in priors:
        matched, start = False, 0
        for parameter in parameters:
            part = slice(start, start + parameter.size)
            start = part.stop
            if not fnmatch.filter([parameter.label, *parameter.names], prior.pattern):
                continue
            matched = True
            mean, sigma = prior.raw(parameter)
            deviation = (vectors[:, part] - mean) / sigma
            values += 0.5 * np.sum(deviation**2, axis=1)
            gradients[:, part] += deviation / sigma
        if not matched:
            labels = ", ".join(p.label for p in parameters)
            raise ValueError(f"the prior of '{prior.pattern}' matches nothing that is tuned: {labels}")
    return Penalty(values, gradients)


def require_fitting(priors: Sequence[Prior], parameters: Sequence[Parameter], is_likelihood: bool) -> None:
    """Raise ValueError for priors that don't fit the parameters, or for an objective that is no likelihood."""
    penalty(priors, parameters, np.zeros((0, sum(p.size for p in parameters))))
    if priors and not is_likelihood:
        raise ValueError("a prior is weighed against a likelihood; use objective nll, or bounds")


def parse_prior(text: str) -> Prior:
    """The prior of a text such as `sensors.*.sigma_p=0.2x2` (a factor) or `*.offset=0+-0.1`; raises ValueError."""
    match = FORM.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"'{text}' is no prior; expected PATTERN=0.2x2 (within a factor of 2) or PATTERN=0+-0.1")
    try:
        centre, spread = float(match[2]), float(match[4])
    except ValueError as error:
        raise ValueError(f"'{text}' is no prior: '{match[2]}' or '{match[4]}' is no number") from error
    by_factor = match["kind"] == "x"
    return Prior(match["pattern"], centre, spread if by_factor else None, None if by_factor else spread)
