"""Which assumption of a noise model the innovations contradict, for a person who wonders why a fit did not help."""

from __future__ import annotations

import numpy as np

from experiments.reports.tuning_data import Innovations
from tuning.whiteness import autocorrelation, probabilities

CORRELATED = 0.1
"""Correlation of neighbouring rows from which on errors count as lasting."""

SIZE = (0.75, 1.33)
"""NIS per degree of freedom outside of which the noise is of another size."""

RARE, TOO_OFTEN = 1e-3, 5.0
"""A NIS that one row in a thousand should exceed, and how many times more often is too often."""


def contradicted(innovations: Innovations) -> list[str]:
    """The assumptions that the rows contradict, each as a sentence's part with the number that says so."""
    found: list[str] = []
    if not len(innovations.nis):
        return found
    lasting, pairs = autocorrelation(innovations, 1)
    if pairs and lasting[0] > max(CORRELATED, 3 / np.sqrt(pairs)):
        found.append(
            "that errors of neighbouring rows are independent "
            f"(their NIS is correlated by {lasting[0]:.2f}: errors last)"
        )
    likely = probabilities(innovations)
    # Half the rows are above the median whatever a few wild readings do.
    middle = float(np.median(likely))
    ratio = float(innovations.nis.sum() / innovations.dof.sum())
    if not SIZE[0] <= ratio <= SIZE[1] and abs(middle - 0.5) > 0.1:
        found.append(
            "that the noise is as large here as where it was tuned "
            f"(NIS per degree of freedom {ratio:.2g}, 1 if it were)"
        )
    often = float(np.mean(likely > 1 - RARE)) / RARE
    if often > TOO_OFTEN:
        found.append(f"that large errors are as rare as in its distribution ({often:.0f} times as many beyond 99.9 %)")
    return found
