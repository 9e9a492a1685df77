"""Smoothing against lag by the length of MH-K's median (Huang et al. 2018, section 4: "the size is 9").

The world of `workshop` as fitted there, with windows of 1 to 21 fixes, at two speeds. The distance to the route hides
the lag; the error in time shows it, and time stamps at the middle of the window remove it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.lab.papers.fitting import fitted
from experiments.lab.papers.huang_2018.workshop import MEASURES, workshop
from experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult, Results, Study, TrackerConfig, World
from trackers.mhk.rows import TRACKERS
from trackers.mhk.tracker import mhk_tracker
from trackers.recordings.tracker_spec import TrackerSpec

WINDOWS = (1, 3, 5, 9, 13, 21)
NUMBERS = fitted("huang_2018/workshop")
WORLD = {name: NUMBERS[name] for name in ("drift", "share", "size")}
OWN = {"fusion.motion.sigma_a": NUMBERS["sigma_a"], "median.speed_limit": 4.0}
"""A speed limit without effect: the fitted one would limit short windows more than their length does."""


def of_window(rows: int, stamped: bool) -> TrackerSpec:
    """MH-K with a median of `rows` fixes."""
    return replace(
        TRACKERS["mhk"],
        about=f"MH-K with a median of {rows}",
        build=lambda trajectory, planar: mhk_tracker(window=rows, stamped=stamped),
    )


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """Smoothing and lag by window length, and the balance at 9."""
    found: list[ExpectedResult | Conclusion] = []
    for world in ("0.5 m/s", "0.2 m/s"):
        cm = {
            (figure, w): 100 * results.value(figure, world, f"median of {w}").value
            for figure in ("route_max_m", "route_mean_m", "mean_m")
            for w in WINDOWS
        }
        longest = [cm["route_max_m", w] for w in WINDOWS]
        in_time = [cm["mean_m", w] for w in WINDOWS]
        best = WINDOWS[int(np.argmin(in_time))]
        found += [
            Conclusion(
                f"at {world}: the larger the window, the better the smoothing",
                bool(np.all(np.diff(longest) < 0)),
                "largest distance to the route " + _listed(longest),
                PREDICTED,
            ),
            Conclusion(
                f"at {world}: a window of 9 balances smoothing and lag best",
                best == 9,
                f"mean distance to the place at that time is least with {best}: " + _listed(in_time),
                PREDICTED,
            ),
        ]
    stamped = results.difference("mean_m", "0.5 m/s", "median of 9, stamped", "median of 9").times(100)
    found.append(
        Conclusion(
            "most of the error in time is lag that a stamp takes out",
            stamped.high < 0,
            f"a median of 9 at 0.5 m/s, stamped less unstamped: {stamped.value:.1f} cm",
            PREDICTED,
        )
    )
    return found


def _listed(values: list[float]) -> str:
    return ", ".join(f"{w}: {v:.1f} cm" for w, v in zip(WINDOWS, values, strict=True))


STUDY = Study(
    name="median-window",
    about="What the length of the median in MH-K trades: smoothing against lag",
    worlds={f"{speed} m/s": World(workshop, {**WORLD, "speed": speed}) for speed in (0.5, 0.2)},
    trackers={
        **{f"median of {w}": TrackerConfig(of_window(w, False), OWN) for w in (9, *(w for w in WINDOWS if w != 9))},
        "median of 9, stamped": TrackerConfig(of_window(9, True), OWN),
    },
    runs=50,
    measures={name: MEASURES[name] for name in ("route_mean_m", "route_max_m", "improved")},
    metrics=("route_mean_m", "route_max_m", "mean_m", "improved"),
    expected=expected,
)
