"""Sums over rows from which the metrics of many recordings follow, so that their rows need not be held together.

Counts, means, root mean squares, shares and largest errors are exact, and so are percentiles of at most `EXACT` rows.
Percentiles of more are interpolated in histograms with bins of 2 %, those of studies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.monte_carlo.accumulators import BINS, bins, quantile
from trackers.core.chi_square import chi_square_quantile
from trackers.evaluation.association import Association
from trackers.evaluation.evaluate import LEVELS, Metrics, innovations_and_loss
from trackers.evaluation.rank_correlation import RankSums
from trackers.evaluation.scoring import Scored, outside_plane
from trackers.recordings.truth import TruthStatus

Sums = Mapping[str, np.ndarray]
"""Arrays by name; those named `max …` are largest values, those named `values …` are joined, the others add up."""

EXACT = 2000
"""Values of a histogram that are kept beside it: of more rows a percentile differs little by its bins."""

EXCLUDED = {
    "n_no_estimate": TruthStatus.NO_ESTIMATE,
    "n_no_truth": TruthStatus.NO_TRUTH,
    "n_hole": TruthStatus.HOLE,
}
PERCENTILES = {"median": 0.5, "p90": 0.9, "p95": 0.95, "p99": 0.99}
POSITION, BEARING = ("m", "3d_m"), ("direction_rad", "azimuth_rad", "elevation_rad")


def sums_of(association: Association, scored: Scored) -> Sums:
    """The sums over all rows of associated estimates and their scores."""
    counts = np.bincount(association.truth_status, minlength=len(TruthStatus))
    found = {"rows": np.array([len(scored.index), len(association.rows), *(counts[s] for s in EXCLUDED.values())])}
    beside = scored.errors if scored.angle is None else scored.errors[outside_plane(association, scored.index)]
    for kind, norms in _norms(scored, beside).items():
        found[f"errors {kind}"] = np.array([len(norms), np.sum(norms**2)])
        found[f"max {kind}"] = np.max(norms, initial=0.0)
        found |= _distribution(kind, norms)
    found["bias"] = np.nansum(beside, axis=0)
    for suffix, values, dof in (("", scored.nees, 2), ("_3d", scored.nees_3d, 3)):
        if values is not None:
            known = values[np.isfinite(values)]
            inside = [np.sum(known <= chi_square_quantile(level / 100, dof)) for level in LEVELS]
            found[f"nees{suffix}"] = np.array([len(known), known.sum(), *inside])
            found |= _distribution(f"nees{suffix}", known)
    found["nis"] = np.array([scored.nis.sum(), scored.dof.sum()])
    found["products"], found["windows"] = (x.sum(axis=0) for x in scored.nis_ranks)
    found["lost"] = scored.lost.sum(axis=0)
    return found


def _norms(scored: Scored, errors: np.ndarray) -> dict[str, np.ndarray]:
    """The sizes of the errors by kind, as `evaluate` names them; of bearings those outside a plane."""
    if scored.angle is not None:
        return dict(zip(BEARING, (scored.angle[:, 0], *np.abs(errors.T)), strict=True))
    solid = errors[np.isfinite(errors[:, 2])]
    norms = (np.sqrt(np.einsum("nd,nd->n", e, e)) for e in (errors[:, :2], solid))
    return dict(zip(POSITION, norms, strict=True))


def _distribution(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """The histogram of values, and the values where they are few; else none."""
    return {f"histogram {name}": np.bincount(bins(values), minlength=BINS), f"values {name}": _few(values)}


def _few(values: np.ndarray) -> np.ndarray:
    return values if len(values) <= EXACT else np.zeros(0)


def added(parts: Sequence[Sums]) -> Sums:
    """The sums of all parts, added in their order, on which last bits depend."""
    total = dict(parts[0])
    for part in parts[1:]:
        for name, values in part.items():
            if name.startswith("values "):
                total[name] = _few(np.concatenate([total[name], values]))
            else:
                total[name] = np.maximum(total[name], values) if name.startswith("max ") else total[name] + values
    return total


def metrics_of(sums: Sums) -> Metrics:
    """The metrics as those of `evaluate` over all rows, but for `residual_ratio_5s`, which is None."""
    found: Metrics = dict(zip(("n", "n_rows", *EXCLUDED), sums["rows"].tolist(), strict=True))
    bearing = "nees_3d" not in sums
    kinds = BEARING if bearing else POSITION
    for kind in kinds:
        count, squares = sums[f"errors {kind}"].tolist()
        largest = float(sums[f"max {kind}"]) if count else None
        found[f"rmse_{kind}"] = float(np.sqrt(squares / count)) if count else None
        for name, share in PERCENTILES.items():
            # A percentile interpolated in the last bin may lie beyond the largest error.
            found[f"{name}_{kind}"] = min(_quantile(sums, kind, share), largest) if largest is not None else None
        found[f"max_{kind}"] = largest
    counts = [float(sums[f"errors {kind}"][0]) for kind in (kinds[1:] if bearing else ("m", "m", "3d_m"))]
    names = ("azimuth_rad", "elevation_rad") if bearing else ("x_m", "y_m", "z_m")
    for name, total, count in zip(names, sums["bias"].tolist(), counts, strict=True):
        found[f"bias_{name}"] = total / count if count else None
    for suffix, dof in (("", 2),) if bearing else (("", 2), ("_3d", 3)):
        found |= _consistency(sums, suffix, dof)
    nis, freedom = sums["nis"].tolist()
    ranks = RankSums(sums["products"][None], sums["windows"][None])
    found |= innovations_and_loss(nis, freedom, ranks, sums["lost"].tolist(), found["n_rows"])
    return {name: None if value != value else value for name, value in found.items()}


def _consistency(sums: Sums, suffix: str, dof: int) -> Metrics:
    count, total, *inside = sums[f"nees{suffix}"].tolist()
    mean = total / count if count else None
    middle = _quantile(sums, f"nees{suffix}", 0.5)
    return {
        f"nees{suffix}_mean": mean,
        f"nees{suffix}_ratio": None if mean is None else mean / dof,
        f"sigma_factor{suffix}": float(np.sqrt(middle / chi_square_quantile(0.5, dof))),
        **{f"coverage_{p}{suffix}": n / count if count else None for p, n in zip(LEVELS, inside, strict=True)},
    }


def _quantile(sums: Sums, name: str, share: float) -> float:
    histogram, values = sums[f"histogram {name}"], sums[f"values {name}"]
    # Values that were once too many are missing for good.
    exact = 0 < len(values) == histogram.sum()
    return float(np.quantile(values, share) if exact else quantile(histogram, share))


def plain(sums: Sums) -> dict[str, Any]:
    """The sums as JSON holds them, of histograms the filled bins."""
    return {
        name: [(filled := np.flatnonzero(values)).tolist(), values[filled].tolist()]
        if name.startswith("histogram ")
        else values.tolist()
        for name, values in sums.items()
    }


def from_plain(content: Mapping[str, Any]) -> Sums:
    """The sums that `plain` returned."""
    found = {}
    for name, values in content.items():
        if name.startswith("histogram "):
            found[name] = np.zeros(BINS, np.int64)
            found[name][values[0]] = values[1]
        else:
            found[name] = np.array(values)
    return found
