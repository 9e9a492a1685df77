"""What a report of a tuning run is made of: plain numbers and text, as `gather` collects them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tuning.diagnostics import Innovations
from tuning.surface import Surface


@dataclass(frozen=True)
class TunedNumber:
    """One number before and after; `low`, `high`: its 95 % interval, NaN where there is none.

    `determined`: whether the recordings determine it; None where the objective says nothing on that.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float = float("nan")
    high: float = float("nan")
    determined: bool | None = None


@dataclass(frozen=True)
class Score:
    """One figure of merit before and after, on the recordings tuned on and on those held out; NaN where it is missing.

    `key`: what it is, as `rmse` or `nis-shape`. `target`: the value of a filter that tells the truth about itself, as 1
    for NIS per degree of freedom; None where less is better.
    """

    key: str
    title: str
    unit: str
    training: tuple[float, float]
    held_out: tuple[float, float]
    target: float | None = None


@dataclass(frozen=True)
class Descent:
    """The way from one start: the objective (i,) and the tuned numbers (i, p), physical, at every step."""

    name: str
    objective: np.ndarray
    numbers: np.ndarray


@dataclass(frozen=True)
class ErrorTrack:
    """Lengths of errors of one trajectory before and after (t,), in the evidence's error unit, NaN where unknown."""

    name: str
    times: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class TuningEvidence:
    """Everything that the report shows.

    `command`, `again`: what was typed, and what to type to use the result and to run it again. `tracker`, `objective`:
    names, `tracker_about`, `objective_about`: the same in words. `training`, `held_out`: names of recordings.
    `descents`: one for each start, the best first. `judged_on`: in words, on which recordings `innovations` (before,
    after) and `errors` were seen. `identifiability_issues`: sentences on what the recordings leave open. `notes`: sentences on what
    went otherwise than usual. `provenance`: pairs of title and text.
    """

    command: str
    again: tuple[str, ...]
    tracker: str
    tracker_about: str
    objective: str
    objective_about: str
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    numbers: tuple[TunedNumber, ...]
    scores: tuple[Score, ...]
    descents: tuple[Descent, ...]
    landscape: Surface | None
    judged_on: str
    innovations: tuple[Innovations, Innovations] | None
    errors: tuple[ErrorTrack, ...]
    error_unit: str
    filter_runs: int
    seconds: float
    identifiability_issues: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    provenance: tuple[tuple[str, str], ...] = ()

    def score(self, key: str) -> Score | None:
        """The score of this key, where there is one."""
        return next((s for s in self.scores if s.key == key), None)
