"""How a study's figures are said to a person: units, digits, intervals, headings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.monte_carlo.expectations import Value
from experiments.plots.style import length_unit

WORDS = {
    "rmse": "RMSE", "mean": "mean error", "median": "median error", "p90": "90th percentile",
    "p95": "95th percentile", "p99": "99th percentile", "max": "largest error", "bound": "Cramér–Rao bound",
    "variance_m2": "variance of the error",
    "nees_mean": "NEES, 2 expected", "nees_3d_mean": "NEES in space, 3 expected",
    "coverage_95": "inside the 95 % ellipse", "nis_ratio": "NIS per degree of freedom, 1 expected",
    "lost_fraction": "rows lost", "diverged": "trajectories lost at least once",
    "failed": "trajectories without a usable estimate", "us_per_row": "computing time of a row",
}  # fmt: skip
SUFFIXES = {"3d_m": "in space", "direction_rad": "of direction", "azimuth_rad": "of azimuth",
            "elevation_rad": "of elevation", "m": "", "rad": "", "m2": "", "s": ""}  # fmt: skip
PERCENT = ("coverage_95", "lost_fraction", "diverged", "failed")


class Unit(NamedTuple):
    """The unit in which a figure is read, and how many of them one of ours is."""

    name: str
    factor: float


def unit_of(figure: str, values: Iterable[float]) -> Unit:
    """The unit in which people read figures of this name and these sizes."""
    known = [abs(v) for v in values if math.isfinite(v)]
    if figure in PERCENT or figure.endswith("_share"):
        return Unit("%", 100.0)
    if figure.endswith("_rad"):
        return Unit("°", float(np.rad2deg(1.0)))
    if figure.endswith("_m2"):
        return Unit("cm²", 1e4)
    if figure.endswith("_m"):
        return Unit(*length_unit(float(np.median(known)) if known else math.nan))
    if figure == "us_per_row":
        return Unit("µs", 1.0)
    return Unit("s" if figure.endswith("_s") else "", 1.0)


def units_of(values: Mapping[str, Sequence[float]]) -> dict[str, Unit]:
    """The units of figures that stand side by side: all lengths in that of the first."""
    units = {figure: unit_of(figure, numbers) for figure, numbers in values.items()}
    lengths = [figure for figure in units if figure.endswith("_m")]
    return units | dict.fromkeys(lengths, units[lengths[0]] if lengths else Unit("", 1.0))


def heading(figure: str) -> str:
    """A figure's name in words."""
    if figure in WORDS:
        return WORDS[figure]
    what, _, suffix = figure.partition("_")
    if what in WORDS and suffix in SUFFIXES:
        return f"{WORDS[what]} {SUFFIXES[suffix]}".strip()
    for ending, words in SUFFIXES.items():
        if figure.endswith(f"_{ending}"):
            return f"{_spoken(figure[: -len(ending) - 1])} {words}".strip()
    return _spoken(figure.removesuffix("_share"))


def _spoken(name: str) -> str:
    return " ".join("RMSE" if word == "rmse" else word for word in name.split("_"))


def said(value: float, spread: float) -> str:
    """A number with the digits that its spread leaves it, two or three where the spread is unknown."""
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    size = spread / 2 if math.isfinite(spread) and spread > 0 else abs(value) / 10
    digits = min(max(1 - math.floor(math.log10(size) + 0.5), 0), 6)
    return f"{value:.{digits}f}"


def with_interval(value: Value, unit: Unit) -> str:
    """A figure with its interval; without it where there is none, or its ends are the same but for rounding."""
    scaled = value.times(unit.factor)
    spread = scaled.high - scaled.low
    low, high = said(scaled.low, spread), said(scaled.high, spread)
    if not math.isfinite(spread) or low == high:
        return said(scaled.value, math.nan)
    return f"{said(scaled.value, spread)} ({low} … {high})"
