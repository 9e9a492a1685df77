"""The prior of a fit: Student's t distributions of the unconstrained numbers about their values before it.

A fit to some recordings of a site is run on others. What its own do not tell stays at the values before the fit, the
defaults, about which sites vary by `SPREADS`. Few sites are far off, and are not held back: tails are
heavy.
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
"""Scales of the distributions between sites by the last part of a tunable's name, and by none of all others.

Of the logarithm of a noise level or another positive number, and of the logit of a fraction; of other numbers in their
unit, as the latency of fixes in s.
"""

DOF = 3.0
"""Degrees of freedom."""


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
    def of(cls, parameters: Sequence[Parameter], kind: Kind = "sites") -> Prior:
        """The prior of the parameters about their present values.

        Flat where `kind` is, for matrices, and for the levels of `trackers.linear`, which no site tells.
        """
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
