"""The known path of a recording."""

from __future__ import annotations

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.recordings.folder import RecordingFolder

CLOSING_GAP = 0.05
"""Largest gap between the ends of a closed path, as a fraction of its longest segment."""


def path_of(folder: RecordingFolder) -> Polyline:
    """The folder's known path, closed if its ends nearly meet; raises UnusableInput if there is none."""
    if folder.rig.path_knots is None:
        raise UnusableInput(f"{folder.path}: no [path] in rig.toml, expected its knots_m = [[x, y], …]; add them")
    knots = np.asarray(folder.rig.path_knots, float)
    gap = float(np.linalg.norm(knots[-1] - knots[0]))
    if 0.0 < gap <= CLOSING_GAP * np.linalg.norm(np.diff(knots, axis=0), axis=1).max():
        knots = np.vstack([knots, knots[:1]])
    return Polyline(knots)
