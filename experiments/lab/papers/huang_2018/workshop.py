"""Figures 6 and 7 of Huang et al. 2018: a vehicle around a workstation, tracked by MH-K, 2,000 fixes at 0.1 s.

Not printed and fitted: size of the drift, frequency and size of outliers; Q and speed limit of MH-K. Assumed: speed
0.5 m/s, route 10 m × 6 m, drift of 10 s. The paper can mean nothing but distances to the designed route, because a
causal median of 9 is 0.4 s late.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import RAW, Printed
from trackwright.experiments.lab.papers.fitting import Fit, Fitted, fitted
from trackwright.experiments.text.expectations import listed
from trackwright.sim.agv import Route, VehicleDraw
from trackwright.sim.corruptions import correlated_noise, gauss_markov, outliers
from trackwright.trackers.mhk.tracker import STILL
from trackwright.trackers.recordings.folder import RecordingFolder

ROUTE = Route()
LASTING_S = 10.0  # time constant of the drift; far longer than the median's window, which therefore passes it


def workshop(
    ids: np.ndarray, seed: int, drift: float, share: float, size: float, speed: float = 0.5
) -> RecordingFolder:
    """Vehicles whose fixes have the noise at rest, a `drift`, m, and outliers of `size`, m, in a `share` of them."""
    errors = {"noise": correlated_noise(STILL), "drift": gauss_markov(drift, LASTING_S), "wild": outliers(share, size)}
    return VehicleDraw(errors, ROUTE, speed).drawn(ids, seed).folder("workshop")


def off_route(tracked: mc.TrackedRuns) -> np.ndarray:
    """Distances (n, T), m, of the estimates to the designed route; NaN without an estimate."""
    return np.where(tracked.known, ROUTE.distance(tracked.estimates[..., :2]), np.nan)


def raw_off_route(tracked: mc.TrackedRuns) -> np.ndarray:
    """The same of the fixes themselves."""
    fixes = tracked.folder.tables["fixes"].select("x_m", "y_m").to_numpy()
    return ROUTE.distance(fixes.reshape(-1, len(tracked.estimates), 2)).T


def _share(tracked: mc.TrackedRuns, hits: np.ndarray) -> np.ndarray:
    """Fraction (n,) of the estimates that are hits."""
    return np.asarray(np.nanmean(np.where(tracked.known, hits, np.nan), axis=1))


MEASURES: dict[str, Callable[[mc.TrackedRuns], np.ndarray]] = {
    "route_mean_m": lambda tracked: np.nanmean(off_route(tracked), axis=1),
    "route_max_m": lambda tracked: np.nanmax(off_route(tracked), axis=1),
    "route_variance_m2": lambda tracked: np.nanvar(off_route(tracked), axis=1),
    "under_10_cm": lambda tracked: _share(tracked, off_route(tracked) < 0.10),
    "under_15_cm": lambda tracked: _share(tracked, off_route(tracked) < 0.15),
    # Closer to the route than the raw fixes.
    "improved": lambda tracked: _share(tracked, off_route(tracked) < raw_off_route(tracked)),
}


_raw, _mhk = (partial(Printed, worlds=("workshop",), tracker=tracker) for tracker in ("raw", "mhk"))
OF_RAW = (
    _raw("Figure 7, mean error, raw", 8.82, "route_mean_m", mc.FITTED, unit="cm"),
    _raw("Figure 7, largest error, raw", 57.89, "route_max_m", mc.FITTED, unit="cm"),
    _raw("Figure 7, variance, raw", 76.79, "route_variance_m2", mc.FITTED, unit="cm²"),
)
OF_MHK = (
    _mhk("Figure 7, mean error, mhk", 4.42, "route_mean_m", mc.FITTED, unit="cm"),
    _mhk("Figure 7, largest error, mhk", 16.0, "route_max_m", mc.FITTED, unit="cm"),
    _mhk("Figure 7, variance, mhk", 10.5, "route_variance_m2", mc.PREDICTED, unit="cm²"),
    _mhk("Figure 7, under 10 cm, mhk", 98.3, "under_10_cm", mc.PREDICTED, unit="%"),
    _mhk("Figure 7, under 15 cm, mhk", 99.3, "under_15_cm", mc.PREDICTED, unit="%"),
    _mhk("Figure 7, fixes improved, mhk", 71.6, "improved", mc.PREDICTED, unit="%"),
)
PRINTED = (*(figure for pair in zip(OF_RAW, OF_MHK[:3], strict=True) for figure in pair), *OF_MHK[3:])
CM = "{:.1f} cm"


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The nine printed metrics, and the paper's conclusions."""
    for figure in PRINTED:
        ours, is_share = figure.ours(results).value, figure.unit == "%"
        note = f"the rest is {100 - ours:.2f} %, printed {100 - figure.number:.1f} %" if is_share else ""
        yield figure.beside(results, note)
    cm = {m: {t: results.value(m, "workshop", t).times(100.0) for t in results.study.trackers} for m in ROUTE_AND_TIME}
    largest, mean = ({t: cm[m][t] for t in ("raw", "median", "mhk")} for m in ROUTE_AND_TIME[:2])
    in_time = {t: cm["mean_m"][t] for t in ("raw", "mhk", "mhk-stamped")}
    holds = max(largest["median"].value, largest["mhk"].value) < 0.5 * largest["raw"].value
    how = "largest distance to the route " + listed(largest, CM)
    yield mc.Conclusion("the drift is alleviated by the median as well as by MH-K", holds, how, mc.DERIVED)
    says = "where the drift is largest MH-K is closer to the route than the median alone"
    how = f"largest distance to the route {listed(largest, CM)}; but in the mean {listed(mean, CM)}"
    yield mc.Conclusion(says, results.difference("route_max_m", "workshop", "mhk", "median").high < 0, how, mc.DERIVED)
    how = f"largest distance to the route {largest['mhk'].value:.1f} cm"
    yield mc.Conclusion("the location error is less than 20 cm", largest["mhk"].value < 20.0, how, mc.DERIVED)
    says = "in time MH-K as printed is worse than the raw fixes, and better with the times of its windows' middles"
    holds = in_time["mhk"].low > in_time["raw"].high and in_time["mhk-stamped"].high < in_time["raw"].low
    yield mc.Conclusion(says, holds, "mean distance to the place at that time " + listed(in_time, CM), mc.PREDICTED)


