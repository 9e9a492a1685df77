"""Accumulators of each trajectory: sums, and a histogram of its errors.

Means and root mean squares are exact, from sums. Percentiles are interpolated in a histogram with logarithmic bins of
2 %. A million trajectories need no more memory than a thousand.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 m or rad, of relative width BIN_WIDTH; smaller and larger errors fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))
"""AnyCovariance edges of the bins."""

POSITION = ("m", "3d_m")
BEARING = ("direction_rad", "azimuth_rad", "elevation_rad")
KINDS = (*POSITION, *BEARING)
"""Kinds of errors, which are suffixes of the names of metrics."""

SUMS = (
    *(f"{what} {kind}" for kind in KINDS for what in ("n", "sum", "squares")),
    "nees", "nees n", "nees_3d", "nees_3d n", "inside", "nis", "dof", "lost rows", "rows", "diverged", "failed",
)  # fmt: skip
"""Columns of the array of sums."""

COLUMN = {name: k for k, name in enumerate(SUMS)}


def bins(errors: np.ndarray) -> np.ndarray:
    """The bin number of each error."""
    with np.errstate(divide="ignore"):
        at = np.ceil(np.log(np.maximum(errors, 0.0) / SMALLEST) / BIN_WIDTH)
    return np.clip(at, 0, BINS - 1).astype(np.int64)


def histograms(errors: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A sparse (n, BINS) histogram of the errors (n, T) selected by `counts`: flat indices and their counts."""
    first = BINS * np.arange(len(errors))[:, None]
    at = (
        (first + bins(errors)).ravel()
        if counts.all()
        else np.broadcast_to(first, errors.shape)[counts] + bins(errors[counts])
    )
    cells = np.bincount(at, minlength=0)
    filled = np.flatnonzero(cells)
    return filled, cells[filled]


def compact(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk as files hold them: histograms as the distances of their cells and the counts, in few bits.

    Equal histograms are there once, under the names of all their kinds.
    """
    found = {name: x for name, x in arrays.items() if not name.startswith(("cells ", "counts "))}
    alike: list[tuple[list[str], tuple[np.ndarray, np.ndarray]]] = []
    for kind in (name.partition(" ")[2] for name in arrays if name.startswith("cells ")):
        mine = arrays[f"cells {kind}"], arrays[f"counts {kind}"]
        if alike and all(map(np.array_equal, mine, alike[-1][1])):
            alike[-1][0].append(kind)
        else:
            alike.append(([kind], mine))
    for kinds, (cells, counts) in alike:
        both = np.stack([np.diff(cells, prepend=0), counts])
        found[f"histograms {' '.join(kinds)}"] = both.astype(np.min_scalar_type(both.max(initial=0)))
    return found


def expanded(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk from those of its file, also of an earlier version, whose histograms were not compact."""
    found: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        what, *kinds = name.split(" ")
        if what == "histograms":
            cells = np.cumsum(values[0], dtype=np.int64)
            found |= {f"{one} {kind}": x for kind in kinds for one, x in (("cells", cells), ("counts", values[1]))}
        else:
            found[name] = values
    return found


def quantile(histogram: np.ndarray, share: float) -> np.ndarray:
    """The quantile at `share` of histograms (..., BINS), as np.quantile defines it; NaN for empty ones.

    Between the two values nearest in rank, each taken from its bin, whose values are spread evenly on a logarithmic
    scale: off by less than a bin however few they are.
    """
    below = np.cumsum(histogram, axis=-1)
    rank = share * np.maximum(below[..., -1] - 1.0, 0.0)
    lower, upper = (_of_rank(histogram, below, whole) for whole in (np.floor(rank), np.ceil(rank)))
    return lower + (rank - np.floor(rank)) * (upper - lower)


def _of_rank(histogram: np.ndarray, below: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """The values of a rank from 0 of histograms (..., BINS) with cumulative sums `below`; NaN for empty ones."""
    at = np.argmax(below > rank[..., None], axis=-1)[..., None]
    inside = np.take_along_axis(np.asarray(histogram, float), at, -1)[..., 0]
    after = np.take_along_axis(below, at, -1)[..., 0] - rank - 0.5
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where(below[..., -1] > 0, after / inside, np.nan)
    found: np.ndarray = EDGES[at[..., 0]] * np.exp(-BIN_WIDTH * part)
    return found
