"""The two places that are laid out by gradient, a hall and a work stand: their layouts, volumes, and what was found."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.monte_carlo.errors import TrackedRuns
from experiments.monte_carlo.expectations import Conclusion, Value
from experiments.monte_carlo.results import Results, resampled
from experiments.papers.fitting import Fitted, fitted_file, write_fitted
from sim.paths import WORK_VOLUME
from sim.stations import work_station
from trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from tuning.design.bound import bounds, mean_bound
from tuning.design.layouts import AbstractLayout, PlanarArray, WallAnchors, range_sensor
from tuning.design.search import Found

LAYOUTS = ("default", "grid", "gradient")

HALL = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 10.0], [0.0, 10.0]])
TAGS = np.array([[1.5, 1.5, 0.8], [28.5, 8.5, 1.8]])
"""Corners of the hall, and where in it the tags are: lower and upper corner, m."""

SIGMA_R, SIGMA_P = 0.05, 0.25
"""Noise of a range, m, and of a phase, rad."""

ROUND = np.array([0.0, 0.5, 0.375, 0.875])
"""Shares of the way round the hall at which the corners are: two low anchors across, two high ones across."""


def hall() -> WallAnchors:
    """Four anchors on the hall's walls, two of them low and two high, 2 m apart at least."""
    low, high = (0.5, 1.5), (3.5, 5.0)
    return WallAnchors(HALL, np.array([low, low, high, high]), 2.0, range_sensor(4, SIGMA_R))


def stand() -> PlanarArray:
    """Eight antennas, the same at all three stations, in the default's box and with no higher side lobe than it."""
    half_box = np.abs(DEFAULT_ANTENNAS).max(axis=0)
    return PlanarArray(work_station().stations, half_box, DEFAULT_WAVELENGTH / 2, 0.66, SIGMA_P, len(DEFAULT_ANTENNAS))


def usual_hall() -> np.ndarray:
    """The theta (4, 2) of anchors in the corners, low and high in turn as in the paper's chamber."""
    return np.stack([ROUND, [0.0, 0.0, 1.0, 1.0]], axis=1)


def lattice(volume: np.ndarray, counts: tuple[int, int, int]) -> np.ndarray:
    """So many points (k, 3), m, along each axis of a volume (2, 3), its faces included."""
    axes = [np.linspace(low, high, n) for low, high, n in zip(*volume, counts, strict=True)]
    return np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)


TAG_POINTS = lattice(TAGS, (7, 4, 3))
TOOL_POINTS = lattice(WORK_VOLUME, (4, 4, 2))


class Design(NamedTuple):
    """A layout: the `places` (n, d), m, their mean `bound` over the volume, m, and thousands of evaluations it took."""

    places: np.ndarray
    bound: float
    thousands: float


def design_of(layout: AbstractLayout, found: Found, points: np.ndarray) -> Design:
    """The places that a search found, with their bound alone."""
    theta = jnp.asarray(found.theta)
    bound = float(mean_bound(layout.looks(theta), jnp.asarray(points)))
    return Design(np.asarray(layout.places(theta)), bound, found.evaluations / 1000)


def write_designs(name: str, designs: Mapping[str, Design]) -> None:
    """Keep the designs by layout in `questions/fitted/design_<name>.toml`; tell them on the way."""
    numbers = {}
    for layout, (places, bound, thousands) in designs.items():
        print(f"{layout}: mean bound {100 * bound:.3f} cm after {1000 * thousands:.0f} evaluations")
        how = "chosen" if layout == "default" else f"the least mean bound, by {layout}"
        numbers[f"{layout}_bound"] = Fitted(bound, "m", "what the places of this layout give")
        numbers[f"{layout}_evaluations"] = Fitted(thousands, "thousand", "how often the objective was asked")
        for k, place in enumerate(places):
            print("   " + " ".join(f"{x:9.4f}" for x in place))
            for axis, x in zip("xyz", place, strict=False):
                numbers[f"{layout}_{axis}_{k + 1}"] = Fitted(float(x), "m", how)
    print(f"wrote {write_fitted(f'questions/design_{name}', 'nothing printed was used', numbers)}")


def designs(name: str) -> dict[str, Design]:
    """The designs that `fit_design_<name>` wrote, by layout."""
    content = tomllib.loads(fitted_file(f"questions/design_{name}").read_text("utf-8"))
    numbers = {key: table["value"] for key, table in content["numbers"].items()}
    made = {}
    for layout in LAYOUTS:
        axes = [[v for k, v in numbers.items() if k.startswith(f"{layout}_{axis}_")] for axis in "xyz"]
        places = np.array([a for a in axes if a]).T
        made[layout] = Design(places, numbers[f"{layout}_bound"], numbers[f"{layout}_evaluations"])
    return made


def bound_map(layout: AbstractLayout, theta: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The bounds (k,), m, at points (k, 3) of things placed by theta."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(lambda t, p: bounds(layout.looks(t), p))(jnp.asarray(theta), jnp.asarray(points)))


def squares(tracked: TrackedRuns) -> np.ndarray:
    """The mean squared error in space (n,), m², after the first three seconds."""
    rows = tracked.known & (tracked.times - tracked.times[:, :1] >= 3.0)
    square = np.sum((tracked.estimates - tracked.truth) ** 2, axis=-1)
    mean: np.ndarray = np.nanmean(np.where(rows, square, np.nan), axis=1)
    return mean


def against_grid(usual: Design, grid: Design, gradient: Design) -> Conclusion:
    """What the gradient is worth beside the grid."""
    searched = (("gradient", gradient), ("grid", grid))
    each = ", ".join(f"{name} {100 * d.bound:.2f} cm after {d.thousands:.1f} thousand" for name, d in searched)
    return Conclusion(
        "the gradient finds a layout at least as good as the grid, with fewer evaluations",
        gradient.bound <= grid.bound and gradient.thousands < grid.thousands,
        f"mean bound over the whole volume: {each} evaluations; default {100 * usual.bound:.2f} cm",
    )


def fall(results: Results, tracker: str, layout: str) -> Value:
    """The tracker's RMSE with a layout over that with the default, of the same trajectories resampled together."""
    mine, usual = (results.numbers("square_3d_m2", world, tracker) for world in (layout, "default"))
    weights = resampled(results.study.seed, len(mine))
    low, high = np.percentile(np.sqrt((weights @ mine) / (weights @ usual)), [2.5, 97.5])
    return Value(float(np.sqrt(mine.mean() / usual.mean())), float(low), float(high))
