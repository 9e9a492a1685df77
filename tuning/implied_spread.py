"""The spread of readings that a scale of Student's t implies: the heavier the tails, the smaller the scale beside it.

σ  scale below the peak        kσ  scale above it        ν  degrees of freedom
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from trackwright.trackers.core.run.tracker import AbstractTracker


class Spread(NamedTuple):
    """The `value` in the unit of the scale: a standard deviation, or half the width of the central 68 %.

    The latter where the variance is infinite, with ν ≤ 2.
    """

    value: float
    is_deviation: bool


def implied_spread(tracker: AbstractTracker, tunable: str) -> Spread | None:
    """The spread of a sensor's density of which `tunable` is the scale; None for normal noise and other tunables."""
    kind, _, rest = tunable.partition(".")
    name, _, scale = rest.rpartition(".")
    sensor: Any = getattr(tracker, "sensors", {}).get(name) if kind == "sensors" else None
    if getattr(sensor, "dof", None) is None or not scale.startswith("sigma"):
        return None
    skew = float(sensor.positive_skew.value) if hasattr(sensor, "positive_skew") else 1.0
    return student_t_spread(float(getattr(sensor, scale).value), float(sensor.dof.value), skew)


def student_t_spread(sigma: float, dof: float, skew: float = 1.0) -> Spread:
    """The spread of Student's t with a scale of `sigma` below its peak and `skew`·`sigma` above it."""
    if dof > 2:
        # Of |t|; the halves have the probabilities 1/(1 + k) and k/(1 + k).
        mean = 2 * math.sqrt(dof / math.pi) * math.exp(math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2)) / (dof - 1)
        square = dof / (dof - 2) * (1 - skew + skew**2)
        return Spread(sigma * math.sqrt(square - (mean * (skew - 1)) ** 2), True)
    # Imported when used: it takes long.
    from scipy import stats

    below = 1 / (1 + skew)

    def quantile(p: float) -> float:
        if p < below:
            return float(sigma * stats.t.ppf(0.5 * p / below, dof))
        return float(skew * sigma * stats.t.ppf(0.5 + 0.5 * (p - below) / (1 - below), dof))

    return Spread((quantile(0.84) - quantile(0.16)) / 2, False)
