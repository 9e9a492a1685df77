"""Distributions of errors and of NIS, one or several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts.style import BEFORE, BLUE, LINES, VERMILION, Chart, Line, rule, steps
from trackwright.tuning.diagnostics import Innovations, expected_density, nis_quantile

SHARES = {share: str(share) for share in (0, 25, 50, 75, 90, 95, 100)}
"""Ticks of an axis of shares, %."""

LOOKS: list[dict[str, Any]] = [{"colour": colour} for colour in LINES]


class Curve(NamedTuple):
    """A distribution function: its name, sorted errors (k,) and the shares (k,), %, of rows with at most this error."""

    name: str
    errors: np.ndarray
    shares: np.ndarray

    @classmethod
    def of(cls, name: str, errors: np.ndarray) -> Curve:
        """The curve of errors (n,), linear between order statistics; NaN is left out."""
        known = errors[np.isfinite(errors)]
        shares = np.linspace(0, 100, min(len(known), 201))
        return cls(name, np.percentile(known, shares), shares)

    def quantiles(self, shares: Sequence[float]) -> np.ndarray:
        """The errors that these shares, %, of the rows have at most."""
        return np.interp(shares, self.shares, self.errors)


def distribution(
    name: str, title: str, curves: Sequence[Curve], quantity: str, end: float, marked: Sequence[float] = (),
    looks: Sequence[Mapping[str, Any]] = LOOKS, **more: Any,
) -> Chart:  # fmt: skip
    """Distribution functions of errors up to `end`.

    `quantity`: what the errors are, with their unit. `marked`: shares, %, marked on each curve.
    """
    parts = [rule(share, (0, end), dash="dot") for share in marked]
    for k, curve in enumerate(curves):
        look = looks[k % len(looks)]
        parts.append(Line(curve.errors, curve.shares, curve.name, **look))
        if marked:
            parts.append(Line(curve.quantiles(marked), marked, "", look["colour"], 0.0, marker="circle"))
    ends: dict[str, Any] = {"xlim": (0, end), "ylim": (0, 101), "yticks": SHARES}
    return Chart(name, title, quantity, "estimates with at most this error (%)", parts, **ends, **more)


def law_of(student_t_dof: float | None) -> str:
    """The distribution of NIS in words: of normal noise, of Student's t, empty for NaN, where it is unknown."""
    if student_t_dof is None:
        return "χ²"
    return "" if math.isnan(student_t_dof) else "Student's t"


def nis_chart(name: str, title: str, after: Innovations, before: Innovations | None = None, **more: Any) -> Chart:
    """Histograms of NIS, and the density of a consistent filter with the degrees of freedom of the rows `after`."""
    law = law_of(after.student_t_dof)
    end = 1.25 * nis_quantile(0.995, float(np.quantile(after.dof, 0.9)), after.student_t_dof if law else None)
    bins, sides = np.linspace(0, end, 36), [after] if before is None else [after, before]
    heights = [np.histogram(side.nis, bins)[0] / (len(side.nis) * bins[1]) for side in sides]
    parts = histograms(bins, heights, f"{len(after.nis)} rows" if before is None else "after")
    # Before a fit the first bin may exceed all others many times; it is cut off.
    tallest = peak = max(float(height.max()) for height in heights)
    if law:
        x = np.linspace(end / 400, end, 400)
        density = expected_density(x, after)
        parts.append(Line(x, density, f"consistent ({law})", VERMILION, 1.6))
        peak = min(float(density[x > bins[1] / 2].max()), 2.5 * tallest)
    top = 1.12 * max(peak, min(tallest, 2.5 * peak))
    beyond = [f"{100 * np.mean(side.nis > end):.1f} %" for side in sides]
    note = f"Beyond the axis: {' after, '.join(beyond)}{' before' if before else ''}."
    return Chart(name, title, "NIS of a row", "density", parts, (0, end), (0, top), note=note, **more)


def histograms(bins: np.ndarray, heights: Sequence[np.ndarray], name: str = "after") -> list[Line]:
    """The histogram after filled, the one before, if any, as an outline."""
    lines = [steps(bins, heights[0], name=name, colour=BLUE, opacity=0.35, filled=True)]
    return lines + [steps(bins, before, name="before", colour=BEFORE) for before in heights[1:]]
