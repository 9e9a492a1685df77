"""The prior of a fit: normal distributions of the unconstrained numbers about their values before it.

A fit to some recordings of a site is run on others. What its own do not tell stays at the values before the fit, the
defaults, about which those of sites vary by `SPREADS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.tunable import Covariance, Real
from trackwright.tuning.parameters import Parameter, flatten

Kind = Literal["sites", "flat"]

SPREADS = {"": 0.35, "dof": 0.5, "positive_skew": 0.5, "latency": 1.0}
"""Standard deviations between sites by the last part of a tunable's name, and by none of all others.

Of the logarithm of a noise level or another positive number, and of the logit of a fraction; of other numbers in their
unit, as the latency of fixes in s.
"""


class Penalty(NamedTuple):
    """Negative log density without its constant, nats, at S vectors: (S,), and its gradients (S, p)."""

    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]


class Prior(NamedTuple):
    """Independent normal distributions of p unconstrained numbers by mean and precision, zero where it is flat."""

    mean: Float[np.ndarray, " p"]
    precision: Float[np.ndarray, " p"]

    @classmethod
    def of(cls, parameters: Sequence[Parameter], kind: Kind = "sites") -> Prior:
        """The prior of the parameters about their present values; flat for matrices, and for all where `kind` is."""
        spreads = [np.full(p.size, np.inf if kind == "flat" else _spread(p)) for p in parameters]
        return cls(flatten(parameters), np.concatenate([np.zeros(0), *spreads]) ** -2.0)

    def penalty(self, vectors: Float[np.ndarray, "*S p"]) -> Penalty:
        """The penalty at vectors (S, p)."""
        away = np.atleast_2d(np.asarray(vectors, float)) - self.mean
        return Penalty(0.5 * away**2 @ self.precision, away * self.precision)


def _spread(parameter: Parameter) -> float:
    """The standard deviation of a parameter's unconstrained numbers."""
    example, last = parameter.example, parameter.names[0].rpartition(".")[2]
    if isinstance(example, Covariance):
        return np.inf
    if isinstance(example, Real):
        return SPREADS[last] / example.typical if last in SPREADS else 1.0
    return SPREADS.get(last, SPREADS[""])
