"""What is known of parameters before any recording: normal distributions of their unconstrained values."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trackers.core.tunable import Fraction, Real, Scale
from tuning.parameters import Parameter

NUMBER = r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)"
FORM = re.compile(rf"(?P<pattern>[^=\s]+)\s*=\s*{NUMBER}\s*(?P<kind>x|\+-)\s*{NUMBER}")


class Penalty(NamedTuple):
    """Negative log density less its constant, nats, at S vectors: (S,), its gradients (S, p), its curvature (p, p)."""

    values: np.ndarray
    gradients: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True)
class Prior:
    """The parameters whose names match the shell `pattern` are near `centre`, in their unit.

    `factor`: two thirds of a Scale lie within centre ÷ factor and centre × factor (log-normal), of a Fraction likewise
    by its odds; or `deviation`: the standard deviation of a Real, in its unit. Raises ValueError for neither or both,
    and for what isn't positive.
    """

    pattern: str
    centre: float
    factor: float | None = None
    deviation: float | None = None

    def __post_init__(self) -> None:
        if (self.factor is None) == (self.deviation is None):
            raise ValueError(f"the prior of '{self.pattern}' has either a factor or a deviation")
        if self.factor is not None and not 1.0 < self.factor < math.inf:
            raise ValueError(f"the prior of '{self.pattern}' holds within a factor above 1, found {self.factor}")
        if self.deviation is not None and not 0.0 < self.deviation < math.inf:
            raise ValueError(f"the prior of '{self.pattern}' has a deviation above 0, found {self.deviation}")

    def raw(self, parameter: Parameter) -> tuple[float, float]:
        """Mean and standard deviation of each of the parameter's unconstrained numbers; ValueError for another kind."""
        example = parameter.example
        if isinstance(example, Real) and self.deviation is not None:
            return self.centre / example.typical, self.deviation / example.typical
        if isinstance(example, (Scale, Fraction)) and self.factor is not None:
            return float(np.asarray(type(example)(self.centre).raw)), math.log(self.factor)
        wanted = "a deviation, as '0+-0.1'" if isinstance(example, Real) else "a factor, as '0.2x2'"
        kind = type(example).__name__
        if kind == "Covariance":
            raise ValueError(f"{parameter.label} is a matrix, of which no prior is known; tune it without")
        raise ValueError(f"{parameter.label} is a {kind}, whose prior has {wanted}")


def penalty(priors: Sequence[Prior], parameters: Sequence[Parameter], vectors: np.ndarray) -> Penalty:
    """What the priors say against vectors (S, p); where several match a parameter all of them count.

    Raises ValueError for a prior that matches no parameter or not its kind.
    """
    vectors = np.atleast_2d(np.asarray(vectors, float))
    values, gradients = np.zeros(len(vectors)), np.zeros(vectors.shape)
    curvature = np.zeros(vectors.shape[1])
    for prior in priors:
        matched, start = False, 0
        for parameter in parameters:
            part = slice(start, start + int(np.size(parameter.example.raw)))
            start = part.stop
            if not fnmatch.filter([parameter.label, *parameter.names], prior.pattern):
                continue
            matched = True
            mean, sigma = prior.raw(parameter)
            away = (vectors[:, part] - mean) / sigma
            values += 0.5 * np.sum(away**2, axis=1)
            gradients[:, part] += away / sigma
            curvature[part] += 1.0 / sigma**2
        if not matched:
            labels = ", ".join(p.label for p in parameters)
            raise ValueError(f"the prior of '{prior.pattern}' matches nothing that is tuned: {labels}")
    return Penalty(values, gradients, np.diag(curvature))


def parse_prior(text: str) -> Prior:
    """The prior of a text as `sensors.*.sigma_p=0.2x2` (within a factor of two) or `*.offset=0+-0.1`; or ValueError."""
    found = FORM.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"'{text}' is no prior; expected PATTERN=0.2x2 (within a factor of 2) or PATTERN=0+-0.1")
    try:
        centre, spread = float(found[2]), float(found[4])
    except ValueError as error:
        raise ValueError(f"'{text}' is no prior: '{found[2]}' or '{found[4]}' is no number") from error
    by_factor = found["kind"] == "x"
    return Prior(found["pattern"], centre, spread if by_factor else None, None if by_factor else spread)
