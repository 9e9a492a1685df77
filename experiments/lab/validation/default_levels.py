"""Default noise levels of `bearings` and `uwb` from recordings with truth.

The objective is the mean over recordings of the negative log-likelihood of the true horizontal position (`state-nll`),
minimised by Nelder and Mead's simplex: that of a filter with Student's t has kinks at which a search by gradient ends.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import minimize

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Table
from trackwright.experiments.lab.validation.sites import SEEN_BY_DEFAULTS, recorded
from trackwright.trackers.aoa.fusion import CALIBRATED, bearing_tracker
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import RecordingFolder
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


def default_levels(kind: Literal["bearings", "bearings-calibrated", "uwb"], *, output: Output = DEFAULTS) -> int:
    """Set default noise levels and show them beside the present ones, with the objective of both.

    Args:
        kind: the levels to set.
    """
    keep_programs()
    levels = KINDS[kind]
    folders = recorded(SEEN_BY_DEFAULTS[levels.tracker])
    objective = Objective(levels, known_and_new(folders) if levels.calibrated else folders)
    start = objective.start()
    steps = FIRST_STEP * np.diag(np.resize([1.0, -1.0], len(start)))
    most = 4 if output.small else EVALUATIONS
    options = {"maxfev": most, "initial_simplex": np.vstack([start, start + steps]), "adaptive": True}
    optimum = minimize(objective, start, method="Nelder-Mead", options=options).x
    before, after = (
        {name: ", ".join(f"{x:.3g}" for x in np.ravel(level)) for name, level in objective.values(at).items()}
        for at in (start, optimum)
    )
    present, new = objective.by_recording(start), objective.by_recording(optimum)
    present["mean"], new["mean"] = objective(start), objective(optimum)
    output.publish(
        "validation default-levels",
        Table([{"level": name, "present": before[name], "found": after[name]} for name in levels.names], "levels"),
        Table([{"recording": name, "present": present[name], "found": new[name]} for name in present], "nats a row"),
    )
    return 0


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
