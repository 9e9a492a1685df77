"""MH-K with and without its Markov chain, paired: what the chain adds, also where corners take 1.4 m/s²."""

from collections.abc import Iterator, Mapping
from functools import partial

import equinox as eqx

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.experiments.lab.papers.huang_2018.workshop import MEASURES, WORLD, workshop
from trackwright.experiments.text.expectations import fixed_interval
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.mhk.tracker import mhk_tracker

SIGMA_A = 0.3
"""m/s² per √Hz; the level of the workshop's figures, chosen for the printed mean, would be too low for 1.2 m/s."""

MHK = {"fusion.motion.sigma_a": SIGMA_A}
CLOSER_M = 0.007
CLOSER = MHK | {"fusion.filter.sigma_displacement": CLOSER_M}
WORTH_MM = 0.1  # an improvement of a hundredth of the smallest standard deviation of a fix, 0.8 cm

NOISES = {"5 cm": "", "0.7 cm": ", 0.7 cm"}
"""Noise of a displacement, which the paper does not print, and the suffix of its trackers.

The default, and the standard deviation along x of the difference of two successive medians of a tag at rest.
"""


def _mhk(about: str, tunables: Mapping[str, float], chain: bool = True, rate: float | None = None) -> mc.TrackerConfig:
    """MH-K with a chain whose accelerations last 1/`rate` s, or without a chain."""
    made = mhk_tracker(rate=rate, stamped=True)
    if not chain:
        made = eqx.tree_at(lambda t: t.fusion.filter, made, ExtendedKalman())
    return built("mhk-stamped", about, lambda trajectory, planar: made, tunables)


STICKY = partial(_mhk, "MH-K with accelerations that last a second", rate=1.0)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """What the chain adds."""
    for world in results.study.worlds:
        added = {noise: _added(results, world, suffix) for noise, suffix in NOISES.items()}
        says = f"at {world} the Markov chain improves no error by {WORTH_MM:g} mm, and adds to it with less noise"
        holds = min(v.low for values in added.values() for v in values.values()) > -WORTH_MM and all(
            added["0.7 cm"][name].low > value.high for name, value in added["5 cm"].items()
        )
        how = "with less without: " + "; ".join(
            f"noise of a displacement {noise}: "
            + ", ".join(f"{fixed_interval(v, '+.2f', ' mm')} {name}" for name, v in values.items())
            for noise, values in added.items()
        )
        yield mc.Conclusion(says, holds, how, mc.PREDICTED)


def _added(results: mc.Results, world: str, suffix: str) -> dict[str, mc.Value]:
    """The differences, mm, of MH-K with its chain from MH-K without, by error."""
    compared = {
        "to the route": ("route_mean_m", "mhk-stamped"),
        "at most": ("route_max_m", "mhk-stamped"),
        "in time": ("mean_m", "mhk-stamped"),
        "in time with a sticky chain": ("mean_m", "sticky chain"),
    }
    return {
        name: results.difference(metric, world, f"{tracker}{suffix}", "no chain").times(1e3)
        for name, (metric, tracker) in compared.items()
    }


STUDY = mc.Study(
    name="mhk-against",
    about="What does the Markov chain of MH-K add?",
    worlds={f"{speed} m/s": mc.World(workshop, {**WORLD, "speed": speed}) for speed in (0.5, 1.2)},
    trackers={
        "mhk-stamped": mc.TrackerConfig("mhk-stamped", MHK),
        "no chain": _mhk("MH-K without its Markov chain: median and Kalman filter", MHK, chain=False),
        "sticky chain": STICKY(MHK),
        "mhk-stamped, 0.7 cm": mc.TrackerConfig("mhk-stamped", CLOSER),
        "sticky chain, 0.7 cm": STICKY(CLOSER),
    },
    runs=50,
    measures={name: MEASURES[name] for name in ("route_mean_m", "route_max_m", "improved")},
    metrics=("route_mean_m", "route_max_m", "mean_m", "rmse_m", "us_per_row"),
    expected=expected,
)
