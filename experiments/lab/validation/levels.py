"""Default noise levels of `bearings` and `uwb` found without one site each, on which that site is then judged.

The objective is the mean over recordings of the negative log-likelihood of the true horizontal position (`state-nll`),
minimised from the present levels by Nelder and Mead's simplex: Student's t has kinks at which a search by
gradient ends. `real_recordings` runs each site with the levels of the others, as the setting `other sites`.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

import trackwright as tw
from trackwright.experiments.lab.runner import EVIDENCE, Case, Figures, read
from trackwright.experiments.lab.validation.sites import read as recording
from trackwright.trackers.recordings.tracks import TrackerBatch
from trackwright.tuning.data import fit_data
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

FILE = EVIDENCE / "levels.csv"
EVALUATIONS, FIRST_STEP, LOST = 200, 0.4, 50.0
"""Runs of the filter over the recordings; side of the first simplex; nats a row of a filter that diverges."""

DRIFTING = ("sigma_a", "memory", "sigma_bias", "time_constant", "length")


class Levels(NamedTuple):
    """Noise levels that are set together: the builder with its keywords, what a rig numbers, and the recordings."""

    builder: Callable[..., tw.AbstractTracker]
    numbered: str
    names: tuple[str, ...]
    recordings: tuple[str, ...]


TRACKERS = {
    "bearings": Levels(
        tw.aoa.bearing_tracker, "stations", (*DRIFTING, "sigma_azimuth", "sigma_elevation"),
        ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1"),
    ),
    "uwb": Levels(
        tw.uwb_imu.range_tracker, "anchors", (*DRIFTING, "sigma_shared", "sigma_r", "positive_skew", "dof", "bias"),
        ("starloc-fast-s1", "starloc-2d-s5", "rcv-drone-3", "iasl-drone-1", "lias-planar-fast", "labyrinth",
         "ngbui-line-1-1", "ngbui-line-2-1"),
    ),
}  # fmt: skip
"""The trackers whose default levels were set on recordings, and these."""


def cases() -> Iterator[Case]:
    """For each tracker, the levels found without each site."""
    for tracker, levels in TRACKERS.items():
        for site in dict.fromkeys(site_of(tracker, name) for name in levels.recordings):
            yield Case(f"without {site}", tracker, f"{EVALUATIONS} evaluations", partial(found, tracker, site))


def site_of(tracker: str, name: str) -> str:
    """What is left out with a recording: one building and one make of tags, but one use case of the walks."""
    return "-".join(name.split("-")[: 3 if tracker == "bearings" else 1])


def left_out(tracker: str, name: str) -> dict[str, Any]:
    """The levels by keyword that were found without the site of a recording, which has set the default ones."""
    wanted = (f"without {site_of(tracker, name)}", tracker)
    row = next(row for row in read(FILE) if (row["recording"], row["tracker"]) == wanted)
    return {word: np.array(row[word].split(), float) for word in TRACKERS[tracker].names}


def set_by(tracker: str, name: str) -> bool:
    """Whether the site of a recording has set the default levels of the tracker."""
    seen = TRACKERS[tracker].recordings if tracker in TRACKERS else ()
    return site_of(tracker, name) in {site_of(tracker, other) for other in seen}


def at(named: tw.NamedTracker, levels: Mapping[str, Any]) -> tw.NamedTracker:
    """The tracker at levels by keyword of its builder, which sensors may have for each anchor."""
    nodes = {name: (name.rpartition(".")[2], node.value) for name, node in named.tunables.items()}
    of_word = {name: (word, np.shape(now)) for name, (word, now) in nodes.items() if word in levels}
    return named.with_values(
        {name: np.broadcast_to(np.squeeze(levels[word]), n) for name, (word, n) in of_word.items()}
    )


def found(tracker: str, without: str) -> Figures:
    """The levels by keyword, to four digits."""
    names = [name for name in TRACKERS[tracker].recordings if site_of(tracker, name) != without]
    objective = Objective(tracker, [recording(name) for name in names])
    start = objective.start()
    steps = FIRST_STEP * np.diag(np.resize([1.0, -1.0], len(start)))
    options = {"maxfev": EVALUATIONS, "initial_simplex": np.vstack([start, start + steps]), "adaptive": True}
    best = minimize(objective, start, method="Nelder-Mead", options=options)
    return {name: " ".join(f"{x:.4g}" for x in np.ravel(level)) for name, level in objective.values(best.x).items()}


class Objective:
    """The mean `state-nll` over recordings as a function of the logarithms of the levels, one after another."""

    def __init__(self, tracker: str, folders: Sequence[tw.RecordingFolder]):
        self.levels = TRACKERS[tracker]
        defaults = inspect.signature(self.levels.builder).parameters
        self.now = {name: defaults[name].default for name in self.levels.names}
        self.groups = tw.build(tracker, folders).batches(folders)
        self.parts = []
        for group in self.groups:
            data = fit_data(replace(group, tracker=self._tracker(group, self.now)), "state-nll")
            problem = Problem(data.tracker, data.rows.batches, data.objective, select_parameters(data.tracker, ["*"]))
            self.parts.append((problem, data.rows.recordings_of(problem)))

    def start(self) -> np.ndarray:
        """The logarithms of the present defaults."""
        return np.log(np.concatenate([np.ravel(value) for value in self.now.values()]))

    def values(self, logarithms: np.ndarray) -> dict[str, Any]:
        """The levels by keyword."""
        ends = np.cumsum([np.size(value) for value in self.now.values()])[:-1]
        parts = zip(self.now.items(), np.split(np.exp(logarithms), ends), strict=True)
        return {name: tuple(x.tolist()) if np.ndim(now) else float(x[0]) for (name, now), x in parts}

    def __call__(self, logarithms: np.ndarray) -> float:
        """The mean over the recordings, nats a row."""
        sums: dict[str, np.ndarray] = {}
        for group, (problem, owners) in zip(self.groups, self.parts, strict=True):
            vector = flatten(select_parameters(self._tracker(group, self.values(logarithms)), ["*"]))
            for name, terms in zip(owners, problem.terms(vector)[0].T, strict=True):
                if name:
                    sums[name] = sums.get(name, np.zeros(2)) + terms
        each = [nll / rows if np.isfinite(nll) else LOST for nll, rows in sums.values() if rows > 0]
        return float(np.mean(each))

    def _tracker(self, group: TrackerBatch, values: Mapping[str, Any]) -> tw.AbstractTracker:
        count = len(getattr(group.trajectories[0].folder.rig, self.levels.numbered))
        return self.levels.builder(count, group.planar, **values)
