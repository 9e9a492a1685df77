"""What `check` finds without truth: mistakes made to real recordings, one each, and the recordings as they are.

Swapped anchors or stations, the sign of z of one flipped, one that stands 1 to 2 m elsewhere, the ranges of one in
feet, centimetres or millimetres, and a station turned by 20° to 90°, each of random ones, `DRAWS` times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

import trackwright as tw
from trackwright.experiments.cli.watch import untrue
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.validation.sites import recorded
from trackwright.experiments.text.terminal import progress
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.closing import check_closing
from trackwright.trackers.recordings.checks.fitted_changes import about_vertical
from trackwright.tuning.watch.readings import WATCHED

RECORDINGS = (
    *(f"ble51-walk-u{use}-r{walk}" for use in (1, 2, 3) for walk in (1, 2)), "iasl-drone-1", "iasl-drone-2",
    "isas-walk-1", "labyrinth", "lias-planar-fast", "lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0",
    *(f"ngbui-line-{line}-{walk}" for line in (1, 2, 3) for walk in (1, 2)), "rcv-drone-3", "rcv-drone-6",
    "starloc-2d-s5", "starloc-fast-s1",
)  # fmt: skip
"""All with ranges or bearings."""

DRAWS = 3


def closing_checks(*, output: Output = DEFAULTS) -> int:
    """Mistakes made to real recordings without their truth, found and named, and findings in them as they are."""
    names, rows, as_they_are = RECORDINGS[:2] if output.small else RECORDINGS, list[Row](), list[Row]()
    with progress("recordings", len(names)) as advance:
        for name in names:
            (recording,) = untrue(recorded((name,)))
            table = next(t for t in WATCHED if t in recording.tables)
            as_it_is = list(check_closing(recording, table))
            as_they_are.append(_judged(name, "none", (), as_it_is, []))
            found = [result.message for result in as_it_is]
            for number in range(DRAWS):
                for mistake, whose, mistaken in _mistakes(recording, table, number):
                    rows.append(_judged(name, mistake, whose, list(check_closing(mistaken, table)), found))
            advance(1)
    every = [*rows, *as_they_are]
    by_mistake = [_summary("mistake", x, every) for x in dict.fromkeys(row["mistake"] for row in every)]
    by_recording = [_summary("recording", x, rows) for x in names]
    tables = Table(by_mistake, "Mistakes"), Table(by_recording, "Mistakes by recording")
    output.publish("validation closing-checks", *tables, mistakes=every)
    return 0


def _judged(name: str, mistake: str, whose: tuple[str, ...], results: list[CheckResult], before: list[str]) -> Row:
    """Whether a mistake gives a finding that the recording has not as it is, an error at best, and the right names."""
    new = [result for result in results if result.message not in before]
    words = " ".join(result.message for result in new).replace(",", " ").replace(":", " ").split()
    return {
        "recording": name, "mistake": mistake, "whose": whose, "found": bool(new),
        "error": any(result.level == "error" for result in new), "named": bool(new) and {*whose} <= {*words},
        "finding": [result.message for result in new],
    }  # fmt: skip


def _summary(by: str, which: str, rows: list[Row]) -> Row:
    own = [row for row in rows if row[by] == which]
    return {by: which, "made": len(own)} | {what: sum(row[what] for row in own) for what in ("found", "error", "named")}


def _mistakes(
    recording: tw.RecordingFolder, table: str, number: int
) -> Iterator[tuple[str, tuple[str, ...], tw.RecordingFolder]]:
    """Mistakes in words, the anchors or stations that they are made to, and the recordings with them."""
    random = np.random.default_rng([number, 75])
    rig, rows = recording.rig, recording.tables[table]
    column = "station" if table == "bearings" else "anchor"
    present = set(rows[column].cast(pl.String).unique())
    places = rig.stations if table == "bearings" else rig.anchors
    ids = sorted(name for name in places if name in present)
    a, b = (str(x) for x in random.choice(ids, 2, replace=False))

    def with_places(new: dict[str, np.ndarray]) -> tw.RecordingFolder:
        if table == "bearings":
            moved = {name: replace(rig.stations[name], position=place) for name, place in new.items()}
            return replace(recording, rig=replace(rig, stations={**rig.stations, **moved}))
        return replace(recording, rig=replace(rig, anchors={**rig.anchors, **new}))

    place = {
        name: np.asarray(rig.stations[name].position if table == "bearings" else rig.anchors[name], float)
        for name in (a, b)
    }
    if table == "bearings":
        stations = {**rig.stations, a: rig.stations[b], b: rig.stations[a]}
        yield "swapped", (a, b), replace(recording, rig=replace(rig, stations=stations))
        angle = random.choice([-1.0, 1.0]) * random.uniform(np.radians(20.0), np.radians(90.0))
        axes = Rotation.from_matrix(about_vertical(float(angle)) @ rig.stations[a].world_from_array())
        station = replace(rig.stations[a], rotation=axes.as_quat(scalar_first=True))
        yield "turned", (a,), replace(recording, rig=replace(rig, stations={**rig.stations, a: station}))
    else:
        yield "swapped", (a, b), with_places({a: place[b], b: place[a]})
        if abs(place[a][2]) > 0.5:
            yield "sign of z", (a,), with_places({a: place[a] * [1.0, 1.0, -1.0]})
    way, distance = random.uniform(0.0, 2.0 * np.pi), random.uniform(1.0, 2.0)
    yield "elsewhere", (a,), with_places({a: place[a] + distance * np.array([np.cos(way), np.sin(way), 0.0])})
    if table == "ranges":
        factor = float(random.choice([1.0 / 0.3048, 100.0, 1000.0]))
        mine = pl.col("anchor").cast(pl.String) == a
        scaled = rows.with_columns(range_m=pl.when(mine).then(factor * pl.col("range_m")).otherwise(pl.col("range_m")))
        yield "unit of one", (a,), replace(recording, tables={**recording.tables, table: scaled})
