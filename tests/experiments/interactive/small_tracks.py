"""Estimates of three tags with errors that are known, without a tracker."""

from __future__ import annotations

import numpy as np
import polars as pl

from experiments.scored_tracks import ScoredTracks
from trackers.core.rig import Rig
from trackers.recordings.association import associate_truth
from trackers.recordings.folder import RecordingFolder

NASTY = "<script>document.title = 'stolen'</script>"
TAGS = ("A", "B", NASTY)
ANCHORS = {"1": (0.0, 0.0, 2.0), "2": (10.0, 0.0, 2.0), "10": (10.0, 8.0, 2.0), "11": (10.05, 8.0, 1.0)}
BIAS = 0.25
"""Bias of the ranges to anchor 2, m."""


def small_tracks(rows: int = 80, tags: tuple[str, ...] = TAGS, seed: int = 1) -> ScoredTracks:
    """Tracks whose errors are normal with the reported covariance, twice as large for each further tag."""
    rng = np.random.default_rng(seed)
    times = 3.0 + 0.1 * np.arange(rows)
    estimates, truths, ranges = [], [], []
    for k, tag in enumerate(tags):
        true = np.stack([5 + 3 * np.cos(times / 2 + k), 4 + 2 * np.sin(times / 2 + k), 0 * times + 1], axis=1)
        sigma = 0.05 * 2.0 ** (k % 5)
        error = rng.multivariate_normal([0, 0], sigma**2 * np.array([[1, 0.3], [0.3, 0.5]]), rows)
        at = true + np.pad(error, ((0, 0), (0, 1)))
        key = {"recording": "hall", "tag": tag, "t_s": times}
        position = {f"{a}_m": at[:, i] for i, a in enumerate("xyz")}
        spread = {"std_x_m": sigma, "std_y_m": sigma * np.sqrt(0.5), "std_z_m": 0.0, "cov_xy_m2": 0.3 * sigma**2}
        filtered = {"nis": rng.chisquare(2, rows), "nis_dof": 2.0, "status": ["waiting"] + ["ok"] * (rows - 1)}
        estimates.append(pl.DataFrame(key | position | spread | filtered))
        truths.append(pl.DataFrame({"t_s": times, "tag": tag} | {f"{a}_m": true[:, i] for i, a in enumerate("xyz")}))
        for number, (name, place) in enumerate(ANCHORS.items()):
            own = slice(number, None, len(ANCHORS))
            distance = np.linalg.norm(true[own] - place, axis=1) + 0.02 * rng.normal(size=len(true[own]))
            shifted = distance + (BIAS if name == "2" else 0.0)
            ranges.append(pl.DataFrame({"t_s": times[own], "tag": tag, "anchor": name, "range_m": shifted}))
    tables = {"truth": pl.concat(truths), "ranges": pl.concat(ranges).sort("t_s")}
    rig = Rig("hall", anchors={name: np.array(place) for name, place in ANCHORS.items()})
    folder = RecordingFolder("hall", None, rig, tables)
    return ScoredTracks(associate_truth(pl.concat(estimates), {"hall": tables["truth"]}), [folder], [])
