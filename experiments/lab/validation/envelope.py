"""Where single precision can be trusted.

Every tracker runs in single and in double precision, on 256 tags together and on 32 one by one, for readings with
standard deviations from 1e-6 to 1e6, times from 0 to 1e6 s between them, and rooms from 1 cm to 100 km
(`envelope_worlds.py`). Both are compared with each other and with the truth, in standard deviations that they report.
Double precision is compared with other methods (`envelope_oracles.py`) where there is one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatch
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import binom

from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.validation.envelope_oracles import METHODS, difference
from trackwright.experiments.lab.validation.envelope_worlds import Cell, Walks, recorded
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.data.estimates import STATUS_WORDS, Status
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.tunable import Covariance, tunables
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.tracks import batches
from trackwright.trackers.recordings.trajectories import Trajectory

SIGMAS = (1e-6, 1e-3, 1.0, 1e3, 1e6)
STEPS = (0.0, 1e-3, 1.0, 1e3, 1e6)
ROOMS = (0.01, 10.0, 1e3, 1e5)
TAGS, ALONE, CHECKED = 256, 32, 2
"""Tags of a recording, those tracked one by one, and those whose double precision is compared with another method."""


AGREES, OFF, WIDER, FEW = 1.0, 6.0, 1.5, 0.05
"""Most standard deviations between single and double precision; from the truth, beyond which an estimate is off; ratio
of standard deviations from which on an estimate counts as coarser; greatest share of tracks that part."""

CHANCE = 1e-4
"""Probability of so many more tracks off in single than in double precision, below which it is not by chance."""

NONSENSE = "SILENT NONSENSE"


class Subject(NamedTuple):
    """The readings of a tracker, as of `recorded`; patterns of its noise levels; tags that are tracked together.

    `known`: tunables that are set to what the readings have.
    """

    table: str
    levels: tuple[str, ...]
    tags: int = TAGS
    known: Mapping[str, float] = MappingProxyType({})


_FIXES = Subject("fixes", ("sensors.fixes.sigma_*",))
_AS_READ = {"sensors.fixes.offset": 0.0, "sensors.fixes.shrink": 1.0}
SUBJECTS: dict[str, Subject] = {
    "fix-kf": _FIXES,
    "fix-singer": _FIXES,
    "imm": _FIXES,
    "fix-mirror": Subject("mirrored", ("sensors.fixes.sigma_*",), known=_AS_READ),
    "mhk": Subject("fixes", ("*.fixes.covariance", "*.sigma_displacement")),
    "uwb": Subject("ranges", ("sensors.ranges.sigma_r",)),
    "multilateration": Subject("ranges", ("sigma_r",)),
    "uwb-imu": Subject("imu", ("sensors.ranges.sigma_r",)),
    "bearings": Subject("bearings", ("sensors.bearings.sigma_*",)),
    # Its grid has a cell for every 5 cm of the path, and takes one form for any number of tags.
    "line-grid": Subject("path", ("sensors.fixes.sigma_p",), 16),
}


def envelope(*trackers: str, output: Output = DEFAULTS) -> int:
    """Single beside double precision over noise, time steps and sizes of rooms; 1 where single is silently wrong.

    A cell is wrong where single precision is, and double is not. With `--small` few tags, in rooms of 10 m.

    Args:
        trackers: their names; by default all that are tried.
    """
    summary, tables, wrong = list[Row](), list[Table](), 0
    cells = [Cell(*one) for one in product(SIGMAS, STEPS, (10.0,) if output.small else ROOMS)]
    for name in chosen(trackers, SUBJECTS):
        by_cell, off = verdicts(name, cells, 12 if output.small else TAGS)
        summary += shown([summarised(name, by_cell, off)])
        tables.append(Table(table(by_cell), f"`{name}`"))
        wrong += summary[-1]["silently wrong"]
    output.publish("validation envelope", Table(summary), *tables)
    return int(wrong > 0)


def verdicts(name: str, cells: Sequence[Cell], tags: int = TAGS) -> tuple[dict[Cell, Verdict], float]:
    """The verdict on every cell, and the largest difference of double precision from another method, in sigmas."""
    by_cell, off = dict[Cell, Verdict](), list[float]()
    for cell in cells:
        several, another = tried(name, cell, min(tags, SUBJECTS[name].tags))
        by_cell[cell] = several
        if SUBJECTS[name].tags > ALONE:
            alone, _ = tried(name, cell, min(tags, ALONE), alone=True)
            by_cell[cell] = alone if alone.words.startswith(NONSENSE) else several
        off.append(another)
    return by_cell, float(np.nanmax([*off, -np.inf]))


def tried(name: str, cell: Cell, tags: int, alone: bool = False) -> tuple[Verdict, float]:
    """The verdict on a cell, its tags together or one by one, and how far double precision is off another method."""
    folder, walks = recorded(cell, SUBJECTS[name].table, tags)
    try:
        with jax.enable_x64(False):
            single = run(ready(name, cell, folder), walks, alone)
        with jax.enable_x64(True):
            group = ready(name, cell, folder)
            double = run(group, walks, alone)
            verdict = judged(single, double)
            few = [trajectory.recording for trajectory in group.trajectories[:CHECKED]]
            off = [difference(group, each) for each in few] if verdict.words == "agrees" and not alone else []
    except UnusableInput as problem:
        return Verdict(f"refused: {str(problem).partition('needs ')[2][:40] or problem}"), np.nan
    return verdict, float(np.nanmax([*off, -np.inf])) if np.isfinite(off).any() else np.nan


def ready(name: str, cell: Cell, folder: RecordingFolder) -> TrackerBatch:
    """The tracker with the cell's noise, that a gap does not end, and its trajectories."""
    named, values = build(name, folder, free_height=True), dict[str, Any](SUBJECTS[name].known)
    for label, tunable in tunables(named.tracker).items():
        size = np.ones(np.shape(tunable.raw))
        if any(fnmatch(label, pattern) for pattern in SUBJECTS[name].levels):
            values[label] = cell.sigma**2 * np.eye(len(size)) if isinstance(tunable, Covariance) else cell.sigma * size
        elif fnmatch(label, "*start.sigma_position") and SUBJECTS[name].table != "bearings":
            values[label] = np.maximum(np.asarray(tunable.value, float), cell.sigma)
        elif fnmatch(label, "*track_loss.max_gap"):
            values[label] = np.inf * size
    (group,) = named.with_values(values).batches(folder)
    return group


