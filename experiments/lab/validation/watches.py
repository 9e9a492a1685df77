"""Watches of sites: changes found and named, and false alarms, in simulated rooms and real recordings.

Simulated: 100 changes, half of them small (10 to 20 cm, 3°, a drift of 2 to 5 cm a minute), after 200 s of runs of
600 s, against baselines of 600 s. Normal operation: 24 h at 10 Hz, in worlds of their own. Real: changes made to
recordings after a third of them, against another recording of the site, or its first half, and the same recordings as
they are.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from multiprocessing import get_context

import numpy as np
import polars as pl

import trackwright as tw
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.validation.sites import recorded
from trackwright.experiments.lab.validation.watch_worlds import (
    SITES,
    Change,
    World,
    behind_wall,
    changed,
    drawn_change,
    normal_operation,
    true_positions,
    world_of,
)
from trackwright.experiments.text.terminal import progress
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.watch.normal import place_numbers
from trackwright.tuning.watch.readings import WATCHED
from trackwright.tuning.watch.result import Watch
from trackwright.tuning.watch.site import Site
from trackwright.tuning.watch.watching import site_of, watch_runs

CHANGES, BASELINE_S, RUN_S, ONSET_S = 100, 600.0, 600.0, 200.0
HOURS, HOURS_OF_SITE, QUIET_RATE, QUIET_WORLDS = 24, 2, 10.0, 9100
"""Normal operation: h in all and of a site, readings of each source a second, and the seed of the first world."""

OF_ANCHORS = ("moved", "delay", "wall", "drift", "moved", "swapped")
REAL = {
    "iasl-drone-2": "iasl-drone-1", "iasl-drone-1": "iasl-drone-2",
    "ngbui-line-1-2": "ngbui-line-1-1", "ngbui-line-1-1": "ngbui-line-1-2",
    "ngbui-line-2-2": "ngbui-line-2-1", "ngbui-line-2-1": "ngbui-line-2-2",
    "ngbui-line-3-2": "ngbui-line-3-1", "ngbui-line-3-1": "ngbui-line-3-2",
    "ble51-walk-u3-r2": "ble51-walk-u3-r1", "ble51-walk-u3-r1": "ble51-walk-u3-r2",
    "rcv-drone-3": None, "lias-planar-fast": None,
}  # fmt: skip
"""Recordings that changes are made to, with the baseline of each: None for its first half."""


def watches(*, output: Output = DEFAULTS) -> int:
    """Changes in simulated sites; 1 if too few of the large ones found are named right."""
    count = 8 if output.small else CHANGES
    rows = []
    with progress("changes", count) as advance, ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for row in pool.map(simulated_change, range(count)):
            rows.append(row)
            advance(1)
    output.publish("validation watches", Table(summary(rows), "Changes"), changes=rows)
    large = [row for row in rows if row["large"] and row["found"]]
    return int(not large or np.mean([row["right"] for row in large]) < 0.9)


def quiet_watches(*, output: Output = DEFAULTS) -> int:
    """Normal operation of simulated sites; 1 if there are more false alarms than one in 24 h."""
    keep_programs()
    sites, rows = 1 if output.small else HOURS // HOURS_OF_SITE, []
    with progress("normal operation", sites) as advance:
        for number in range(sites):
            rows.append(quiet_hours(number, list(SITES)[number % len(SITES)]))
            advance(1)
    output.publish("validation quiet-watches", Table(_of_sites(rows)))
    return int(sum(row["false alarms"] for row in rows) > max(sum(row["h"] for row in rows) / 24.0, 1.0))


def real_watches(*, output: Output = DEFAULTS) -> int:
    """Changes made to real recordings, and the recordings as they are."""
    names = list(REAL)[:2] if output.small else list(REAL)
    count = 4 if output.small else CHANGES
    numbers = [range(k, count, len(names)) for k in range(len(names))]
    rows, quiet = list[Row](), list[Row]()
    with progress("recordings", len(names)) as advance, ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for changes, as_it_is in pool.map(real_site, names, numbers):
            rows += changes
            quiet.append(as_it_is)
            advance(1)
    tables = Table(summary(rows), "Changes"), Table(_by_site(rows), "Changes by recording"), Table(quiet, "As they are")
    output.publish("validation real-watches", *tables, changes=rows)
    return 0


def real_site(name: str, numbers: Iterable[int]) -> tuple[list[Row], Row]:
    """Changes of these numbers made to a real recording, and the recording as it is."""
    keep_programs()
    rows = [real_change(number, name) for number in numbers]
    site, run = _real_site(name)
    found = watch_runs(site, run)
    least = site.bank.least[site.bank.place < 0]
    unit = "°" if site.sources[0].table == "bearings" else " m"
    scale = np.degrees(1.0) if unit == "°" else 1.0
    return rows, {
        "recording": name, "baseline": REAL[name] or "its first half", "min": found.minutes,
        "baseline, min": site.seconds / 60.0, "told from": f"{scale * np.median(least):.2g}{unit}",
        "alarm": found.what(found.causes[0]) if found.changed else "no",
    }  # fmt: skip


def change_of(number: int, table: str, ids: Sequence[str], onset_s: float) -> tuple[Change, bool]:
    """The change of this number, and whether it is large."""
    large = bool(number % 2)
    of_station = ("turned", "turned", "wall", "turned", "swapped", "turned")
    name = (of_station if table == "bearings" else OF_ANCHORS)[number // 2 % 6]
    large = large or name == "swapped"
    return drawn_change(name, large, table, ids, onset_s, number), large


@cache
def simulated_site(seed: int, kind: str) -> tuple[World, Site]:
    """A world and its watch."""
    keep_programs()
    world = world_of(seed, kind)
    return world, site_of(normal_operation(world, "baseline", BASELINE_S, 1000 * seed))


def simulated_change(number: int) -> Row:
    """A change in a simulated site, found or not."""
    kind = list(SITES)[number // 12 % len(SITES)]
    world, site = simulated_site(number, kind)
    run = normal_operation(world, "run", RUN_S, 1000 * number + 1)
    table = next(name for name in WATCHED if name in run.tables)
    change, large = change_of(number, table, [*world.rig.anchors, *world.rig.stations], ONSET_S)
    return {"site": kind, **judged(site, run, change, large, number)}


def real_change(number: int, name: str) -> Row:
    """A change made to a real recording, found or not."""
    site, run = _real_site(name)
    table = site.sources[0].table
    times = run.rows(table).times
    onset = float(times.min() + np.ptp(times) / 3.0)
    change, large = change_of(number // len(REAL) + number % len(REAL), table, [s.name for s in site.sources], onset)
    return {"site": name, **judged(site, run, change, large, number)}


@cache
def _real_site(name: str) -> tuple[Site, tw.RecordingFolder]:
    other = REAL[name]
    (run,) = recorded((name,))
    if other is not None:
        return site_of(recorded((other,))), run
    table = next(t for t in WATCHED if t in run.tables)
    middle = float(run.rows(table).times.mean())
    first = {t: rows.filter(pl.col("t_s") < middle) if t != "truth" else rows for t, rows in run.tables.items()}
    second = {t: rows.filter(pl.col("t_s") >= middle) if t != "truth" else rows for t, rows in run.tables.items()}
    return site_of(replace(run, name=f"{name}, first half", tables=first)), replace(run, tables=second)


def judged(site: Site, run: tw.RecordingFolder, change: Change, large: bool, seed: int) -> Row:
    """What a watch says of a run with a change."""
    began = time.process_time()
    found = watch_runs(site, changed(run, change, seed))
    seconds = time.process_time() - began
    first = float(min(run.rows(t).times.min() for t in WATCHED if t in run.tables))
    since = change.onset_s - first
    early = found.changed and found.alarm_s <= since
    told = found.changed and not early
    named = [(c.name, {s.name for s in c.sources}) for c in (found.named if told else ())]
    is_it = [cause == (change.name, {*change.sources}) for cause in named]
    right = is_it[:1] == [True]
    row: Row = {
        "cause": change.name, "large": large, "sources": list(change.sources), "size": change.size, "found": told,
        "early": early, "right": right, "delay": found.alarm_s - since if told else np.nan,
        "onset error": abs(found.onset_s - since) if told else np.nan, "s": seconds,
        "verdict": found.lines()[0],
        "source right": any(sources == {*change.sources} for _, sources in named[:1]),
        "told apart": len(named) == 1, "named": any(is_it),
    }  # fmt: skip
    return row | (_inside(found, change, run, seed) if right and change.name != "swapped" else {})


def _inside(found: Watch, change: Change, run: tw.RecordingFolder, seed: int) -> Row:
    """How many of the sizes are inside of their 95 % intervals; of an obstruction the mean over the places named."""
    cause = found.causes[0]
    size = change.size[: len(cause.size)] if change.name == "moved" else change.size[0]
    if change.name == "wall":
        size = size * _share_hidden(found, change, run, seed)
    error = np.abs(cause.size - size)
    counted = 1 if change.name == "turned" else len(error)
    inside = (error <= found.half_widths(cause))[:counted]
    return {"sizes": len(inside), "inside": int(inside.sum())}


def _share_hidden(found: Watch, change: Change, run: tw.RecordingFolder, seed: int) -> float:
    """The share of a source's readings, at the places named and after the change, that are behind its wall."""
    rows, name = run.tables[change.table], change.sources[0]
    of = [rows[column].cast(pl.String) == name for column in KINDS[change.table].sensors]
    at = true_positions(run, change.table)[np.any(of, axis=0) & (rows["t_s"] >= change.onset_s).to_numpy()]
    at = at[np.isfinite(at[:, 0])]
    place = place_numbers(np.floor(at[:, :2] / found.site.cell_m).astype(int), found.site.normal.places)
    named = found.causes[0].factor(np.full(len(place), found.causes[0].onset), place) > 0.0
    return float(behind_wall(run.rig, name, at, seed)[named].mean())


