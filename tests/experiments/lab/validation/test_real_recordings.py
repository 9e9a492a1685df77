"""The sites of real recordings: what a judged recording may see, which count, and the page."""

import dataclasses
import re

import numpy as np
import polars as pl
import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation import real_recordings as page
from trackwright.experiments.lab.validation import sites
from trackwright.experiments.lab.validation.sites import (
    CALIBRATED,
    DEFAULTS,
    OTHER_HALF,
    OTHER_SITES,
    Errors,
    Judged,
    Outside,
    Site,
    farthest_outside,
    judged,
    recorded,
    room,
    same_installation,
)
from trackwright.sim import worlds
from trackwright.trackers.catalogue import tracker_for
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.tuning.calibrating import halves

INSIDE = Outside(0.0, 0.1, 1.0, 0)
HONEST = {"rmse_m": 0.2, "rmse_3d_m": 0.3, "coverage_95": 0.95, "coverage_95_3d": 0.95, "nees_ratio": 1.0}
HONEST |= {"nis_correlation_1s": 0.0, "coverage_50": 0.5, "coverage_68": 0.7, "coverage_90": 0.9, "coverage_99": 1.0}
SITE = Site("flights", "uwb", "flight-*", Errors(0.25, 0.5), Errors(0.15, smoothed=0.12))


def _judged(recording, setting=DEFAULTS, smoothed=False, outside=INSIDE, counted=True, site=SITE, **metrics):
    return Judged(site, setting, recording, smoothed, HONEST | metrics, outside, (), counted)