ROUTE_AND_TIME = ("route_max_m", "route_mean_m", "mean_m")
NUMBERS = fitted("papers/huang_2018/workshop")
WORLD = {name: NUMBERS[name] for name in ("drift", "share", "size")}
MHK = {"sigma_a": ("mhk", "fusion.motion.sigma_a"), "speed_limit": ("mhk", "median.speed_limit")}
OWN = {tunable: NUMBERS[name] for name, (_, tunable) in MHK.items()}
STUDY = mc.Study(
    name="workshop",
    about="Figures 6 and 7 of Huang et al. 2018: how far from its route a vehicle seems to be, raw and by MH-K",
    worlds={"workshop": mc.World(workshop, WORLD)},
    trackers={
        "mhk": mc.TrackerConfig("mhk", OWN),
        "raw": RAW,
        "median": mc.TrackerConfig("median"),
        "mhk-stamped": mc.TrackerConfig("mhk-stamped", OWN),
    },
    runs=200,
    seed=1,
    measures=MEASURES,
    metrics=("route_mean_m", "route_max_m", "improved", "mean_m", "rmse_m", "p95_m"),
    expected=expected,
)

SIGMAS_A = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
SPEED_LIMITS = (0.55, 0.6, 0.8, 1.0, 2.0, 4.0)
"""m/s; the vehicle's speed is 0.5 m/s, and a closer limit would slow its estimates."""

ALL_RAW, BOTH = "mean, maximum and variance of the raw fixes", "mean and maximum of MH-K, from a grid"
START = {"drift": Fitted(0.05, "m", ALL_RAW), "share": Fitted(0.45, "1", ALL_RAW), "size": Fitted(0.16, "m", ALL_RAW)}
LEFT = "4 of 9 printed figures are predictions: variance, under 10 cm, under 15 cm and improved of MH-K"


def fit() -> tuple[str, dict[str, Fitted]]:
    """The world by least squares, then Q and speed limit of MH-K from a grid."""
    left, numbers = Fit(STUDY, START, [[p] for p in OF_RAW], LEFT, 100, 6)()
    of_world, of_mhk = {name: numbers[name].value for name in WORLD}, [[p] for p in OF_MHK[:2]]
    tried, grid = {}, Fit(STUDY, {}, of_mhk, left, 100, tunables=MHK)
    for sigma_a, limit in product(SIGMAS_A, SPEED_LIMITS):
        trial = of_world | {"sigma_a": sigma_a, "speed_limit": limit}
        tried[sigma_a, limit] = float(np.sum(np.log(grid.ratios(trial)) ** 2))
    sigma_a, limit = min(tried, key=tried.__getitem__)
    chosen = {"sigma_a": Fitted(sigma_a, "m/s^2/sqrt(Hz)", BOTH), "speed_limit": Fitted(limit, "m/s", BOTH)}
    return left, numbers | chosen
