"""The two design problems, anchors in a hall and antennas at a work stand: volumes, layouts and found designs."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.lab.papers.fitting import Fitted, fitted_file, write_fitted
from experiments.monte_carlo import PREDICTED, Conclusion, Results, TrackedRuns, Value
from experiments.monte_carlo.results import resampled
from experiments.pages.plots.style import write_svg
from sim.paths import WORK_VOLUME
from sim.stations import work_station
from trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from tuning.design.bound import bounds, mean_bound
from tuning.design.layouts import AbstractLayout, PlanarArray, WallAnchors, range_sensor
from tuning.design.search import SearchResult

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
    return WallAnchors(HALL, np.array([low, low, high, high]), 2.0, range_sensor(4, SIGMA_R))


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


def design_of(layout: AbstractLayout, found: SearchResult, points: np.ndarray) -> Design:
    """The positions that a search found, and their mean bound without the weight of constraints."""
    theta = jnp.asarray(found.theta)
    bound = float(mean_bound(layout.sensors(theta), jnp.asarray(points)))
    return Design(np.asarray(layout.positions(theta)), bound, found.evaluations / 1000)


def write_designs(name: str, designs: Mapping[str, Design]) -> None:
    """Write the designs by layout to `questions/fitted/design_<name>.toml`, and print them."""
    numbers = {}
    for layout, (positions, bound, thousands) in designs.items():
        print(f"{layout}: mean bound {100 * bound:.3f} cm after {1000 * thousands:.0f} evaluations")
        how = "chosen" if layout == "default" else f"smallest mean bound, by {layout}"
        numbers[f"{layout}_bound"] = Fitted(bound, "m", "computed from this layout")
        numbers[f"{layout}_evaluations"] = Fitted(thousands, "thousand", "evaluations of the objective")
        for k, position in enumerate(positions):
            print("   " + " ".join(f"{x:9.4f}" for x in position))
            for axis, x in zip("xyz", position, strict=False):
                numbers[f"{layout}_{axis}_{k + 1}"] = Fitted(float(x), "m", how)
    print(f"wrote {write_fitted(f'questions/design_{name}', 'nothing printed was used', numbers)}")


def designs(name: str) -> dict[str, Design]:
    """The designs that `fit_design_<name>` wrote, by layout."""
    content = tomllib.loads(fitted_file(f"questions/design_{name}").read_text("utf-8"))
    numbers = {key: table["value"] for key, table in content["numbers"].items()}
    made = {}
    for layout in LAYOUTS:
        axes = [[v for k, v in numbers.items() if k.startswith(f"{layout}_{axis}_")] for axis in "xyz"]
        positions = np.array([a for a in axes if a]).T
        made[layout] = Design(positions, numbers[f"{layout}_bound"], numbers[f"{layout}_evaluations"])
    return made


def bound_map(layout: AbstractLayout, theta: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The bounds (k,), m, at points (k, 3) for a layout's theta."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(lambda t, p: bounds(layout.sensors(t), p))(jnp.asarray(theta), jnp.asarray(points)))


def mean_square(tracked: TrackedRuns) -> np.ndarray:
    """The mean squared 3-D error (n,), m², after the first three seconds."""
    later = tracked.times - tracked.times[:, :1] >= 3.0
    return np.asarray(np.nanmean(np.where(later, np.sum(tracked.error**2, axis=-1), np.nan), axis=1))


def against_grid(name: str) -> Conclusion:
    """Search by gradient against search on the grid, as `fit_design_<name>` found them; no study searches again."""
    default, grid, gradient = (designs(name)[layout] for layout in LAYOUTS)
    searched = (("gradient", gradient), ("grid", grid))
    each = ", ".join(f"{name} {100 * d.bound:.2f} cm after {d.thousands:.1f} thousand" for name, d in searched)
    return Conclusion(
        "the gradient finds a layout at least as good as the grid, with fewer evaluations",
        gradient.bound <= grid.bound and gradient.thousands < grid.thousands,
        f"mean bound over the whole volume: {each} evaluations; default {100 * default.bound:.2f} cm; "
        f"bounds and counts are those of fitted/design_{name}.toml, written by "
        f"`python -m experiments.lab.questions.fit_design_{name}`",
        PREDICTED,
    )


def rmse_ratio(results: Results, tracker: str, layout: str) -> Value:
    """The tracker's RMSE with a layout over that with the default layout, paired."""
    own, default = (results.numbers("square_3d_m2", world, tracker) for world in (layout, "default"))
    weights = resampled(results.study.seed, len(own))
    low, high = np.percentile(np.sqrt((weights @ own) / (weights @ default)), [2.5, 97.5])
    return Value(float(np.sqrt(own.mean() / default.mean())), float(low), float(high))


def maps(
    folder: Path,
    name: str,
    fields: Mapping[str, np.ndarray],
    x: np.ndarray,
    y: np.ndarray,
    mark: Callable[[Axes, str], object],
    title: str,
    stacked: bool = False,
) -> str:
    """Write an SVG with a map for each of the `fields` (len(x), len(y)), m, on one colour scale in cm; its name.

    `mark` draws the anchors or antennas of a layout into its panel. `title` of the figure. `x`, `y` m.
    """
    every = 100 * np.stack(list(fields.values()))

    def draw(figure: Figure) -> None:
        shape = (len(fields), 1) if stacked else (1, len(fields))
        panels: Sequence[Axes] = figure.subplots(*shape, sharex=True, sharey=True).ravel()
        for axes, (layout, field) in zip(panels, fields.items(), strict=True):
            levels = np.linspace(every.min(), every.max(), 13)
            shades = axes.contourf(x, y, 100 * field.T, levels=levels, cmap="viridis_r")
            mark(axes, layout)
            mean = 100 * float(np.sqrt(np.mean(field**2)))
            axes.set_title(f"{layout}: {mean:.1f} cm on the map")
            axes.set_aspect("equal")
            axes.grid(visible=False)
            axes.set(xlabel="" if stacked and axes is not panels[-1] else "x, m")
            axes.set(ylabel="y, m" if stacked or axes is panels[0] else "")
            axes.xaxis.set_major_locator(MaxNLocator(7 if stacked else 3))
            axes.yaxis.set_major_locator(MaxNLocator(3))
        bar = figure.colorbar(shades, ax=list(panels), label="bound, cm", shrink=0.9)
        bar.ax.yaxis.set_major_formatter("{x:.1f}")
        figure.suptitle(title, x=0.01, ha="left", fontsize=9)

    return write_svg(folder, name, draw, 7.0, 6.0 if stacked else 3.0)
