"""The slope of the volume of the paths: by what the most probable path misleads about stations.

The likelihood of stations alone integrates over the paths: to the cost of the best path comes half the log determinant
of the paths' information (Laplace; Tierney and Kadane 1986). Without it, larger gains with a path that is drawn
together fit too well: bearings are as good, and such a path is smoother.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve_banded, solve_banded

from trackwright.tuning.survey.solving import PROBES, Solution, linearised
from trackwright.tuning.survey.walks import Walk

STEP = 1e-5
"""Of the differences of unit vectors, m, rad or a share."""


def volume_slope(walks: Sequence[Walk], solution: Solution) -> Float[np.ndarray, " U"]:
    """The derivatives of half the log determinant of the paths' information by the unknowns of the sensors.

    Paths follow the sensors as they do where the cost is least; robust weights are held. Each reading is of one sensor.
    """
    count, width = solution.sensors.shape
    slope, random = np.zeros((count, width)), np.random.default_rng(0)
    for k, (walk, path) in enumerate(zip(walks, solution.paths, strict=True)):
        part = linearised(walk, solution, k, 0.0)
        knots, d = path.shape
        drawn = solve_banded((0, len(part.factor) - 1), part.factor, random.standard_normal((knots * d, PROBES)))
        # Errors (n, d, probes) of the path, where readings are.
        away = (walk.basis @ drawn.reshape(knots, -1)).reshape(len(walk.times), d, -1)
        units = walk.linearised(solution.sensors, path)[1][:, :d]
        spread = part.weights[:, None] * (away * np.einsum("nip,ni->np", away, units)[:, None]).mean(axis=2)

        for column in range(width):
            sensors = solution.sensors.copy()
            sensors[:, column] += STEP
            sensor = walk.levels[:, 0] // (len(solution.scales) // count)
            slope[:, column] += np.bincount(sensor, _change(walk, sensors, path, units, spread), count)
        # All coefficients of an axis move the path as a whole.
        moved = [path + STEP * axis for axis in np.eye(d)]
        towards = np.stack([_change(walk, solution.sensors, at, units, spread) for at in moved], axis=1)
        by_path = (walk.basis.T @ towards).ravel()
        slope -= (part.cross.T @ cho_solve_banded((part.factor, False), by_path)).reshape(slope.shape)
    return slope.ravel()


def _change(walk: Walk, sensors: np.ndarray, path: np.ndarray, units: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """The change (n,) of each reading's part by one `STEP`, from derivatives `units` (n, d) by the tag's position."""
    return ((walk.linearised(sensors, path)[1][:, : path.shape[1]] - units) / STEP * spread).sum(axis=1)