def run(group: TrackerBatch, walks: Walks, alone: bool) -> Run:
    """The estimates of all trajectories, together or one by one, in the precision that is set."""
    each = [[trajectory] for trajectory in group.trajectories] if alone else [group.trajectories]
    return Run(*(np.concatenate(parts) for parts in zip(*(_run(group, some, walks) for some in each), strict=True)))


def _run(group: TrackerBatch, some: Sequence[Trajectory], walks: Walks) -> Run:
    ((trajectories, batch),) = batches(some, truth=False)
    estimates = group.tracker.run(batch)
    times = trajectories.columns.padded(trajectories.columns.times)
    rows = slice(times.shape[1])
    axes = range(len(estimates.mean.position))
    positions = np.stack([np.asarray(x, float)[:, rows] for x in estimates.mean.position], axis=-1)
    sigmas = np.stack([np.asarray(estimates.sigmas[f"position.{k}"], float)[:, rows] for k in axes], axis=-1)
    tags = np.array([int(tag) for tag in trajectories.tags])
    truth = Walks(walks.begin[tags], walks.velocity[tags]).at(times)[..., : len(axes)]
    status = estimates.status[:, rows]
    return Run(positions, sigmas, truth, status, np.isin(status, (Status.OK, Status.RESTARTED)))


class Run(NamedTuple):
    """Positions, their standard deviations and the truth (n, T, d), m; statuses (n, T), and which claim a track."""

    positions: np.ndarray
    sigmas: np.ndarray
    truth: np.ndarray
    status: np.ndarray
    usable: np.ndarray

    def off(self) -> np.ndarray:
        """Estimates that claim a track (n, T), and are not within six standard deviations of the truth."""
        with np.errstate(all="ignore"):
            return self.usable & ~(np.max(np.abs(self.positions - self.truth) / self.sigmas, axis=-1) <= OFF)


class Verdict(NamedTuple):
    """What becomes of a cell, in words.

    `difference`: the largest one of both precisions in reported standard deviations, without the tracks that part.
    `parted`: their number. `off`: the numbers of tracks that are off in single and in double precision.
    """

    words: str
    difference: float = np.nan
    parted: int = 0
    off: tuple[int, int] = (0, 0)


