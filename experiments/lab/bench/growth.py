"""Time and memory against the size of a problem: every point in a process of its own.

A point is the first call, which traces and compiles without a cache, medians of warm runs, and the peak of the process
over that before the first call. Versions that are slow run up to the sizes that they finish in seconds. The problems
are in `growth_cases.py`, which the processes of the points import alone: their peak is at least that of this one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.experiments.lab.bench.timing import DEFAULTS, Bench, Row, Table, apart
from trackwright.trackers.core.errors import UnusableInput

ALL = 10**9


class Series(NamedTuple):
    """A problem that grows: `versions` with the largest size of each, and `rounds` of warm runs.

    `build`: a function of `growth_cases.py` with its first arguments, by default that of the name of the series.
    """

    about: str
    sizes: tuple[int, ...]
    versions: Mapping[str, int] = {"ours": ALL}
    build: tuple[str | int, ...] = ()
    rounds: int = 3
    limit_s: float = 120.0


SERIES = {
    "rows": Series(
        "beam tracker, 16 trajectories", (20, 64, 200, 640, 2000),
        {"ours": ALL, "textbook": ALL, "dynamax": 200, "cuthbert": 640},
    ),
    "trajectories": Series(
        "beam tracker, 200 rows", (32, 128, 512, 2048, 4096), {"ours": ALL, "textbook": 128, "cuthbert": 128}
    ),
    "states": Series(
        "planar ranges, one a row, 64 trajectories of 200 rows; a NumPy loop and filterpy of one", (4, 8, 12, 20, 36),
        {"ours": ALL, "NumPy": ALL, "filterpy": ALL},
    ),
    "anchors": Series(
        "planar ranges to all anchors in every row, 4 states, 64 trajectories of 200 rows", (3, 6, 12, 25, 50)
    ),
    "particles": Series(
        "particle filter on a line, 256 trajectories of 200 rows; `particles` of 4", (100, 300, 1000, 3000, 10_000),
        {"ours": ALL, "textbook": 1000, "particles": 1000},
    ),
    "tunables": Series(
        "likelihood and gradient of the planar tracker of ranges, 64 trajectories of 200 rows", (1, 4, 8, 16, 64)
    ),
}  # fmt: skip
SMOOTHED = ("uwb", "fix-kf", "fix-singer", "imm", "uwb-imu")


def growth(*series: str, bench: Bench = DEFAULTS) -> int:
    """Time and memory against the size of the problem, beside peers (extra: peers) and NumPy loops.

    Slopes are fitted to the logarithms of processor time and size. 1 if a point fails.

    Args:
        series: rows, trajectories, states, anchors, particles, tunables; by default all.
    """
    unknown = [name for name in series if name not in SERIES]
    if unknown:
        raise UnusableInput(f"bench: unknown series {', '.join(unknown)}; expected {', '.join(SERIES)}")
    return measured("growth", {name: SERIES[name] for name in series or SERIES}, bench)


def lanes(
    *,
    lanes: tuple[int, ...] = (),
    states: tuple[int, ...] = (4, 8, 12, 15),
    smoothed: bool = False,
    trackers: tuple[str, ...] = SMOOTHED,
    bench: Bench = DEFAULTS,
) -> int:
    """Time per row against the number of trajectories: covariances as scalars and as matrices, or smoothers.

    Ranges in the plane, 200 rows; `FEW` in trackers/core/model/covariance.py chooses the form. With `--smoothed`
    trackers of simulated recordings, 50 times, filtered and smoothed, with the call of `run`. 1 if a point fails.

    Args:
        lanes: numbers of trajectories.
        states: numbers of components of the state.
        smoothed: trackers, filtered and smoothed, instead of the two forms of covariances.
        trackers: the trackers of `--smoothed`.
    """
    if smoothed:
        sizes, versions = lanes or (1, 4, 8, 9, 16, 32, 64, 128, 512, 2000), {"filtered": ALL, "smoothed": ALL}
        series = {name: Series("", sizes, versions, ("smoothed", name), 5, 240.0) for name in trackers}
    else:
        sizes, versions = lanes or (1, 2, 4, 8, 64, 512), {"scalars": ALL, "matrices": ALL}
        series = {f"{n} states": Series("", sizes, versions, ("form", n), 15, 240.0) for n in states}
    return measured("lanes", series, bench)


def bearings(*, bench: Bench = DEFAULTS) -> int:
    """The cost of drifting biases in the tracker of bearings: 12 states beside a constant velocity of 4.

    Walks of a minute seen by four stations, 480 bearings each. 1 if a point fails.
    """
    versions = {"constant velocity": ALL, "drifting biases": ALL}
    series = Series("walks seen by four stations, 480 bearings each", (1, 64, 512), versions, (), 15, 240.0)
    return measured("bearings", {"bearings": series}, bench)


def inertial(*, bench: Bench = DEFAULTS) -> int:
    """Compiling the filter of ranges and an IMU, of 23 states, and its gradient of two noise levels.

    1 if a point fails.
    """
    series = Series("uwb-imu with one heading, 100 rows", (1, 512), {"filter": ALL, "gradient": ALL}, limit_s=400.0)
    return measured("inertial", {"inertial": series}, bench)


def measured(case: str, series: Mapping[str, Series], bench: Bench) -> int:
    """Measure the points of all series and publish a table of each."""
    tables = []
    for name, one in series.items():
        points = [(version, size) for version, largest in one.versions.items()
                  for size in one.sizes[: 2 if bench.small else None] if size <= largest]  # fmt: skip
        build, rounds = one.build or (name,), bench.rounds(one.rounds)
        rows = [
            {"size": size, "version": version}
            | apart("growth_cases:point", build, version, size, rounds, limit_s=one.limit_s)
            for version, size in points
        ]
        tables.append(Table(rows, f"{name}: {one.about}".removesuffix(": "), slopes(rows, one.versions)))
    bench.publish(case, *tables)
    return int(any("failed" in row for table in tables for row in table.rows))


def slopes(rows: Sequence[Row], versions: Mapping[str, int]) -> str:
    """The fitted slopes of the logarithm of processor time on that of size, in words."""
    found = []
    for version in versions:
        points = [(row["size"], row["processor ms"]) for row in rows
                  if row["version"] == version and "failed" not in row]  # fmt: skip
        if len(points) > 1:
            x, y = np.log(np.array(points, float)).T
            found.append(f"{version} {np.polyfit(x, y, 1)[0]:.2f}")
    return f"Slope of processor time: {', '.join(found) or 'too few sizes'}."
