"""A site that is watched: its geometry, its sources and their normal operation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.watch.normal import Normal
from trackwright.tuning.watch.readings import Source
from trackwright.tuning.watch.sequential import Bank


@dataclass(frozen=True, eq=False)
class Site:
    """A site with its baseline, ready to be watched.

    `sources`: what is watched; `scales`: of the errors of each; `width`: of windows, s; `cell_m`: of places; `seconds`:
    of the baseline.
    """

    rig: Rig
    sources: tuple[Source, ...]
    scales: dict[tuple[str, str], np.ndarray]
    width: float
    cell_m: float
    normal: Normal
    bank: Bank
    baseline: tuple[RecordingFolder, ...]
    seconds: float
