"""Whether a fit makes a recording worse, in error or in the coverage of its covariances."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from trackwright.experiments.text.wording import Unit, fixed, length_unit
from trackwright.trackers.evaluation.statements import LIMITS, holds

MOST_ERROR = 1.05
"""The ratio of the RMSE after to that before from which on a recording gets worse."""

FARTHER = 0.05
"""How much farther from 95 % the share inside the ellipse may be after than before."""


def worse(old: Mapping[str, Any], new: Mapping[str, Any], error: str, suffix: str) -> Iterator[str]:
    """A clause where a recording's metrics after a fit are worse than before, in error or in coverage.

    Worse: an RMSE over `MOST_ERROR` times as large; covariances that held and do not; a share inside the 95 % ellipse
    farther from 95 % by `FARTHER`. `error`: the name of the RMSE; `suffix`: that of metrics in three dimensions.
    """
    before, after = old[error], new[error]
    name, share = new["recording"], f"coverage_95{suffix}"
    if None in (before, after):
        return
    if after > MOST_ERROR * before:
        unit = Unit("°", 180 / math.pi) if error.endswith("_rad") else length_unit(after)
        digits = 3 if unit.name == "m" else 1
        figures = [fixed(unit.factor * x, digits) for x in (before, after)]
        which = "3-D " if suffix else "horizontal " if error == "rmse_m" else ""
        yield f"{name}: {which}RMSE {figures[0]} → {figures[1]} {unit.name}"
    if None in (old[share], new[share]):
        return
    lost = holds(old, suffix) and not holds(new, suffix)
    if lost or abs(new[share] - 0.95) > abs(old[share] - 0.95) + FARTHER:
        shares = " → ".join(f"{100 * side[share]:.0f}" for side in (old, new))
        ratios = " → ".join(f"{side[f'nees{suffix}_ratio']:.2f}" for side in (old, new))
        limits = f" (held before; {' and '.join(LIMITS)})" if lost else ""
        yield f"{name}: {shares} % in the 95 % {'ellipsoid' if suffix else 'ellipse'}, NEES/dof {ratios}{limits}"
