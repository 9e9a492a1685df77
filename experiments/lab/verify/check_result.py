"""The result of one check against an oracle, and the table of all results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trackwright.experiments.text.tables import aligned

MAX_STANDARD_ERRORS = 4.0
"""Allowed deviation of a mean, in standard errors: of a hundred correct means, one exceeds it in 160 runs."""


@dataclass(frozen=True)
class CheckResult:
    """An estimated quantity of a world beside the oracle's value.

    `mean` may deviate by `allowed`. `error`: its standard error; `spread`: standard deviation of one estimate; both
    NaN for deterministic estimators. `seconds`: per gradient. `biased`: the estimator is known to be wrong here, so
    that the deviation must exceed `allowed`.
    """

    world: str
    quantity: str
    estimator: str
    oracle: float
    mean: float
    allowed: float
    error: float = math.nan
    spread: float = math.nan
    seconds: float = math.nan
    biased: bool = False

    @property
    def near(self) -> bool:
        """Whether the mean deviates by no more than allowed; False where it is not finite."""
        return abs(self.mean - self.oracle) <= self.allowed

    @property
    def passed(self) -> bool:
        """Whether a correct estimator is near the oracle, or a biased one is not."""
        return self.near != self.biased and math.isfinite(self.mean)

    @property
    def outcome(self) -> str:
        """The result in words."""
        if self.biased:
            return "fails as expected" if self.passed else "PASSES UNEXPECTEDLY"
        return "pass" if self.passed else "FAIL"


def random_check(
    world: str,
    quantity: str,
    estimator: str,
    oracle: float,
    estimates: np.ndarray,
    seconds: float = math.nan,
    biased: bool = False,
) -> CheckResult:
    """The check of independent estimates (n,), whose mean may be `MAX_STANDARD_ERRORS` standard errors off."""
    spread = float(np.std(estimates, ddof=1))
    error = spread / math.sqrt(len(estimates))
    mean, allowed = float(np.mean(estimates)), MAX_STANDARD_ERRORS * error
    return CheckResult(world, quantity, estimator, oracle, mean, allowed, error, spread, seconds, biased)


HEADER = ("world", "quantity", "estimator", "oracle", "mean", "bias", "± error", "allowed", "spread", "ms", "result")


def table(results: Sequence[CheckResult]) -> str:
    """All results as text, one line each; `error` is the mean's standard error, `ms` the time of one gradient."""
    rows: list[tuple[str, ...]] = [HEADER]
    for r in results:
        numbers = [r.oracle, r.mean, r.mean - r.oracle, r.error, r.allowed, r.spread, 1e3 * r.seconds]
        shown = ["-" if math.isnan(x) else f"{x:.4g}" for x in numbers]
        rows.append((r.world, r.quantity, r.estimator, *shown, r.outcome))
    return f"{aligned(rows, range(3, 10))}\n{sum(r.passed for r in results)} of {len(results)} checks passed"