def summary(rows: Sequence[Row]) -> list[Row]:
    """A row for each cause and size, and one for all small and all large ones."""
    keys = [(large, cause) for large in (False, True) for cause in (*dict.fromkeys(r["cause"] for r in rows), None)]
    return [
        {
            "size": "large" if large else "small", "cause": cause or "all", "changes": len(own),
            "found": len(told), "median delay, s": _median(r["delay"] for r in told),
            "alarm before": sum(r["early"] for r in own), "source right": sum(r["source right"] for r in told),
            "cause right": sum(r["right"] for r in told),
            "told apart": sum(r["told apart"] for r in told),
            "of those right": sum(r["right"] for r in told if r["told apart"]),
            "right one named": sum(r["named"] for r in told),
            "onset error, s": _median(r["onset error"] for r in told),
            "inside 95 %": _share(told),
        }
        for large, cause in keys
        if (own := [r for r in rows if r["large"] == large and cause in (r["cause"], None)])
        for told in [[r for r in own if r["found"]]]
    ]  # fmt: skip


def _by_site(rows: Sequence[Row]) -> list[Row]:
    """How many changes of each recording were found, and their causes named."""
    result = []
    for site in dict.fromkeys(row["site"] for row in rows):
        of_site: Row = {"recording": site}
        for large, size in ((False, "small"), (True, "large")):
            own = [row for row in rows if row["site"] == site and row["large"] == large]
            of_site |= {size: len(own), f"{size}, found": sum(row["found"] for row in own)}
            of_site |= {f"{size}, right": sum(row["right"] for row in own)}
        result.append(of_site)
    return result