def judged(single: Run, double: Run) -> Verdict:
    """What single precision makes of a cell, beside double precision and the truth."""
    known = np.isfinite(single.positions).all(axis=-1) & (np.isfinite(single.sigmas) & (single.sigmas > 0)).all(axis=-1)
    impossible = (single.usable & ~known).sum()
    if impossible:
        return Verdict(f"{NONSENSE}: no numbers in {impossible} of {known.size} rows")
    lost, exact_lost = single.off(), double.off()
    off = int(lost.any(axis=1).sum()), int(exact_lost.any(axis=1).sum())
    if 2 * off[1] > len(lost):
        return Verdict("off the model", np.nan, 0, off)
    # A sign test: where only the model does not hold, as many tracks are worse in either precision.
    worse, better = ((a.sum(axis=1) > b.sum(axis=1)).sum() for a, b in ((lost, exact_lost), (exact_lost, lost)))
    if worse and binom.sf(worse - 1, worse + better, 0.5) < CHANCE:
        return Verdict(f"{NONSENSE}: worse in {worse}, better in {better} of {len(lost)} tracks", np.nan, 0, off)
    if not single.usable.any():
        return Verdict(STATUS_WORDS[Status(int(np.bincount(single.status.ravel()).argmax()))])
    sound = single.usable & double.usable & ~lost & ~exact_lost
    if not sound.any():
        return Verdict("differs", np.nan, len(lost), off)
    with np.errstate(all="ignore"):
        apart = np.where(sound, np.max(np.abs(single.positions - double.positions) / single.sigmas, axis=-1), 0.0)
        # An estimate that makes less of the readings differs from the best by the root of the difference of variances.
        most = AGREES + OFF * np.sqrt(np.maximum(1.0 - np.min(double.sigmas / single.sigmas, axis=-1) ** 2, 0.0))
        wider = np.median(np.max(single.sigmas / double.sigmas, axis=-1)[sound])
    parted = (sound & ~(apart <= most)).any(axis=1)
    if parted.mean() > FEW:
        return Verdict("differs", float(np.max(apart)), int(parted.sum()), off)
    words = "coarser" if wider > WIDER else "agrees"
    return Verdict(words, float(np.max(apart[~parted])), int(parted.sum()), off)


def table(by_cell: Mapping[Cell, Verdict]) -> list[Row]:
    """The verdicts of a tracker over noise and room, the worst over time steps."""
    rooms = dict.fromkeys(cell.room for cell in by_cell)
    return [
        {"σ of a reading": f"{sigma:g}", **{f"{room:g} m": "; ".join(_entry(by_cell, sigma, room)) for room in rooms}}
        for sigma in dict.fromkeys(cell.sigma for cell in by_cell)
    ]


def _entry(by_cell: Mapping[Cell, Verdict], sigma: float, room: float) -> Iterator[str]:
    """The verdicts of all time steps, those of equal words together."""
    by_step = {dt: by_cell[Cell(sigma, dt, room)] for dt in STEPS if Cell(sigma, dt, room) in by_cell}
    for words in dict.fromkeys(v.words for v in by_step.values()):
        same = {dt: v for dt, v in by_step.items() if v.words == words}
        worst = np.fmax.reduce([v.difference for v in same.values()])
        number = f" {worst:.1g}" if np.isfinite(worst) else ""
        parted, off = max(v.parted for v in same.values()), np.max([v.off for v in same.values()], axis=0)
        tracks = [f"{parted} part"] * (parted > 0) + [f"{off[0]} : {off[1]} off"] * bool(off.any())
        where = "" if len(same) == len(by_step) else f" ({', '.join(f'{dt:g}' for dt in same)} s)"
        yield f"{words}{number}{''.join(f', {text}' for text in tracks)}{where}"


def summarised(name: str, by_cell: Mapping[Cell, Verdict], off: float) -> Row:
    """The row of a tracker in the table of all: cells by verdict, and how double precision was checked."""
    words = [v.words for v in by_cell.values()]
    agree, coarser, differ, model = (words.count(word) for word in ("agrees", "coarser", "differs", "off the model"))
    wrong = sum(w.startswith(NONSENSE) for w in words)
    worst = max((v.difference for v in by_cell.values() if v.words in ("agrees", "coarser")), default=np.nan)
    tracks = np.sum([v.off for v in by_cell.values()], axis=0)
    return {
        "tracker": f"`{name}`", "cells": len(words), "agree": agree, "coarser": coarser, "differ": differ,
        "no estimate": len(words) - agree - coarser - differ - wrong - model, "off the model": model,
        "silently wrong": wrong, "largest σ": f"{worst:.1g}",
        "tracks that part": sum(v.parted for v in by_cell.values()),
        "tracks off: single, double": f"{tracks[0]:,}, {tracks[1]:,}",
        "checked by": METHODS.get(name, "none: the same tracker in double precision"),
        "off by σ": f"{off:.1g}" if np.isfinite(off) else "",
    }  # fmt: skip
