"""Smoothing against lag by the length of MH-K's median (Huang et al. 2018, section 4: "the size is 9").

The distance to the route hides the lag; the error in time shows it, and time stamps at the middle of the window remove
it.
"""

from collections.abc import Iterator, Sequence

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.experiments.lab.papers.huang_2018.workshop import MEASURES, NUMBERS, WORLD, workshop
from trackwright.trackers.mhk.tracker import mhk_tracker

WINDOWS = (1, 3, 5, 9, 13, 21)
OWN = {"fusion.motion.sigma_a": NUMBERS["sigma_a"], "median.speed_limit": 4.0}
"""A speed limit without effect: the fitted one would limit short windows more than their length does."""


def of_window(rows: int, stamped: bool = False) -> mc.TrackerConfig:
    """MH-K with a median of `rows` fixes."""
    made = mhk_tracker(window=rows, stamped=stamped)
    return built("mhk", f"MH-K with a median of {rows}", lambda trajectory, planar: made, OWN)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Smoothing and lag by window length, and the balance at 9."""
    for world in results.study.worlds:
        longest, in_time = (
            [100 * results.value(metric, world, f"median of {w}").value for w in WINDOWS]
            for metric in ("route_max_m", "mean_m")
        )
        best = WINDOWS[int(np.argmin(in_time))]
        says = f"at {world}: the larger the window, the better the smoothing"
        how = "largest distance to the route " + _listed(longest)
        yield mc.Conclusion(says, bool(np.all(np.diff(longest) < 0)), how, mc.PREDICTED)
        how = f"mean distance to the place at that time is least with {best}: " + _listed(in_time)
        yield mc.Conclusion(f"at {world}: a window of 9 balances smoothing and lag best", best == 9, how, mc.PREDICTED)
    stamped = results.difference("mean_m", "0.5 m/s", "median of 9, stamped", "median of 9").times(100)
    how = f"a median of 9 at 0.5 m/s, stamped less unstamped: {stamped.value:.1f} cm"
    yield mc.Conclusion("most of the error in time is lag that a stamp takes out", stamped.high < 0, how, mc.PREDICTED)


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{w}: {v:.1f} cm" for w, v in zip(WINDOWS, values, strict=True))


STUDY = mc.Study(
    name="median-window",
    about="What the length of the median in MH-K trades: smoothing against lag",
    worlds={f"{speed} m/s": mc.World(workshop, {**WORLD, "speed": speed}) for speed in (0.5, 0.2)},
    trackers={
        **{f"median of {w}": of_window(w) for w in (9, *(w for w in WINDOWS if w != 9))},
        "median of 9, stamped": of_window(9, stamped=True),
    },
    runs=50,
    measures={name: MEASURES[name] for name in ("route_mean_m", "route_max_m", "improved")},
    metrics=("route_mean_m", "route_max_m", "mean_m", "improved"),
    expected=expected,
)
