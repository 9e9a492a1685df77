"""Watches: whether a site has changed since its baseline, from recordings without truth, and what has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trackwright.trackers.catalogue import tracker_for
from trackwright.trackers.core.errors import UnusableInput, listed, one_or_more
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder, refuse_same_names
from trackwright.tuning.calibrating import check_at_rest
from trackwright.tuning.watch.causes import likely_causes
from trackwright.tuning.watch.normal import normal_of, place_size
from trackwright.tuning.watch.parity import blocks_of
from trackwright.tuning.watch.readings import (
    SLOT_S,
    WATCHED,
    Readings,
    Source,
    joined,
    merged,
    readings_of,
    sources_of,
    times_of,
    window_of,
    with_weights,
)
from trackwright.tuning.watch.result import Watch
from trackwright.tuning.watch.sequential import bank_of, course_of
from trackwright.tuning.watch.site import Site

LEAST_S = 60.0
"""Shortest baseline, s: twelve blocks."""


def site_of(baseline: RecordingFolder | Sequence[RecordingFolder], smallest: float = 1.0) -> Site:
    """The site of baseline recordings; raises UnusableInput as `watch`."""
    folders = _usable(baseline)
    check_at_rest(folders)
    anchors = {name: place for folder in folders for name, place in folder.rig.anchors.items()}
    stations = {name: station for folder in folders for name, station in folder.rig.stations.items()}
    rig = replace(folders[0].rig, anchors=anchors, stations=stations)
    sources = sources_of(folders)
    readings, starts = _tracked(folders, rig, sources)
    readings, scales = with_weights(readings)
    width, cell_m = window_of(readings), place_size(readings)
    blocks = blocks_of(merged(readings, width), sources, width, cell_m)
    seconds = SLOT_S * len(np.unique(blocks.slot))
    if seconds < LEAST_S:
        raise UnusableInput(
            f"{_names(folders)}: a baseline of {seconds:.0f} s; expected {LEAST_S:.0f} s of normal operation at "
            "least, and ten minutes for changes of 10 cm; record longer"
        )
    run = np.searchsorted(starts, SLOT_S * blocks.slot + 1e-6, side="right")
    normal = normal_of(blocks, run, sources)
    bank = bank_of(sources, normal, normal.corrected(blocks), smallest)
    return Site(rig, sources, scales, width, cell_m, normal, bank, tuple(folders), seconds)


def watch_runs(site: Site, runs: RecordingFolder | Sequence[RecordingFolder], alarms_a_day: float = 1.0) -> Watch:
    """Whether the site has changed in runs, in the order given; raises UnusableInput as `watch`."""
    folders = _usable(runs)
    refuse_same_names([folder.name for folder in (*site.baseline, *folders)])
    check_at_rest([*site.baseline, *folders])
    there = sources_of(folders)
    known = {(source.table, source.name) for source in site.sources}
    new = [str(source) for source in there if (source.table, source.name) not in known]
    if len(new) == len(there):
        raise UnusableInput(
            f"{_names(folders)}: has readings of {listed(new)}; expected those of the baseline, "
            f"{listed(map(str, site.sources))}; give recordings of the same site"
        )
    readings, starts = _tracked(folders, _with(site.rig, folders), site.sources)
    readings, _ = with_weights(readings, site.scales)
    again = site.width, site.cell_m
    every = blocks_of(merged(readings, site.width), site.sources, *again)
    blocks = site.normal.corrected(every)
    course = course_of(blocks, site.bank, site.normal, alarms_a_day)
    causes = []
    if course.alarm is not None:
        change = int(course.statistic[course.alarm].argmax())
        onset = int(blocks.slot[course.onset(course.alarm, change)])
        alarm = int(blocks.slot[course.alarm])
        causes = likely_causes(readings, blocks, site.sources, site.normal, onset, alarm, again, site.scales)
    unseen = 1.0 - len(blocks.slot) / len(every.slot)
    return Watch(site, tuple(folders), starts, blocks, course, tuple(causes), unseen, alarms_a_day, tuple(new))


def watch(
    runs: RecordingFolder | Sequence[RecordingFolder],
    baseline: RecordingFolder | Sequence[RecordingFolder],
    smallest: float = 1.0,
    alarms_a_day: float = 1.0,
) -> Watch:
    """Whether a site has changed in `runs` since `baseline`, recordings of its normal operation; no truth is used.

    `smallest`: the smallest changes that count, in units of 10 cm and 3°; `alarms_a_day`: false ones, at most, of all
    anchors, stations and places together. Raises UnusableInput for a baseline that is too short, recordings of
    another site, and those without ranges, range differences and bearings.
    """
    for name, value in (("smallest", smallest), ("alarms_a_day", alarms_a_day)):
        if not 0.0 < value < np.inf:
            raise UnusableInput(f"{name} {value:g}: expected a number above zero, as 1")
    _usable(runs)
    return watch_runs(site_of(baseline, smallest), runs, alarms_a_day)


def _usable(given: RecordingFolder | Sequence[RecordingFolder]) -> list[RecordingFolder]:
    folders = one_or_more(given, (RecordingFolder,), FOLDERS)
    for folder in folders:
        if not any(table in folder.tables and len(folder.tables[table]) for table in WATCHED):
            raise UnusableInput(
                f"{folder.path or folder.name}: tables {listed(folder.tables) or 'none'}; expected ranges, tdoa or "
                "bearings to watch; give recordings with such a table"
            )
    refuse_same_names([folder.name for folder in folders])
    return folders


def _names(folders: Sequence[RecordingFolder]) -> str:
    return listed(str(folder.path or folder.name) for folder in folders)


def _with(rig: Rig, folders: Sequence[RecordingFolder]) -> Rig:
    """The rig, and the anchors and stations that it lacks: their readings are looked up, but not used."""
    anchors = {name: place for folder in folders for name, place in folder.rig.anchors.items()}
    stations = {name: station for folder in folders for name, station in folder.rig.stations.items()}
    return replace(rig, anchors={**anchors, **rig.anchors}, stations={**stations, **rig.stations})


def _tracked(
    folders: Sequence[RecordingFolder], rig: Rig, sources: Sequence[Source]
) -> tuple[dict[str, Readings], np.ndarray]:
    """The readings of recordings, one after another in time, and when each begins, s."""
    parts, starts, tracks, begin = [], [], 0, 0.0
    for folder in folders:
        table = tracker_for(folder).run(folder).table
        first, last = times_of(folder)
        parts.append(readings_of(folder, table, rig, sources, tracks, begin - first))
        starts.append(begin)
        begin += SLOT_S * np.ceil((last - first + SLOT_S) / SLOT_S)
        tracks += table["tag"].n_unique()
    readings = joined(parts)
    if not readings:
        raise UnusableInput(f"{_names(folders)}: no reading has a tracked position; see `trackwright check`")
    return readings, np.array(starts)
