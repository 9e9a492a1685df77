"""Why a recording got worse: the reason that its truth shows, and no other."""

import numpy as np
import polars as pl
import pytest
from scipy.stats import multivariate_normal

from trackwright.experiments.pages.reports.verdict import judge
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.association import associate_truth
from trackwright.trackers.recordings.folder import RecordingFolder

ANCHORS = {name: np.array(place) for name, place in
           {"A": (0.0, 0.0, 2.5), "B": (9.0, 0.0, 2.4), "C": (9.0, 7.0, 2.6), "D": (0.0, 7.0, 2.5)}.items()}  # fmt: skip


def _hall(name, rate=0.1, bias=0.0, seconds=60.0):
    """Ranges of a tag on a circle of 2 m, `rate` rad/s, and truth; those of anchor C are `bias` m too long."""
    t = np.arange(0.0, seconds, 0.25)
    place = np.stack([4.0 + 2.0 * np.cos(rate * t), 3.0 + 2.0 * np.sin(rate * t), np.full(len(t), 1.1)], axis=1)
    ranges = [
        pl.DataFrame(
            {"t_s": t, "tag": "7", "anchor": k, "range_m": np.linalg.norm(place - at, axis=1) + bias * (k == "C")}
        )
        for k, at in ANCHORS.items()
    ]
    truth = pl.DataFrame({"t_s": t, "tag": "7"} | {f"{a}_m": place[:, k] for k, a in enumerate("xyz")})
    rig = Rig(name, anchors=ANCHORS)
    return RecordingFolder(name, None, rig, {"ranges": pl.concat(ranges).sort("t_s"), "truth": truth})


def _tracks(folders, sigma, off=0.1, mirrored=False):
    """Estimates `off` m along x that report a standard deviation of `sigma` m."""
    rows = []
    for folder in folders:
        truth = folder.tables["truth"]
        height = -pl.col("z_m") + 5.0 if mirrored else pl.col("z_m")
        noise = np.random.default_rng(1).normal(size=len(truth)) * 0.02
        rows.append(truth.with_columns(pl.col("x_m") + off + noise, height, recording=pl.lit(folder.name)))
        rows[-1] = rows[-1].with_columns(**{f"std_{a}_m": pl.lit(sigma) for a in "xyz"})
    return associate_truth(pl.concat(rows), {folder.name: folder.tables["truth"] for folder in folders})


REASONS = {
    "ranges of anchor C have a median error of +0.40 m, in the others +0.00 m": ({"bias": 0.4}, {}),
    "its tag accelerates with 0.32 m/s² (RMS over 1 s), those of the others with 0.02": ({"rate": 0.4}, {}),
    "it lasts 300 s, and the others together only 120 s": ({"seconds": 300.0}, {}),
    "its height is mirrored in the anchors' plane in 100 % of the rows": ({}, {"mirrored": True}),
    "its truth shows no difference in motion, anchors, height or length": ({}, {}),
}


@pytest.mark.parametrize("reason", REASONS)
def test_the_reason_is_the_one_that_its_truth_shows(reason):
    changed, tracked = REASONS[reason]
    folders = [_hall("hall-1"), _hall("hall-2"), _hall("odd", **changed)]
    before, after = _tracks(folders, 0.1), _tracks(folders, 0.03, **tracked)
    verdict = judge((before, after), folders, 2)
    assert verdict.word == "worse"
    assert verdict.worse["odd"].startswith(reason)
    assert verdict.worse["odd"].count(";") == 0


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_log_density_is_that_of_scipy(dimensions):
    folders = [_hall("hall-1")]
    sides = [_tracks(folders, sigma) for sigma in (0.1, 0.2)]
    verdict = judge(sides, folders, dimensions)
    for side, sigma, found in zip(sides, (0.1, 0.2), (verdict.change.first, verdict.change.second), strict=True):
        errors = side.rows.select("x_m", "y_m", "z_m").to_numpy() - side.truth
        expected = multivariate_normal(np.zeros(dimensions), sigma**2 * np.eye(dimensions)).logpdf(
            errors[:, :dimensions]
        )
        assert found == pytest.approx(expected.mean(), rel=1e-9)
