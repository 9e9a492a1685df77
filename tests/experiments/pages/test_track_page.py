"""The data of the page of `track`: what it holds is what the tables hold."""

import base64
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.experiments.pages.small_tracks import TAGS, small_bearings, small_tracks
from trackwright.experiments.pages.scored_tracks import ScoredTracks, drawn_of
from trackwright.experiments.pages.track import drawn_rows, drawn_tracks, run_data
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.columns import float_column


def _unpacked(recording):
    """The columns of a recording of the page."""
    packed = recording["columns"].items()
    return {name: np.frombuffer(base64.b64decode(of["bdata"]), "<" + of["dtype"]) for name, of in packed}


@pytest.fixture(scope="module")
def tracks():
    return small_tracks()


def test_columns_tracks_and_events_are_those_of_the_tables(tracks):
    rows = tracks.rows.with_row_index("row")
    last = rows.filter((pl.col("tag") == "B") & (pl.col("t_s") <= 5.0))["row"][-1]
    rows = rows.with_columns(losses=(pl.col("row") == last).cast(pl.Int64)).drop("row")
    (recording,) = run_data(ScoredTracks(rows, tracks.folders, []), None, "uwb")["recordings"]
    columns = _unpacked(recording)
    assert recording["rows"] == recording["drawn"] == len(rows)
    for name, column in (("v0", "x_m"), ("v1", "y_m"), ("s0", "std_x_m"), ("nis", "nis")):
        np.testing.assert_allclose(columns[name], float_column(rows, column), rtol=1e-6)
    np.testing.assert_allclose(recording["start"] + columns["t"], float_column(rows, "t_s"), rtol=1e-6)
    errors, scored = float_column(rows, "x_m") - float_column(rows, "true_x_m"), rows["why"].is_null().to_numpy()
    np.testing.assert_allclose(columns["e0"][scored], errors[scored], rtol=1e-4, atol=1e-6)
    assert np.isnan(columns["e0"][~scored]).all()
    assert {track["tag"] for track in recording["tracks"]} == set(TAGS)
    (event,) = recording["events"]
    assert recording["tracks"][event["track"]]["tag"] == "B"
    assert recording["start"] + event["t"] == pytest.approx(5.0)


def test_the_rig_is_drawn_where_the_estimates_are(tracks):
    """Of map coordinates, walls, anchors and path are shifted by the origin of the page as positions are."""
    (folder,) = tracks.folders
    east = np.array([4e5, 5e6])
    walls, path = np.array([[1.0, 2.0, 5.0, 2.5]]) + np.tile(east, 2), np.array([[0.0, 1.0], [9.0, 7.0]]) + east
    anchors = {name: place + [*east, 0.0] for name, place in folder.rig.anchors.items()}
    moved = replace(folder, rig=replace(folder.rig, anchors=anchors, walls=walls, path_knots=path))
    places = [(pl.col(f"{a}_m") + by).alias(f"{a}_m") for a, by in zip("xy", east, strict=True)]
    rows = scored_rows(tracks.rows.with_columns(places), {"hall": folder.tables["truth"].with_columns(places)})
    (drawn,) = run_data(ScoredTracks(rows, [moved], []), None, "uwb")["recordings"]
    origin = np.array(drawn["origin"])
    assert np.all(origin > 1e5)
    np.testing.assert_allclose(np.array(drawn["rig"]["walls"]).reshape(-1, 2) + origin, walls.reshape(-1, 2))
    np.testing.assert_allclose(np.array(drawn["rig"]["path"]) + origin, path)
    for anchor in drawn["rig"]["anchors"]:
        np.testing.assert_allclose(np.array(anchor["at"][:2]) + origin, anchors[anchor["name"]][:2])


def test_of_many_rows_and_tracks_ends_peaks_and_ranks_are_drawn():
    lengths, weight = np.array([500, 7, 1000]), np.random.default_rng(2).random(1507)
    weight[[123, 1200]] = 9.0
    drawn = drawn_rows(lengths, weight, 200)
    assert 100 < len(drawn) <= 230
    assert {0, 499, 500, 506, 507, 1506, 123, 1200} <= set(drawn.tolist())
    assert np.all(np.diff(drawn) > 0)
    np.testing.assert_array_equal(drawn_rows(lengths, weight, 2000), np.arange(1507))
    order = [int(k) for k in np.random.default_rng(3).permutation(101)]
    chosen = drawn_tracks(order, 11)
    assert len(chosen) == 11
    assert {order[0], order[50], order[100]} <= set(chosen)


@pytest.mark.parametrize("in_plane", [True, False])
def test_directions_are_in_degrees_and_one_in_an_arrays_plane_is_one_angle(in_plane):
    tracks, estimate, true = small_bearings(in_plane)
    run = run_data(tracks, Evaluation.of(tracks.rows), "das")
    (recording,) = run["recordings"]
    columns = _unpacked(recording)
    assert [axis["name"] for axis in recording["axes"]] == (
        ["in-plane angle"] if in_plane else ["azimuth", "elevation"]
    )
    for k in range(len(recording["axes"])):
        turn = np.abs(columns[f"v{k}"] - estimate[:, k]) % 360
        np.testing.assert_allclose(np.minimum(turn, 360 - turn), 0, atol=1e-3)
        np.testing.assert_allclose(columns[f"e{k}"], (estimate - true)[:, k], atol=1e-3)
    # the angle between two directions is about the error of the elevation and that of the azimuth on its circle
    flat = np.hypot((estimate - true)[:, 0] * np.cos(np.radians(true[:, 1])), (estimate - true)[:, 1])
    np.testing.assert_allclose(columns["miss"], flat, rtol=0.05, atol=1e-3)
    rmse = np.sqrt(np.mean(columns["miss"] ** 2))
    assert recording["tracks"][0]["rmse"] == pytest.approx(rmse, rel=1e-3)
    for line in run["metrics"]:
        assert np.degrees(line["rmse_direction_rad"]) == pytest.approx(rmse, rel=1e-3)


@pytest.mark.slow
def test_the_band_of_nis_is_that_of_the_tracker_s_noise_and_empty_without_a_tracker():
    folder = tw.simulate.ranges(n=2, seed=1, rows=20).folder()
    tracks = tw.build("uwb", folder).run(folder)
    bands = []
    for batches in (tracks.batches, ()):
        scored = ScoredTracks(scored_rows(tracks.table, {folder.name: folder.tables["truth"]}), [folder], batches)
        bands.append(run_data(scored, None, "uwb")["recordings"][0]["nisBand"])
    # The NIS of four ranges with Student's t of 1.8 degrees of freedom; with normal noise it ends at 2.79.
    assert bands[0] == pytest.approx([0.25, 1.91], abs=0.06)
    assert bands[1] == []


def test_of_many_recordings_the_worst_the_median_and_the_best_have_figures():
    rmse = np.array([0.2, np.nan, 0.05, 0.9, 0.4, 0.3])
    assert drawn_of(rmse) == [3, 5, 2]
    assert drawn_of(rmse[:4]) == drawn_of(np.full(9, np.nan)) == [0, 1, 2, 3]
