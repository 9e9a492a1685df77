"""Distributions: of errors, and of the truth over the levels of the reported ellipses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.style import BLACK, GREY, LINES, literal
from trackwright.trackers.core.data.consistency import chi_square_probability
from trackwright.trackers.evaluation.statements import COVERAGE

POINTS = 201
"""The most points of a curve."""

LOOKS: list[dict[str, Any]] = [{"color": colour} for colour in LINES]

SHARES = (0, 25, 50, 75, 90, 95, 100)
"""Ticks of an axis of shares, %."""

LEVELS = (50, 90, 95, 99)
"""Levels of ellipses, %, marked on the curve of all rows."""


class Curve(NamedTuple):
    """A distribution function: its name, sorted errors (k,) and the shares (k,), %, of rows with at most this error."""

    name: str
    errors: np.ndarray
    shares: np.ndarray

    @classmethod
    def of(cls, name: str, errors: np.ndarray) -> Curve:
        """That of errors (n,), linear between order statistics (Hyndman & Fan 1996, definition 7); NaN is left out."""
        ordered = np.sort(errors[np.isfinite(errors)])
        shares = np.linspace(0, 100, min(len(ordered), POINTS))
        return cls(name, np.interp(shares / 100 * (len(ordered) - 1), np.arange(len(ordered)), ordered), shares)

    def quantiles(self, shares: Sequence[float]) -> np.ndarray:
        """The errors that these shares, %, of the rows have at most; exact where they are among those of the curve."""
        return np.interp(shares, self.shares, self.errors)


def draw_distributions(
    axes: Axes,
    curves: Sequence[Curve],
    quantity: str,
    end: float,
    marked: Sequence[float] = (),
    looks: Sequence[Mapping[str, Any]] = LOOKS,
) -> None:
    """Distribution functions of errors up to `end`, the last error shown.

    `quantity`: what the errors are, with their unit. `marked`: shares, %, marked on each curve. `looks`: colour and
    more of the lines, taken in turn.
    """
    for share in marked if len(marked) > 1 else ():
        axes.axhline(share, color=GREY, linewidth=0.7, linestyle=":")
    for k, curve in enumerate(curves):
        look = dict(looks[k % len(looks)])
        axes.plot(curve.errors, curve.shares, label=literal(curve.name), **look)
        if marked:
            at = curve.quantiles(marked)
            mark = {"color": look["color"], "markersize": 4.5, "markeredgecolor": "white", "label": "_"}
            axes.plot(at, marked, "o", **mark)
    axes.set(xlim=(0, end), ylim=(0, 101), yticks=SHARES, xlabel=quantity)
    axes.set_ylabel("estimates with at most this error (%)")


def levels_of(nees: np.ndarray, dof: int) -> np.ndarray:
    """The level of the ellipse through the truth of each row, sorted; NaN is left out."""
    return np.sort(chi_square_probability(nees[np.isfinite(nees)], dof))


def observed_shares(levels_of_rows: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The share of rows inside the ellipse of each level; `levels_of_rows`: sorted."""
    return np.searchsorted(levels_of_rows, levels, side="right") / max(len(levels_of_rows), 1)


def draw_coverage(axes: Axes, curves: Mapping[str, np.ndarray], pooled: str = "") -> None:
    """The observed share of the truth inside the reported ellipses against their level.

    On the diagonal for correct covariances, below it where they are too small. `curves`: by name the levels of rows as
    `levels_of` has them. `pooled`: the name of the curve that is drawn thick, of all of them together.
    """
    if pooled:
        curves = {**curves, pooled: np.sort(np.concatenate([*curves.values()]))}
    at = np.linspace(0.0, 1.0, POINTS)
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="correct covariances")
    low, high = (100 * x for x in COVERAGE)
    axes.vlines(95, low, high, GREY, linewidth=4.0, alpha=0.45, label=f"covariances hold: {low:.0f} to {high:.0f} %")
    others = [name for name in curves if name != pooled]
    for name, levels in curves.items():
        inside = literal(f"{name}: {100 * observed_shares(levels, np.array([0.95]))[0]:.0f} % inside 95 %")
        shares = 100 * observed_shares(levels, at)
        if name == pooled:
            axes.plot(100 * at, shares, color=BLACK, linewidth=1.9, label=inside)
            marked = 100 * observed_shares(levels, np.array(LEVELS) / 100)
            axes.plot(LEVELS, marked, "o", color=BLACK, markersize=4, markeredgecolor="white", label="_")
        elif len(others) <= len(LINES):
            axes.plot(100 * at, shares, color=LINES[others.index(name)], linewidth=0.9 if pooled else 1.6, label=inside)
        else:
            # Of many curves none has a colour and a name of its own.
            axes.plot(100 * at, shares, color=GREY, linewidth=0.9, label="_")
    axes.set(xlim=(0, 100.8), ylim=(0, 100.8), xticks=SHARES[:5] + SHARES[6:], yticks=SHARES[:5] + SHARES[6:])
    axes.set_aspect("equal")
    all_levels = curves[pooled] if pooled else np.sort(np.concatenate([*curves.values()]))
    below = float(np.mean(observed_shares(all_levels, at) - at)) < 0
    axes.legend(loc="upper left" if below else "lower right")
