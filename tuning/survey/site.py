"""What a survey is of, and what it does differently by the table of the readings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.survey.result import Survey
from trackwright.tuning.survey.solving import Prior, Solution, solved
from trackwright.tuning.survey.walks import Walk

W = TypeVar("W", bound=Walk)


@dataclass(frozen=True, eq=False)
class Site(Generic[W]):
    """Walks among sensors, anchors or stations, whose ids are `names`, and what is known of their positions.

    `known` (S, 3), m: in the first rig, NaN where it has none; those of the `given` ones have the standard deviation
    `sigma`, m, and all rotations of stations `sigma_turn`, rad, None where they are not known. `frame`: three anchors
    that define the frame where none is given.
    """

    folders: Sequence[RecordingFolder]
    names: Sequence[str]
    walks: Sequence[W]
    known: Float[np.ndarray, "S 3"]
    given: Sequence[str]
    sigma: float
    frame: Sequence[str]
    sigma_turn: float | None

    @property
    def fixed(self) -> list[int]:
        """The numbers of the given sensors."""
        return [self.names.index(name) for name in self.given]

    @property
    def flat(self) -> bool:
        """Whether a height is known, which makes z the vertical."""
        return any(walk.height is not None for walk in self.walks)

    def paths(self, solution: Solution) -> tuple[Float[np.ndarray, "_ 3"], ...]:
        """The positions of the tag in each walk, m."""
        return tuple(walk.positions(path) for walk, path in zip(self.walks, solution.paths, strict=True))

    @property
    def where(self) -> str:
        """The recordings, for messages."""
        return names_of(self.folders)


class SurveyedTable(ABC, Generic[W]):
    """A table that is surveyed with: what its unknowns are, where the search starts, and what fixes the frame.

    `least`: how many anchors or stations a survey needs; `levels`: how many scales of errors each of them has.
    """

    name: ClassVar[str]
    least: ClassVar[int]
    levels: ClassVar[int] = 1

    @abstractmethod
    def walks(self, folders: Sequence[RecordingFolder], names: Sequence[str], height: float | None) -> list[W]:
        """The walks of all tags; `height`: of all, m, else those in rigs."""

    @abstractmethod
    def stated(self, site: Site[W], rig: Rig) -> Rig:
        """What the rig states of the given sensors, which must be the same in all recordings."""

    @abstractmethod
    def begun(self, site: Site[W], random: np.random.Generator) -> tuple[list[Solution], Prior]:
        """Minima of the cost, the first one among the given sensors, and the density before any reading."""

    def solved(self, walks: Sequence[W], start: Solution, prior: Prior, random: np.random.Generator) -> Solution:
        """The solution from a start; `random`: for sensors in local minima of their own."""
        return solved(walks, start, prior)

    def settled(self, walks: Sequence[W], solution: Solution, prior: Prior) -> Solution:
        """The solution after all else that may improve it once the design effect is known."""
        return solution

    @abstractmethod
    def finished(
        self, site: Site[W], solution: Solution, prior: Prior, effect: float, notes: Sequence[str],
        minima: Sequence[Solution],
    ) -> Survey:  # fmt: skip
        """The survey: a solution in its frame, with intervals; `effect`: that of errors that last on variances."""


def names_of(folders: Sequence[RecordingFolder]) -> str:
    """The recordings, for messages."""
    return listed(str(folder.path or folder.name) for folder in folders)


def residuals_of(
    walks: Sequence[Walk], solution: Solution
) -> tuple[Int[np.ndarray, " levels"], Float[np.ndarray, " levels"]]:
    """The number of readings of each scale of errors, and the root mean square of their errors, m or rad."""
    readings, squares = np.zeros(len(solution.scales), int), np.zeros(len(solution.scales))
    for walk, path in zip(walks, solution.paths, strict=True):
        error = walk.residuals(solution.sensors, path)
        for end in walk.levels.T:
            readings += np.bincount(end, minlength=len(readings))
            squares += np.bincount(end, error**2, len(readings))
    return readings, np.sqrt(squares / readings)
