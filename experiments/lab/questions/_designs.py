"""The two design problems, anchors in a hall and antennas at a work stand: volumes, layouts and found designs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.fitting import Fitted, fitted
from trackwright.experiments.monte_carlo.results import resampled
from trackwright.sim.paths import WORK_VOLUME
from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from trackwright.tuning.design.bound import bounds, mean_bound
from trackwright.tuning.design.layouts import AbstractLayout, PlanarArray, WallAnchors, ranges
from trackwright.tuning.design.search import SearchResult

LAYOUTS = ("default", "grid", "gradient")

HALL = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 10.0], [0.0, 10.0]])
TAGS = np.array([[1.5, 1.5, 0.8], [28.5, 8.5, 1.8]])
"""Corners of the hall, and the box that the tags move in: lower and upper corner, m."""

SIGMA_R, SIGMA_P = 0.05, 0.25
"""Standard deviation of a range, m, and of a phase, rad."""

ROUND = np.array([0.0, 0.5, 0.375, 0.875])
"""Corners as fractions of the hall's perimeter: two low anchors on one diagonal, two high ones on the other."""


def hall() -> WallAnchors:
    """Four anchors on the walls of the hall, two low and two high, at least 2 m apart."""
    low, high = (0.5, 1.5), (3.5, 5.0)
    return WallAnchors(HALL, np.array([low, low, high, high]), 2.0, partial(ranges, SIGMA_R))


def stand() -> PlanarArray:
    """Eight antennas, the same at all three stations, with the box and at most the side lobes of the default array."""
    half_box = np.abs(DEFAULT_ANTENNAS).max(axis=0)
    return PlanarArray(work_station().stations, half_box, DEFAULT_WAVELENGTH / 2, 0.66, SIGMA_P, len(DEFAULT_ANTENNAS))


def default_hall() -> np.ndarray:
    """The theta (4, 2) of anchors in the corners, alternately low and high as in the chamber of Kwon et al. 2021."""
    return np.stack([ROUND, [0.0, 0.0, 1.0, 1.0]], axis=1)


def lattice(volume: np.ndarray, counts: tuple[int, int, int]) -> np.ndarray:
    """A grid (k, 3) m over a volume (2, 3), with `counts` points along each axis, faces included."""
    axes = [np.linspace(low, high, n) for low, high, n in zip(*volume, counts, strict=True)]
    return np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)


TAG_POINTS = lattice(TAGS, (7, 4, 3))
TOOL_POINTS = lattice(WORK_VOLUME, (4, 4, 2))


class Design(NamedTuple):
    """A layout: `positions` (n, d) m, mean `bound` over the volume, m, and the search's evaluations in thousands."""

    positions: np.ndarray
    bound: float
    thousands: float


def searched(
    layout: AbstractLayout, points: np.ndarray, searches: Mapping[str, SearchResult]
) -> tuple[str, dict[str, Fitted]]:
    """The positions that each search found, and their mean bound over points without the weight of constraints."""
    numbers = {}
    for name, result in searches.items():
        theta = jnp.asarray(result.theta)
        bound = float(mean_bound(layout.sensors(theta), jnp.asarray(points)))
        print(f"{name}: mean bound {100 * bound:.3f} cm after {result.evaluations} evaluations")
        how = "chosen" if name == "default" else f"smallest mean bound, by {name}"
        numbers[f"{name}_bound"] = Fitted(bound, "m", "computed from this layout")
        numbers[f"{name}_evaluations"] = Fitted(result.evaluations / 1000, "thousand", "evaluations of the objective")
        for k, position in enumerate(np.asarray(layout.positions(theta)), 1):
            numbers |= {f"{name}_{a}_{k}": Fitted(float(x), "m", how) for a, x in zip("xyz", position, strict=False)}
    return "nothing printed was used", numbers


def designs(name: str) -> dict[str, Design]:
    """The designs of the fit of `design_<name>`, by layout."""
    numbers, made = fitted(f"questions/design_{name}"), {}
    for layout in LAYOUTS:
        axes = [[v for k, v in numbers.items() if k.startswith(f"{layout}_{axis}_")] for axis in "xyz"]
        positions = np.array([a for a in axes if a]).T
        made[layout] = Design(positions, numbers[f"{layout}_bound"], numbers[f"{layout}_evaluations"])
    return made


