"""The figures of a comparison: of many recordings the worst, the median and the best have floor plans."""

from pathlib import Path

import numpy as np
import polars as pl

from experiments.plots import comparison
from experiments.reports.runs import TrackRun
from trackers.core.rig import Rig
from trackers.paired_differences import errors_by_track
from trackers.recordings.association import associate_truth
from trackers.recordings.folder import RecordingFolder
from trackers.scoring import score

T = 0.1 * np.arange(30)


def small_run(name, shifts):
    """A run whose error in x is that of each recording."""
    at = {"tag": "1", "t_s": T, "x_m": T, "y_m": T**2, "z_m": 1.0}
    truth = pl.DataFrame(at)
    folders = {key: RecordingFolder(key, None, Rig(key), {"truth": truth}) for key in shifts}
    spread = {"std_x_m": 0.1, "std_y_m": 0.1, "std_z_m": 0.0, "cov_xy_m2": 0.0, "nis": 1.0, "nis_dof": 1.0}
    table = pl.concat(
        [pl.DataFrame({"recording": key} | at | spread).with_columns(pl.col("x_m") + s) for key, s in shifts.items()]
    )
    association = associate_truth(table, dict.fromkeys(shifts, truth))
    return TrackRun(name, Path(name), False, {}, folders, association, errors_by_track(association, score(association)))


def test_floor_plans_are_of_the_worst_the_median_and_the_best_by_the_first_run(monkeypatch, tmp_path):
    first = small_run("uwb", {"a": 0.2, "b": 0.9, "c": 0.1, "d": 0.5, "e": 0.3})
    second = small_run("median", {"b": 0.1, "c": 0.8, "d": 0.7, "e": 0.6, "a": 0.5})
    drawn = []
    monkeypatch.setattr(comparison, "_plan", lambda axes, run, name, colour, why: drawn.append((run.name, name, why)))
    comparison.plot_comparison(tmp_path / "page.html", [first, second], [], "png")
    assert [name for run, name, _ in drawn if run == "uwb"] == ["b", "e", "c"]
    assert drawn[0] == ("uwb", "b", "worst of 5, RMSE 90 cm by uwb")
    assert drawn[1][:2] == ("median", "b")


def test_few_recordings_all_have_floor_plans():
    assert comparison._planned([small_run("uwb", {"a": 0.2, "b": 0.9})]) == {"a": "", "b": ""}
