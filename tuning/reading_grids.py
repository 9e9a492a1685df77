"""The lower bounds of fitted noise levels: the rounding of the readings, and the changes of those that repeat."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch

import numpy as np
from jaxtyping import Float

from trackwright.trackers.recordings.reading_grids import ReadingGrid
from trackwright.tuning.parameters import Parameter


def floors(
    grids: Sequence[ReadingGrid], parameters: Sequence[Parameter], bounds: Mapping[str, tuple[float, float]]
) -> Float[np.ndarray, " p"]:
    """The lowest unconstrained vector (p,) with no noise level below `ReadingGrid.lowest`; -inf elsewhere.

    Parameters that the user's `bounds` name have none.
    """
    low = [np.full(parameter.size, -np.inf) for parameter in parameters]
    for parameter, part in zip(parameters, low, strict=True):
        named = any(fnmatch(name, pattern) for pattern in bounds for name in (*parameter.names, parameter.label))
        grid = None if named else grid_of(grids, parameter)
        if grid is not None and math.isfinite(grid.lowest):
            part[:] = math.log(grid.lowest)
    return np.concatenate(low)


def grid_of(grids: Sequence[ReadingGrid], parameter: Parameter) -> ReadingGrid | None:
    """The readings whose noise level a parameter is, the finest of several tied ones; None for other parameters."""
    own = [grid for grid in grids if any(grid.limits(name, parameter.example) for name in parameter.names)]
    return min(own, key=lambda grid: grid.lowest if math.isfinite(grid.lowest) else 0.0, default=None)