def _missed(*every):
    return [check.what.rstrip(",") for check in page.checks(every) if not check.met]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two simulated recordings of one hall, one of a hall whose anchors were moved, and one whose tag stays in place."""
    there = tmp_path_factory.mktemp("sites")
    first = worlds.ranges(n=1, seed=1, rows=150).folder()
    second = worlds.ranges(n=1, seed=2, rows=150).folder()
    away = {name: np.asarray(place) + [0.0, 0.5, 0.0] for name, place in first.rig.anchors.items()}
    truth = first.tables["truth"].with_columns(x_m=pl.lit(1.0), y_m=pl.lit(1.0))
    moved = dataclasses.replace(first, rig=dataclasses.replace(first.rig, anchors=away))
    still = dataclasses.replace(first, tables={**first.tables, "truth": truth})
    for name, folder in (("hall-1", first), ("hall-2", second), ("hall-3", moved), ("hall-4", still)):
        rig = dataclasses.replace(folder.rig, name=name)
        write_recording(dataclasses.replace(folder, name=name, rig=rig), there / name)
    return there


@pytest.mark.slow
def test_a_recording_is_calibrated_on_the_others_of_its_installation_alone(root, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(root))
    monkeypatch.setattr(sites, "SEEN_BY_DEFAULTS", {"uwb": ("hall-2",)})
    monkeypatch.setattr(sites, "left_out_levels", lambda tracker, name: {"sigma_r": 0.5} if name == "hall-2" else {})
    every = list(judged(Site("hall", "uwb", "hall-*")))
    assert [one.smoothed for one in every] == 7 * [False, True]
    assert {(one.recording, one.setting.name, one.on): one.counted for one in every} == {
        # The default levels have seen its site.
        ("hall-1", "defaults", ()): False,
        ("hall-1", "calibrated", ("hall-2", "hall-4")): True,
        ("hall-2", "defaults", ()): False,
        ("hall-2", "defaults", OTHER_SITES): True,
        ("hall-2", "calibrated", ("hall-1", "hall-4")): True,
        ("hall-3", "defaults", ()): False,
        ("hall-3", "calibrated", OTHER_HALF): False,
    }
    levels = {one.on: one.metrics["nees_ratio"] for one in every if (one.recording, one.smoothed) == ("hall-2", False)}
    assert levels[OTHER_SITES] < 0.5 * levels[()]


def test_recordings_are_found_by_pattern_or_by_name(root, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(root))
    assert [folder.name for folder in recorded("hall-[12]")] == ["hall-1", "hall-2"]
    assert [folder.name for folder in recorded(("hall-2",))] == ["hall-2"]
    assert recorded("none-*") == []
    one, other = recorded(("hall-1", "hall-3"))
    assert same_installation(one, one)
    assert not same_installation(one, other)


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


def test_limits_of_errors_are_of_each_recording_or_of_the_mean_over_a_site():
    assert _missed(_judged("a", rmse_m=0.1), _judged("b", rmse_m=0.39)) == ["b: RMSE, defaults"]
    assert _missed(_judged("a", rmse_3d_m=0.51)) == ["a: 3-D RMSE, defaults"]
    walks = SITE._replace(mean=True)
    assert _missed(_judged("a", site=walks, rmse_m=0.1), _judged("b", site=walks, rmse_m=0.39)) == []
    # Recordings of one site are judged one after another in both settings.
    between = _judged("a", CALIBRATED, site=walks, rmse_m=0.1)
    assert _missed(_judged("a", site=walks, rmse_m=0.1), between, _judged("b", site=walks, rmse_m=0.42)) == [
        "mean of flights: RMSE, defaults"
    ]
    # A recording that is calibrated on its other half has no limits.
    assert _missed(_judged("a", CALIBRATED, counted=False, rmse_m=9.0)) == []
    assert _missed(_judged("a", CALIBRATED, rmse_m=0.15), _judged("a", CALIBRATED, smoothed=True, rmse_m=0.16)) == [
        "a: RMSE, calibrated, smoothed", "a: RMSE, calibrated, smoothed"
    ]  # fmt: skip


def test_covariances_are_judged_by_the_share_of_recordings_within_limits():
    good = [_judged(name) for name in "abcd"]
    assert _missed(*good, _judged("e", nees_ratio=2.1)) == []
    share = "share of recordings within limits, defaults, filtered"
    assert _missed(*good[:3], _judged("e", nees_ratio=2.1)) == [share]
    # As they are shown: 99.04 % and 2.004 are within limits of 99 % and 2.
    assert _missed(_judged("a", coverage_95=0.9904, nees_ratio=2.004)) == []
    assert _missed(_judged("a", coverage_95=0.9906)) == [share]
    # What does not count is shown and not judged.
    assert _missed(*good, _judged("e", counted=False, nees_ratio=9.0)) == []


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


def test_the_page_gives_each_recording_a_verdict_and_no_mean_of_shares():
    every = [
        _judged("a", nees_ratio=3.0, coverage_95=0.6),
        _judged("b", coverage_95=1.0),
        _judged("a", CALIBRATED, counted=False, rmse_m=0.1)._replace(on=OTHER_HALF),
        _judged("b", CALIBRATED, outside=Outside(1.5, 0.1, 2.0, 7), rmse_m=0.1),
    ]
    summary, missed, flights, rooms = page.tables(every, {"a": 0.123})
    assert [row["within limits"] for row in summary.rows] == ["0 of 2", "0 of 0", "1 of 1", "0 of 0"]
    assert [row["not counted"] for row in summary.rows] == ["", "", "1 of 1", ""]
    assert missed.rows == []
    assert [row["covariances"] for row in flights.rows] == [
        "**too small**", "**too large**", "(within limits)", "within limits"
    ]  # fmt: skip
    assert [row["setting"] for row in flights.rows] == ["defaults", "defaults", "on the other half", "calibrated"]
    assert [row["baseline"] for row in flights.rows] == ["0.123", "–", "0.123", "–"]
    cells = ("b", "uwb, calibrated", "**1.50**", "2.0", "0.10", "7")
    assert [tuple(row.values()) for row in rooms.rows] == [cells]


def test_the_readme_quotes_mean_errors_of_walks_and_how_many_covariances_hold():
    walks = SITE._replace(name="walks", mean=True)
    every = [
        _judged("a", site=walks, rmse_m=0.8),
        _judged("b", site=walks, rmse_m=0.6, nees_ratio=3.0),
        _judged("a", CALIBRATED, site=walks, rmse_m=0.5),
        _judged("a", CALIBRATED, True, site=walks, rmse_m=0.3),
    ]
    text = " ".join(page.quoted(every).split())
    assert "0.70 m with default noise levels, 0.50 m (0.30 m smoothed)" in text
    assert "within limits in 1 of 2 recordings with default levels" in text
    assert "in 1 of 1 calibrated on other recordings of the site (1 of 1 smoothed)" in text


@pytest.mark.parametrize(("at_least", "code"), [(0.5, 0), (0.6, 1), (None, 1)])
def test_a_release_is_refused_below_a_stated_share_within_limits(tmp_path, monkeypatch, capsys, at_least, code):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(tmp_path))
    every = [_judged("a"), _judged("b", nees_ratio=3.0), _judged("c", counted=False)]
    monkeypatch.setattr(page, "judged", lambda site: every if site.name == "walks" else [])
    assert page.real_recordings(at_least=at_least, output=Output(out=tmp_path / "figures.json")) == code
    assert ("1 of 2 within limits, defaults, filtered" in capsys.readouterr().out) == (at_least is not None)


def test_the_picture_has_a_line_for_each_recording(tmp_path):
    path = tmp_path / "curves.png"
    page.plot_curves(path, [_judged("a"), _judged("b", CALIBRATED, nees_ratio=9.0), _judged("c", counted=False)])
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_quick_sites_write_their_page(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(recordings))
    written = tmp_path / "page.md"
    written.write_text("<!-- tables of trackwright.experiments.lab.validation real-recordings -->\n", "utf-8")
    code = page.real_recordings(output=Output(small=True, page=written, out=tmp_path / "figures.json"))
    missed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("missed: ")]
    assert code == int(bool(missed))
    met, every = map(int, re.search(r"(\d+) of (\d+) limits are met", written.read_text("utf-8")).groups())
    assert every - met == len(missed)


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
