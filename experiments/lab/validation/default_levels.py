"""Default noise levels of `bearings` and `uwb` from recordings with truth.

The objective is the mean over recordings of the negative log-likelihood of the true horizontal position (`state-nll`),
minimised by Nelder and Mead's simplex: that of a filter with Student's t has kinks at which a search by gradient ends.
With `--left-out` each site is judged with levels found on the others, which `fitted/KIND.toml` keeps.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
import tomli_w
from scipy.optimize import minimize

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, LAB, Output, Row, Table, shown
from trackwright.experiments.lab.validation.sites import DEFAULTS as JUDGED
from trackwright.experiments.lab.validation.sites import (
    SEEN_BY_DEFAULTS,
    at_levels,
    left_out_file,
    moves,
    recorded,
    site_of,
)
from trackwright.experiments.text.wording import fixed
from trackwright.trackers.aoa.fusion import CALIBRATED, bearing_tracker
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.selection import Selection
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.uwb_imu.fusion import range_tracker
from trackwright.tuning.calibrating import calibrate
from trackwright.tuning.data import FitArrays, fit_data
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

LOST = 50.0
"""Objective, nats a row, of a recording on which the filter diverges."""

EVALUATIONS = 400
"""Most runs of the filter over the recordings."""

LEFT_OUT_EVALUATIONS = 200
"""The same of each fit of `--left-out`: on all sites they have 99 % of what 300 gain."""

MOST_RANGES = 90_000
"""Ranges of a recording that such a fit reads, from its beginning: 40 s of lias-planar-fast, all of the others."""

FIRST_STEP = 0.4
"""Side of the first simplex, in the logarithm of a level."""


class Levels(NamedTuple):
    """The noise levels of a tracker that are set together.

    `builder`: takes the number of stations or anchors, `planar` and the levels by keyword. `numbered`: what a rig
    numbers. `names`: keywords. `now`: keywords that differ from the builder's defaults. `calibrated`: each recording is
    taken twice, calibrated on all and on the other recordings, as calibrations are used on known and on new ways.
    """

    tracker: str
    builder: Callable[..., AbstractTracker]
    numbered: Literal["stations", "anchors"]
    names: tuple[str, ...]
    now: Mapping[str, Any] = MappingProxyType({})
    calibrated: bool = False

    def values(self) -> dict[str, Any]:
        """The present defaults."""
        parameters = inspect.signature(self.builder).parameters
        return {name: self.now.get(name, parameters[name].default) for name in self.names}


DRIFTING = ("sigma_a", "memory", "sigma_bias", "time_constant", "length")
BEARINGS = (*DRIFTING, "sigma_azimuth", "sigma_elevation")

KINDS = {
    "bearings": Levels("bearings", bearing_tracker, "stations", BEARINGS),
    "bearings-calibrated": Levels("bearings", bearing_tracker, "stations", BEARINGS, CALIBRATED, calibrated=True),
    "uwb": Levels(
        "uwb", range_tracker, "anchors", (*DRIFTING, "sigma_shared", "sigma_r", "positive_skew", "dof", "bias")
    ),
}
"""What can be set. A likelihood over the floor does not determine `sigma_z`, which stays."""


class Objective:
    """The mean `state-nll` over recordings as a function of the logarithms of the levels, one after another."""

    def __init__(self, levels: Levels, folders: Sequence[RecordingFolder]):
        self.levels, self.now = levels, levels.values()
        self.groups = build(levels.tracker, folders).batches(folders)
        self.problems, self.owners = [], []
        for group in self.groups:
            data = fit_data(replace(group, tracker=self._tracker(group, self.now)), "state-nll")
            problem = Problem(data.tracker, data.rows(), data.objective, select_parameters(data.tracker, ["*"]))
            self.problems.append(problem)
            self.owners.append(FitArrays.of(data).recordings_of(problem))

    def start(self) -> np.ndarray:
        """The logarithms of the present defaults."""
        return np.log(np.concatenate([np.ravel(self.now[name]) for name in self.levels.names]))

    def values(self, logarithms: np.ndarray) -> dict[str, Any]:
        """The levels by keyword."""
        sizes = [np.size(self.now[name]) for name in self.levels.names]
        parts = zip(self.now.items(), np.split(np.exp(logarithms), np.cumsum(sizes)[:-1]), strict=True)
        return {name: tuple(x.tolist()) if np.ndim(now) else float(x[0]) for (name, now), x in parts}

    def by_recording(self, logarithms: np.ndarray) -> dict[str, float]:
        """The negative log-likelihood of the truth, nats a row, of each recording."""
        sums: dict[str, np.ndarray] = {}
        values = self.values(logarithms)
        for group, problem, owners in zip(self.groups, self.problems, self.owners, strict=True):
            vector = flatten(select_parameters(self._tracker(group, values), ["*"]))
            for name, terms in zip(owners, problem.terms(vector)[0].T, strict=True):
                if name:
                    sums[name] = sums.get(name, np.zeros(2)) + terms
        return {name: float(nll / rows) if np.isfinite(nll) else LOST for name, (nll, rows) in sums.items() if rows > 0}

    def __call__(self, logarithms: np.ndarray) -> float:
        """The mean over the recordings."""
        return float(np.mean(list(self.by_recording(logarithms).values())))

    def _tracker(self, group: TrackerBatch, values: Mapping[str, Any]) -> AbstractTracker:
        count = len(getattr(group.trajectories[0].folder.rig, self.levels.numbered))
        return self.levels.builder(count, group.planar, **{**self.levels.now, **values})


ESTIMATES: Mapping[str, Callable[[NamedTracker], NamedTracker]] = MappingProxyType(
    {
        "filtered, errors given": lambda named: named.with_error_levels(False),
        "filtered": lambda named: named.with_error_levels(),
        "smoothed": lambda named: named.smoothing(),
    }
)
"""The estimates that are judged; without a word the covariances are those that users get without a calibration."""


def default_levels(
    kind: Literal["bearings", "bearings-calibrated", "uwb"], *, left_out: bool = False, output: Output = DEFAULTS
) -> int:
    """Set default noise levels and show them beside the present ones, with the objective of both.

    Args:
        kind: the levels to set.
        left_out: judge the recordings of each site with levels found on the other sites (200 evaluations from the
            present levels), beside the present levels and those found so on all sites.
    """
    keep_programs()
    levels = KINDS[kind]
    folders = recorded(SEEN_BY_DEFAULTS[levels.tracker])
    if left_out:
        tables, found = sites_left_out(levels, folders, 4 if output.small else LEFT_OUT_EVALUATIONS)
        if not output.small:
            write_left_out(kind, found)
        output.publish("validation default-levels", *tables)
        return 0
    objective = Objective(levels, known_and_new(folders) if levels.calibrated else folders)
    start, best = objective.start(), optimum(objective, 4 if output.small else EVALUATIONS)
    present, new = objective.by_recording(start), objective.by_recording(best)
    present["mean"], new["mean"] = objective(start), objective(best)
    output.publish(
        "validation default-levels",
        by_level({"present": objective.values(start), "found": objective.values(best)}),
        Table([{"recording": name, "present": present[name], "found": new[name]} for name in present], "nats a row"),
    )
    return 0


def optimum(objective: Objective, most: int) -> np.ndarray:
    """The logarithms of the best levels after `most` evaluations from the present ones."""
    start = objective.start()
    steps = FIRST_STEP * np.diag(np.resize([1.0, -1.0], len(start)))
    options = {"maxfev": most, "initial_simplex": np.vstack([start, start + steps]), "adaptive": True}
    best: np.ndarray = minimize(objective, start, method="Nelder-Mead", options=options).x
    return best


def by_level(found: Mapping[str, Mapping[str, Any]]) -> Table:
    """Several sets of levels by title, a level a row."""
    texts = {title: in_words(values) for title, values in found.items()}
    names = next(iter(found.values()))
    return Table([{"level": name, **{title: text[name] for title, text in texts.items()}} for name in names], "levels")


def in_words(values: Mapping[str, Any]) -> dict[str, str]:
    """The levels by keyword, as text."""
    return {name: ", ".join(f"{x:.3g}" for x in np.ravel(level)) for name, level in values.items()}


def sites_left_out(
    levels: Levels, folders: Sequence[RecordingFolder], most: int
) -> tuple[list[Table], dict[str, dict[str, Any]]]:
    """The recordings of each site of `folders` at the present levels and at those found on all, and on other, sites.

    `most`: evaluations of each fit. Returned beside the tables: by site the levels found on the others. Raises
    UnusableInput where all are of one site.
    """
    of = {folder.name: site_of(levels.tracker, folder.name) for folder in folders}
    sites = tuple(dict.fromkeys(of.values()))
    if len(sites) == 1:
        raise UnusableInput(f"--left-out: all recordings of {levels.tracker} are of one site; expected two sites")
    found, rows = {"present": levels.values()}, []
    for number, site in enumerate((None, *sites)):
        title = "all sites" if site is None else f"without {site}"
        print(f"site {number} of {len(sites)}: {title}", file=sys.stderr, flush=True)
        objective = Objective(levels, [shortened(folder) for folder in folders if of[folder.name] != site])
        found[title] = objective.values(optimum(objective, most))
        shown([in_words(found[title])])
        if site is not None:
            ways = {"present": found["present"], "all sites": found["all sites"], "other sites": found[title]}
            every = (beside(levels.tracker, folder, ways) for folder in recorded(f"{site}*") if moves(folder))
            rows += shown(row for of_recording in every for row in of_recording)
    note = f"Bold: not within limits, {JUDGED.honest}. *: set the present levels."
    return [Table(rows, "Sites left out", note), by_level(found)], {site: found[f"without {site}"] for site in sites}


def write_left_out(kind: str, found: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write the levels found without each site, to four digits, where `sites.left_out_levels` reads them."""
    digits = {
        site: {name: np.vectorize(lambda x: float(f"{x:.4g}"))(level).tolist() for name, level in values.items()}
        for site, values in found.items()
    }
    text = f"# Levels found without the recordings of a site, by `{LAB}.validation default-levels {kind} --left-out`.\n"
    text += tomli_w.dumps(digits)
    return atomic_write(left_out_file(kind), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def shortened(folder: RecordingFolder) -> RecordingFolder:
    """The recording up to the last of its first `MOST_RANGES`."""
    if "ranges" not in folder.tables:
        return folder
    times = folder.tables["ranges"]["t_s"][:MOST_RANGES]
    return Selection(stop=float(times[-1])).of(folder)


def beside(tracker: str, folder: RecordingFolder, ways: Mapping[str, Mapping[str, Any]]) -> Iterator[Row]:
    """The figures of a recording at several sets of levels, a row for each of `ESTIMATES`."""
    named, seen = build(tracker, folder), folder.name in SEEN_BY_DEFAULTS[tracker]
    for estimates, applied in ESTIMATES.items():
        row = {"recording": folder.name + "*" * seen, "": estimates}
        for way, values in ways.items():
            metrics = evaluate(applied(at_levels(named, values)).run(folder), folder).overall
            row[f"RMSE, {way}"] = fixed(metrics["rmse_m"], 3)
            row[f"3-D, {way}"] = "" if metrics["coverage_95_3d"] is None else fixed(metrics["rmse_3d_m"], 3)
            text = f"{100 * metrics['coverage_95']:.1f} %, {fixed(metrics['nees_ratio'], 2)}"
            row[f"inside 95 %, NEES/dof, {way}"] = text if JUDGED.honest.holds(metrics) else f"**{text}**"
        yield row


def known_and_new(folders: Sequence[RecordingFolder]) -> list[RecordingFolder]:
    """Each recording calibrated on all of them, and again, by another name, on the others."""
    on_all = calibrate(folders)
    new = [
        replace(folder, name=f"{folder.name}, calibrated on the others").calibrated(
            calibrate([other for other in folders if other is not folder])
        )
        for folder in folders
    ]
    return [*(folder.calibrated(on_all) for folder in folders), *new]