def _median(values: Iterable[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else None


def _share(rows: Sequence[Row]) -> str | None:
    total = sum(row.get("sizes", 0) for row in rows)
    return f"{sum(row.get('inside', 0) for row in rows)} of {total}" if total else None


def quiet_hours(number: int, kind: str) -> Row:
    """Some hours of normal operation of a simulated site, and whether there is an alarm."""
    seed = QUIET_WORLDS + number
    world = world_of(seed, kind)
    site = site_of(normal_operation(world, "baseline", BASELINE_S, 1000 * seed, QUIET_RATE))
    run = normal_operation(world, "run", 3600.0 * HOURS_OF_SITE, 1000 * seed + 1, QUIET_RATE)
    found = watch_runs(site, run)
    highest = float(found.course.statistic.max() / found.course.threshold)
    return {"site": kind, "h": found.minutes / 60.0, "false alarms": int(found.changed), "highest": highest}


def _of_sites(rows: Sequence[Row]) -> list[Row]:
    kinds = [*dict.fromkeys(row["site"] for row in rows), None]
    return [
        {
            "site": kind or "all", "sites": len(own), "h": sum(r["h"] for r in own),
            "false alarms": sum(r["false alarms"] for r in own),
            "highest statistic / threshold": max(r["highest"] for r in own),
        }
        for kind in kinds
        if (own := [r for r in rows if kind in (r["site"], None)])
    ]  # fmt: skip
