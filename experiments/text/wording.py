"""Numbers, units and names as text, for tables, pages and plots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trackwright.trackers.core.errors import counted
from trackwright.trackers.evaluation.metrics import ERROR_KINDS, METRICS

MISSING = "–"
STUDIES = {"bound_m": "Cramér–Rao bound", "bound_3d_m": "Cramér–Rao bound in 3-D", "us_per_row": "time per row"}
"""The metrics of a study that are no metrics of scores."""

SUFFIXES = {**ERROR_KINDS, "m": "", "rad": "", "m2": "", "s": "", "share": ""}
ENDINGS = {"_share": "%", "_rad": "rad", "_m2": "m²", "_m": "m", "_s": "s", "us_per_row": "µs"}
"""Units of a study's own metrics and numbers of other tables, by the ends of their names."""


class Unit(NamedTuple):
    """The unit in which a metric is shown, and the factor to it from the stored one."""

    name: str
    factor: float

    @property
    def digits(self) -> int:
        """The digits after the point of values in tables."""
        return {"m": 3, "cm": 1}.get(self.name, 2)


NO_UNIT = Unit("", 1.0)
SHOWN = {"%": Unit("%", 100.0), "rad": Unit("°", 180 / math.pi), "m²": Unit("cm²", 1e4), "rows": NO_UNIT}
"""The units in which metrics are shown, by those in which they are stored."""

SCALES = {"%": (100.0, 0), "": (1.0, 2), "s": (1.0, 1), "rows": (1.0, 0), "nats": (1.0, 2), "rad": (180 / math.pi, 2)}
"""Factor and digits in tables of metrics that are no lengths, by the units in which they are stored."""


def shown_metric(metrics: Mapping[str, Any], name: str) -> float | None:
    """A metric of a recording or track; None without it, and of errors in 3-D where the height is given, not estimated.

    A given height has no covariance, and its error is not the tracker's.
    """
    given = metrics.get("nees_3d_ratio") is None and metrics.get("nees_ratio") is not None
    return None if given and "_3d" in name else metrics.get(name)


def length_unit(size: float) -> Unit:
    """The customary unit of lengths of about `size` metres."""
    if size >= 1.0 or not math.isfinite(size):
        return Unit("m", 1.0)
    return Unit("cm", 100.0) if size >= 0.01 else Unit("mm", 1000.0)


def unit_of(metric: str, values: Iterable[float]) -> Unit:
    """The customary unit of a metric of this name and these sizes."""
    known = [abs(v) for v in values if math.isfinite(v)]
    by_name = next((unit for ending, unit in ENDINGS.items() if metric.endswith(ending)), "")
    unit = METRICS[metric].unit if metric in METRICS else by_name
    if unit == "m":
        return length_unit(float(np.median(known)) if known else math.nan)
    return SHOWN.get(unit, Unit(unit, 1.0))


def units_of(values: Mapping[str, Sequence[float]]) -> dict[str, Unit]:
    """The units of metrics shown side by side: all lengths in the first one's."""
    units = {metric: unit_of(metric, numbers) for metric, numbers in values.items()}
    lengths = [metric for metric in units if metric.endswith("_m")]
    return units | dict.fromkeys(lengths, units[lengths[0]] if lengths else NO_UNIT)


def heading(metric: str, unit: Unit = NO_UNIT, space: str = " ") -> str:
    """A metric's name in words, with the unit where it has one."""
    ending = next((ending for ending in SUFFIXES if metric.endswith(f"_{ending}")), "")
    own = f"{metric.removesuffix(f'_{ending}').replace('_', ' ').replace('rmse', 'RMSE')} {SUFFIXES.get(ending, '')}"
    words = METRICS[metric].words if metric in METRICS else STUDIES.get(metric, own.strip())
    return words + (f",{space}{unit.name}" if unit.name else "")


def number(value: float) -> str:
    """Four significant digits; a dash for NaN and infinities."""
    return f"{value:.4g}" if math.isfinite(value) else MISSING


def fixed(value: float | None, digits: int) -> str:
    """So many digits after the point, never −0; a dash for None and NaN."""
    return MISSING if value is None or math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"


def rounded(value: float, spread: float) -> str:
    """The digits that the spread of the value justifies, two or three where it is unknown."""
    if not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    size = spread / 2 if math.isfinite(spread) and spread > 0 else abs(value) / 10
    return f"{value:.{min(max(1 - math.floor(math.log10(size) + 0.5), 0), 6)}f}"


def figures_drawn(names: Sequence[str]) -> str:
    """The number of figures and the names of the first four."""
    return f"{counted(len(names), 'figure')} ({', '.join(names[:4])}{', …' if len(names) > 4 else ''})"


def yes_no(value: bool | None) -> str:
    """yes, no, or nothing where it is unknown."""
    return "" if value is None else "yes" if value else "no"


def uncapitalised(text: str) -> str:
    """The text for the middle of a sentence; an abbreviation at its beginning stays in capitals."""
    return text if text[:2].isupper() else text[0].lower() + text[1:]
