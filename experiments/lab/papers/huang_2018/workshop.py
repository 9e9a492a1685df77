"""Figures 6 and 7 of Huang et al. 2018: a vehicle around a workstation, tracked by MH-K, 2,000 fixes at 0.1 s.

Three parameters of the world are not printed: size of the drift, frequency and size of outliers. They are fitted to the
three metrics of the raw fixes. Two of the six metrics of MH-K, mean and maximum, determine its Q and speed limit, not
printed either; four are predictions. Assumed: speed 0.5 m/s, route 10 m × 6 m, drift of 10 s. All errors are distances
to the designed route; the paper can mean nothing else, because a causal median of 9 is 0.4 s late. Errors in time are
listed beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments.lab.papers.fitting import fitted
from experiments.lab.papers.moving_windows import RAW
from experiments.monte_carlo import (
    FITTED,
    PREDICTED,
    Conclusion,
    ExpectedResult,
    Results,
    Study,
    TrackedRuns,
    TrackerConfig,
    Value,
    World,
    inherited,
)
from experiments.text.wording import listed
from sim.agv import Route, simulate_agv
from sim.corruptions import gauss_markov, outliers
from sim.fixes import correlated_noise
from trackers.mhk.tracker import STILL
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec

ROUTE = Route()
LASTING_S = 10.0
"""Time constant of the drift; far longer than the median's window, which therefore passes it."""


def workshop(
    ids: np.ndarray, seed: int, drift: float, share: float, size: float, speed: float = 0.5
) -> RecordingFolder:
    """Vehicles whose fixes have the noise at rest, a `drift`, m, and outliers of `size`, m, in a `share` of them."""
    errors = {"noise": correlated_noise(STILL), "drift": gauss_markov(drift, LASTING_S), "wild": outliers(share, size)}
    return simulate_agv(ids.tolist(), seed, route=ROUTE, speed=speed, errors=errors).folder("workshop")


def off_route(tracked: TrackedRuns) -> np.ndarray:
    """Distances (n, T), m, of the estimates to the designed route; NaN without an estimate."""
    return np.where(tracked.known, ROUTE.distance(tracked.estimates[..., :2]), np.nan)


def raw_off_route(tracked: TrackedRuns) -> np.ndarray:
    """The same of the fixes themselves."""
    fixes = tracked.folder.tables["fixes"].select("x_m", "y_m").to_numpy()
    return ROUTE.distance(fixes.reshape(-1, len(tracked.estimates), 2)).T


def _each(metric: Callable[[np.ndarray], np.ndarray]) -> Callable[[TrackedRuns], np.ndarray]:
    return lambda tracked: metric(off_route(tracked))


def _improved(tracked: TrackedRuns) -> np.ndarray:
    """Fraction (n,) of the estimates that are closer to the route than the raw fixes."""
    nearer = np.where(tracked.known, off_route(tracked) < raw_off_route(tracked), np.nan)
    share: np.ndarray = np.nanmean(nearer, axis=1)
    return share


def _within(limit: float) -> Callable[[TrackedRuns], np.ndarray]:
    return lambda tracked: np.nanmean(np.where(tracked.known, off_route(tracked) < limit, np.nan), axis=1)


MEASURES: dict[str, Callable[[TrackedRuns], np.ndarray]] = {
    "route_mean_m": _each(lambda e: np.nanmean(e, axis=1)),
    "route_max_m": _each(lambda e: np.nanmax(e, axis=1)),
    "route_variance_m2": _each(lambda e: np.nanvar(e, axis=1)),
    "under_10_cm": _within(0.10),
    "under_15_cm": _within(0.15),
    "improved": _improved,
}


class Printed(NamedTuple):
    """A printed metric in `unit`: our measure, in SI units, times `factor`; printed for raw fixes and for MH-K."""

    measure: str
    factor: float
    unit: str
    raw: float | None
    mhk: float


