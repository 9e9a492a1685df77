"""What a check found, whether it is as it must be, and the table of all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ERRORS = 4.0
"""Standard errors by which a mean may be off: of a hundred right ones, one is in a hundred and sixty runs."""


@dataclass(frozen=True)
class Finding:
    """An estimator's derivative (or another figure) of a world against the oracle's.

    `mean` may be `allowed` off. `error`: its standard error, `spread`: of one estimate, both NaN where nothing is
    random. `seconds`: for one gradient. `wrong`: the estimator is known to be wrong here, and must be found so.
    """

    world: str
    figure: str
    estimator: str
    oracle: float
    mean: float
    allowed: float
    error: float = math.nan
    spread: float = math.nan
    seconds: float = math.nan
    wrong: bool = False

    @property
    def near(self) -> bool:
        """Whether the mean is as near to the oracle as allowed; what isn't finite is not."""
        return abs(self.mean - self.oracle) <= self.allowed

    @property
    def passed(self) -> bool:
        """Whether it is as it must be."""
        return self.near != self.wrong and math.isfinite(self.mean)

    @property
    def verdict(self) -> str:
        """In words."""
        if self.wrong:
            return "fails, as it must" if self.passed else "NOT SEEN TO FAIL"
        return "right" if self.passed else "WRONG"


def random(
    world: str,
    figure: str,
    estimator: str,
    oracle: float,
    estimates: np.ndarray,
    seconds: float = math.nan,
    wrong: bool = False,
) -> Finding:
    """The finding of independent estimates (n,), whose mean may be `ERRORS` standard errors off."""
    spread = float(np.std(estimates, ddof=1))
    error = spread / math.sqrt(len(estimates))
    mean = float(np.mean(estimates))
    return Finding(world, figure, estimator, oracle, mean, ERRORS * error, error, spread, seconds, wrong)


HEADER = ("world", "figure", "estimator", "oracle", "mean", "bias", "± error", "allowed", "spread", "ms", "verdict")


def table(findings: Sequence[Finding]) -> str:
    """All findings as text, a line each; `error` is the mean's standard error, `ms` the cost of one gradient."""
    rows: list[tuple[str, ...]] = [HEADER]
    for f in findings:
        numbers = [f.oracle, f.mean, f.mean - f.oracle, f.error, f.allowed, f.spread, 1e3 * f.seconds]
        shown = ["-" if math.isnan(x) else f"{x:.4g}" for x in numbers]
        rows.append((f.world, f.figure, f.estimator, *shown, f.verdict))
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADER))]
    lines = []
    for row in rows:
        padded = [c.rjust(w) if 3 <= k < 10 else c.ljust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  ".join(padded).rstrip())
    wrong = sum(not f.passed for f in findings)
    lines.append(f"{len(findings)} figures, {f'{wrong} not' if wrong else 'all'} as they must be")
    return "\n".join(lines)
