"""The folds over real recordings: what they may see, how they are judged, and the page."""

import re

import numpy as np
import polars as pl
import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation.folds import (
    BY_DEFAULTS,
    FOLDS,
    OTHER_HALF,
    OTHERS,
    Figures,
    Fold,
    Outside,
    farthest_outside,
    room,
)
from trackwright.experiments.lab.validation.real_recordings import all_checks, quoted, real_recordings, tables
from trackwright.trackers.catalogue import tracker_for
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.tuning.calibrating import halves

INSIDE = Outside(0.0, 0.1, 1.0, 0)
HONEST = {"rmse_m": 0.2, "rmse_3d_m": 0.3, "coverage_95": 0.95, "coverage_95_3d": 0.95, "nees_ratio": 1.0}
HONEST |= {"nis_correlation_1s": 0.0, "nis_inflation_1s": 1.0, "nis_ratio": 1.0, "losses": 0}
FOLD = Fold("flights", "uwb", ("a", "b"), BY_DEFAULTS, rmse=0.25, spatial=0.5)


def _figures(recording, outside=INSIDE, smoothed=False, **metrics):
    return Figures(FOLD, recording, smoothed, HONEST | metrics, outside)


def _missed(*figures):
    return [(check.what, check.recording, check.smoothed) for check in all_checks(figures) if not check.met]


@pytest.mark.parametrize("fold", FOLDS, ids=lambda fold: fold.name)
def test_no_fold_is_calibrated_or_tuned_on_what_it_judges(fold):
    assert not set(fold.judged) & {*fold.calibrated_on, *fold.tuned_on}
    assert fold.calibrated_on != OTHERS or len(fold.judged) > 1


def test_each_half_of_a_recording_has_its_own_rows_and_name():
    times = np.arange(10.0)
    ranges = pl.DataFrame({"t_s": np.arange(0.0, 12.0, 0.5), "range_m": 1.0})
    folder = RecordingFolder("hall", None, Rig("hall"), {"truth": pl.DataFrame({"t_s": times}), "ranges": ranges})
    first, second = halves(folder)
    assert first.name != second.name
    assert first.tables["truth"]["t_s"].to_list() == [0, 1, 2, 3, 4]
    assert second.tables["truth"]["t_s"].to_list() == [5, 6, 7, 8, 9]
    # Ranges after the last true position are the second half's.
    assert pl.concat([first.tables["ranges"], second.tables["ranges"]]).equals(ranges)


def test_limits_of_errors_are_of_means_and_those_of_covariances_of_each_recording():
    assert _missed(_figures("a", rmse_m=0.1), _figures("b", rmse_m=0.39)) == []
    assert _missed(_figures("a", rmse_m=0.1), _figures("b", rmse_m=0.41)) == [("RMSE", "", False)]
    assert _missed(_figures("a", nees_ratio=0.1), _figures("b", nees_ratio=1.9)) == [("NEES/dof", "a", False)]
    assert _missed(_figures("a"), _figures("b", coverage_95=1.0)) == [("share inside 95 %", "b", False)]
    smoothed = _figures("a", smoothed=True, coverage_95=0.8, rmse_m=9.0)
    assert _missed(_figures("a"), smoothed) == [("share inside 95 %", "a", True)]


def test_figures_are_compared_as_the_page_shows_them():
    assert _missed(_figures("a", rmse_m=0.25049, coverage_95=0.9904, nees_ratio=2.0049)) == []
    assert len(_missed(_figures("a", rmse_m=0.2506, coverage_95=0.9906, nees_ratio=2.006))) == 3


def test_an_error_without_a_figure_misses_its_limit():
    assert ("RMSE", "", False) in _missed(_figures("a", rmse_m=float("nan")))


