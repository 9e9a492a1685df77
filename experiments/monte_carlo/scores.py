"""What a study sums over the rows of each trajectory, by the names of `TERMS` in evaluation, and histograms of errors.

In NumPy for estimates of recordings, in jax inside a chunk's program; metrics are expressions over these sums.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.consistency import chi_square_quantile, eliminated
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.evaluation.metrics import LEVELS
from trackwright.trackers.evaluation.rows import ANGLES, AXES, bearing_sizes, position_sizes

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 (m, rad or NEES), of relative width BIN_WIDTH; other values fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))  # upper edges of the bins


def sums(
    estimates: Float[Any, "*rows axes"],
    truth: Float[Any, "*rows axes"],
    entries: Mapping[tuple[int, int], Float[Any, "*rows"]],
    there: Bool[Any, "*rows"],
    known: Bool[Any, "*rows"],
    steps: tuple[Int[Any, "*rows"], Float[Any, "*rows"], Float[Any, "*rows"]],
    total: Callable[[Any], Any],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The sums of each trajectory by name, and the sizes of errors (rows) by kind, −1 where a row has none.

    `estimates`: positions in space or, with two axes, azimuth and elevation; `entries`: of their covariance's upper
    triangle, without a known height. `there`: the last row of each time; `known`: those that are scored. `steps`: of
    all rows status, NIS and its degrees of freedom. `total`: of a number per row, the sum of each trajectory.
    """
    xp, (status, nis, dof) = known.__array_namespace__(), steps
    bearing = estimates.shape[-1] == 2
    if bearing:
        errors, sizes = bearing_sizes(estimates, truth)
    else:
        errors = estimates - truth
        sizes = position_sizes(errors)

    def where(mask: Any, x: Any) -> Any:
        return total(xp.where(mask, x, 0.0))

    found = {"n_rows": total(there), "n": total(known), "lost rows": total(there & (status == Status.LOST))}
    for k, name in enumerate(ANGLES if bearing else AXES):
        # In the plane of an array the angles' errors are unknown.
        found[f"bias {name}"] = where(known & ~xp.isnan(sizes.get(name, errors[..., k])), errors[..., k])
    for kind, size in sizes.items():
        counted = known & ~xp.isnan(size)
        found |= {f"n {kind}": total(counted), f"sum {kind}": where(counted, size)}
        found[f"squares {kind}"], sizes[kind] = where(counted, size**2), xp.where(counted, size, -1.0)
    axes = 1 + max(row for row, _ in entries)
    squares = [reduced**2 / pivot for reduced, pivot in eliminated(errors[..., :axes], entries)]
    for name, d in (("nees", 2), ("nees_3d", 3))[: axes - 1]:
        value = sum(squares[:d])
        finite = known & xp.isfinite(value)
        found |= {f"n {name}": total(finite), f"sum {name}": where(finite, value)}
        for p in LEVELS:
            found[f"inside {p} {name}"] = total(known & (value <= chi_square_quantile(p / 100, d)))
        found[f"judged {name}"] = total(known & ~xp.isnan(value))
    counted = (status != Status.PADDING) & xp.isfinite(nis) & (dof > 0)
    found |= {"nis": where(counted, nis), "dof": where(counted, dof)}
    failed, restarted = total(status == Status.NON_FINITE), total(status == Status.RESTARTED)
    found |= {"diverged": (failed + restarted + found["lost rows"]) > 0, "trajectories": xp.ones_like(failed)}
    return {**found, "failed": (failed > 0) | (found["n"] == 0)}, sizes


def cells(size: Float[Any, "*rows"], trajectory: Int[Any, "*rows"], n: int) -> Int[Any, "*rows"]:
    """The cell of each size in one histogram (n, BINS); of negative ones a cell beyond the last."""
    xp = size.__array_namespace__()
    at = xp.ceil(xp.log(xp.maximum(size, SMALLEST) / SMALLEST) / BIN_WIDTH)
    cell = xp.clip(at, 0, BINS - 1).astype(np.int32) + BINS * trajectory
    return xp.where(size >= 0, cell, n * BINS)


class Scores(NamedTuple):
    """The sums and largest errors of m trajectories by name and kind, and the `cells` of their rows by kind."""

    sums: Mapping[str, Any]
    tops: Mapping[str, Any]
    cells: Mapping[str, Any]


def arrays_of(parts: Sequence[Scores], n: int) -> dict[str, np.ndarray]:
    """The arrays of the first n trajectories of equal parts by name: sums, largest sizes by kind, and histograms.

    A histogram is sparse: `cells`, the steps between indices in one (n, BINS), and their `counts`.
    """
    arrays = {f"sum {name}": np.concatenate([p.sums[name] for p in parts])[:n].astype(float) for name in parts[0].sums}
    for kind in parts[0].tops:
        tops = np.concatenate([part.tops[kind] for part in parts])[:n]
        size = len(parts[0].tops[kind]) * BINS
        counts = [np.bincount(np.asarray(part.cells[kind]).ravel(), minlength=size)[:size] for part in parts]
        whole = np.concatenate(counts)[: n * BINS]
        arrays[f"largest {kind}"] = np.where(tops < 0, np.nan, tops)
        filled = np.flatnonzero(whole)
        for name, numbers in (("cells", np.diff(filled, prepend=0)), ("counts", whole[filled])):
            arrays[f"{name} {kind}"] = numbers.astype(np.min_scalar_type(numbers.max(initial=0)))
    return arrays