PRINTED = {
    "mean error": Printed("route_mean_m", 100.0, "cm", 8.82, 4.42),
    "largest error": Printed("route_max_m", 100.0, "cm", 57.89, 16.0),
    "variance": Printed("route_variance_m2", 1e4, "cm²", 76.79, 10.5),
    "under 10 cm": Printed("under_10_cm", 100.0, "%", None, 98.3),
    "under 15 cm": Printed("under_15_cm", 100.0, "%", None, 99.3),
    "fixes improved": Printed("improved", 100.0, "%", None, 71.6),
}
FITTED_OF_MHK = ("mean error", "largest error")
CM = "{:.1f} cm"


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The nine printed metrics, and the paper's conclusions."""
    found: list[ExpectedResult | Conclusion] = []
    for metric, printed in PRINTED.items():
        for tracker, number in (("raw", printed.raw), ("mhk", printed.mhk)):
            if number is not None:
                ours = results.value(printed.measure, "workshop", tracker).times(printed.factor)
                origin = FITTED if tracker == "raw" or metric in FITTED_OF_MHK else PREDICTED
                name, share = f"Figure 7, {metric}, {tracker}", printed.unit == "%"
                note = f"the rest is {100 - ours.value:.2f} %, printed {100 - number:.1f} %" if share else ""
                found.append(ExpectedResult(name, number, ours, printed.unit, origin, note=note, share=share))
    return [*found, *_conclusions(results)]


def _conclusions(results: Results) -> list[ExpectedResult | Conclusion]:
    def cm(measure: str, tracker: str) -> Value:
        return results.value(measure, "workshop", tracker).times(100.0)

    largest = {name: cm("route_max_m", name) for name in ("raw", "median", "mhk")}
    mean = {name: cm("route_mean_m", name) for name in ("raw", "median", "mhk")}
    in_time = {name: cm("mean_m", name) for name in ("raw", "mhk", "mhk-stamped")}
    return [
        Conclusion(
            "the drift is alleviated by the median as well as by MH-K",
            max(largest["median"].value, largest["mhk"].value) < 0.5 * largest["raw"].value,
            "largest distance to the route " + listed(largest, CM),
            inherited(FITTED, PREDICTED),
        ),
        Conclusion(
            "where the drift is largest MH-K is closer to the route than the median alone",
            results.difference("route_max_m", "workshop", "mhk", "median").high < 0,
            f"largest distance to the route {listed(largest, CM)}; but in the mean {listed(mean, CM)}",
            inherited(FITTED, PREDICTED),
        ),
        Conclusion(
            "the location error is less than 20 cm",
            largest["mhk"].value < 20.0,
            f"largest distance to the route {largest['mhk'].value:.1f} cm",
            inherited(FITTED),
        ),
        Conclusion(
            "in time MH-K as printed is worse than the raw fixes, and better with the times of its windows' middles",
            in_time["mhk"].low > in_time["raw"].high and in_time["mhk-stamped"].high < in_time["raw"].low,
            "mean distance to the place at that time " + listed(in_time, CM),
            PREDICTED,
        ),
    ]


def study_with(numbers: dict[str, float], runs: int = 200, seed: int = 1) -> Study:
    """The study with these parameters of the world and of MH-K; its seed differs from the fit's, 0."""
    own = {"fusion.motion.sigma_a": numbers["sigma_a"], "median.speed_limit": numbers["speed_limit"]}
    world = World(workshop, {name: numbers[name] for name in ("drift", "share", "size")})
    configs: dict[str, str | TrackerSpec] = {
        "mhk": "mhk",
        "raw": RAW,
        "median": "median",
        "mhk-stamped": "mhk-stamped",
    }
    return Study(
        name="workshop",
        about="Figures 6 and 7 of Huang et al. 2018: how far from its route a vehicle seems to be, raw and by MH-K",
        worlds={"workshop": world},
        trackers={k: TrackerConfig(e, own if k.startswith("mhk") else {}) for k, e in configs.items()},
        runs=runs,
        seed=seed,
        measures=MEASURES,
        metrics=("route_mean_m", "route_max_m", "improved", "mean_m", "rmse_m", "p95_m"),
        expected=expected,
    )


STUDY = study_with(fitted("huang_2018/workshop"))