def bound_map(layout: AbstractLayout, theta: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The bounds (k,), m, at points (k, 3) for a layout's theta."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(lambda t, p: bounds(layout.sensors(t), p))(jnp.asarray(theta), jnp.asarray(points)))


def mean_square(tracked: mc.TrackedRuns) -> np.ndarray:
    """The mean squared 3-D error (n,), m², after the first three seconds."""
    later = tracked.times - tracked.times[:, :1] >= 3.0
    return np.asarray(np.nanmean(np.where(later, np.sum(tracked.error**2, axis=-1), np.nan), axis=1))


def against_grid(name: str) -> mc.Conclusion:
    """Search by gradient against search on the grid, as the fit found them; no study searches again."""
    default, grid, gradient = (designs(name)[layout] for layout in LAYOUTS)
    tried = (("gradient", gradient), ("grid", grid))
    each = ", ".join(f"{how} {100 * d.bound:.2f} cm after {d.thousands:.1f} thousand" for how, d in tried)
    return mc.Conclusion(
        "the gradient finds a layout at least as good as the grid, with fewer evaluations",
        gradient.bound <= grid.bound and gradient.thousands < grid.thousands,
        f"mean bound over the whole volume: {each} evaluations; default {100 * default.bound:.2f} cm; "
        f"bounds and counts are those of fitted/design_{name}.toml, written by "
        f"`python -m trackwright.experiments.lab.papers.fitting questions/design_{name}`",
        mc.PREDICTED,
    )


def rmse_ratio(results: mc.Results, tracker: str, layout: str) -> mc.Value:
    """The tracker's RMSE with a layout over that with the default layout, paired."""
    squares, default = (results.numbers("square_3d_m2", world, tracker) for world in (layout, "default"))
    weights = resampled(results.study.seed, len(squares))
    low, high = np.percentile(np.sqrt((weights @ squares) / (weights @ default)), [2.5, 97.5])
    return mc.Value(float(np.sqrt(squares.mean() / default.mean())), float(low), float(high))


def maps(
    layout: WallAnchors | PlanarArray,
    designs: Mapping[str, Design],
    axes: tuple[np.ndarray, np.ndarray, float],
    mark: Callable[[Axes, Design], object],
    title: str,
    stacked: bool,
    figure: Figure,
) -> None:
    """A map of the bound for each design, on one colour scale in cm.

    `axes`: x and y (k,), m, and the height, m. `mark` draws the anchors or antennas of a design into its panel.
    """
    x, y, z = axes
    points = np.stack([a.ravel() for a in np.meshgrid(x, y, [z], indexing="ij")], axis=1)
    fields = {
        name: bound_map(layout, layout.theta(design.positions), points).reshape(len(x), len(y))
        for name, design in designs.items()
    }
    values = 100 * np.stack(list(fields.values()))
    shape = (len(fields), 1) if stacked else (1, len(fields))
    panels: Sequence[Axes] = figure.subplots(*shape, sharex=True, sharey=True).ravel()
    for panel, (name, field) in zip(panels, fields.items(), strict=True):
        levels = np.linspace(values.min(), values.max(), 13)
        shades = panel.contourf(x, y, 100 * field.T, levels=levels, cmap="viridis_r")
        mark(panel, designs[name])
        panel.set_title(f"{name}: {100 * float(np.sqrt(np.mean(field**2))):.1f} cm on the map")
        panel.set_aspect("equal")
        panel.grid(visible=False)
        panel.set(xlabel="" if stacked and panel is not panels[-1] else "x, m")
        panel.set(ylabel="y, m" if stacked or panel is panels[0] else "")
        panel.xaxis.set_major_locator(MaxNLocator(7 if stacked else 3))
        panel.yaxis.set_major_locator(MaxNLocator(3))
    bar = figure.colorbar(shades, ax=list(panels), label="bound, cm", shrink=0.9)
    bar.ax.yaxis.set_major_formatter("{x:.1f}")
    figure.suptitle(title, x=0.01, ha="left", fontsize=9)