def test_the_estimate_farthest_outside_the_room_is_found_by_its_straight_distance():
    rig = Rig("hall", anchors={"1": np.array([0.0, 0.0, 2.0]), "2": np.array([4.0, 1.0, 2.0])})
    truth = pl.DataFrame({"t_s": [0.0, 1.0, 2.0], "x_m": [1.0, 2.0, None], "y_m": [-1.0, 3.0, None]})
    corners = room(RecordingFolder("hall", None, rig, {"truth": truth}))
    np.testing.assert_array_equal(corners, [[0, -1], [4, 3]])
    # Inside, without estimate, 0.5 m left of the room, and 3 m and 4 m beyond its upper right corner.
    estimates = pl.DataFrame({"x_m": [1.0, None, -0.5, 7.0], "y_m": [0.0, None, 0.0, 7.0]})
    estimates = estimates.with_columns(t_s=pl.Series([0.0, 1.0, 2.0, 3.0]), std_x_m=0.2, std_y_m=0.3)
    assert farthest_outside(estimates, corners) == Outside(5.0, 0.3, 3.0, 1)
    assert farthest_outside(estimates[:2], corners).distance == 0.0


def test_the_tables_name_missed_limits_rooms_and_what_was_seen():
    fold = FOLD._replace(calibrated_on=OTHER_HALF)
    figures = [
        _figures("a", nees_ratio=3.0, coverage_95=0.6, nis_ratio=4.0)._replace(fold=fold),
        _figures("b", Outside(1.5, 0.1, 2.0, 7))._replace(fold=fold),
    ]
    summary, flights, rooms = tables(figures, {"a": 0.123})
    assert summary.note == "**5 of 8 limits are met.**"
    assert tuple(summary.rows[0].values()) == ("flights", "0.200 (≤ 0.25)", "", "0.300 (≤ 0.5)", "**1 of 2**", "")
    cells = ("filtered", "0.200", "0.300", "**60.0 %**", "**3.00**", "0.00", "0.123")
    assert tuple(flights.rows[0].values()) == ("a", *cells)
    assert tuple(rooms.rows[1].values()) == ("b", "flights", "**1.50**", "2.0", "0.10", "7")
    assert "each calibrated on the other half. Limits: inside 95 %: 85 to 99 %, NEES/dof 0.5 to 2." in flights.note
    assert "- a: The readings scatter more than the tracker's model expects (NIS/dof 4, 1 expected" in flights.note


def test_the_readme_quotes_mean_errors_of_walks_and_how_many_covariances_hold():
    walks, calibrated = FOLD._replace(name="walks"), FOLD._replace(name="walks, calibrated")
    text = quoted(
        [
            _figures("a", rmse_m=0.8)._replace(fold=walks),
            _figures("b", rmse_m=0.6, nees_ratio=3.0)._replace(fold=walks),
            _figures("a", rmse_m=0.5)._replace(fold=calibrated),
            _figures("a", rmse_m=0.3, smoothed=True)._replace(fold=calibrated),
        ]
    )
    text = " ".join(text.split())
    assert "0.70 m with default noise levels, 0.50 m (0.30 m smoothed)" in text
    assert "on target in 2 of 3 recordings (1 of 1 smoothed)" in text


@pytest.mark.slow
def test_the_quick_folds_write_their_page(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(recordings))
    page = tmp_path / "page.md"
    page.write_text("<!-- tables of trackwright.experiments.lab.validation real-recordings -->\n", "utf-8")
    code = real_recordings(output=Output(small=True, page=page, out=tmp_path / "figures.json"))
    missed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("missed: ")]
    assert code == int(bool(missed))
    met, every = map(int, re.search(r"(\d+) of (\d+) limits are met", page.read_text("utf-8")).groups())
    assert every - met == len(missed)
    # The default levels miss the limit of the walks, 0.80 m, by 2 mm; no other mean error of a filter misses its limit.
    assert [line for line in missed if "RMSE" in line and "smoothed" not in line] == [
        "missed: walks: RMSE 0.802, limit ≤ 0.8"
    ]


@pytest.mark.slow
def test_no_estimate_is_more_than_a_metre_outside_the_room_of_a_real_recording(recordings):
    folders = [read_recording(path.parent) for path in sorted(recordings.glob("*/rig.toml"))]
    tracked = 0
    for folder in folders:
        estimates = tracker_for(folder).run(folder).to_polars()
        if "x_m" in estimates.columns:
            tracked += 1
            assert farthest_outside(estimates, room(folder)).rows == 0, folder.name
    assert tracked >= 20
