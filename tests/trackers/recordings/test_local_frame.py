"""A site in map coordinates is tracked, judged and tuned as the same site at the origin."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.named_tracker import near_origin

MAP = np.array([5e5, 5.4e6])


def _on_the_map(folder):
    """The recording in map coordinates."""
    # Every place is moved by itself, not by the code under test.
    solid, axes = np.append(MAP, 0.0), dict(zip(("x_m", "y_m"), MAP.tolist(), strict=True))
    tables = {
        name: table.with_columns(pl.col(axis) + o for axis, o in axes.items()) if "x_m" in table.columns else table
        for name, table in folder.tables.items()
    }
    rig = folder.rig
    rig = replace(
        rig,
        anchors={name: place + solid for name, place in rig.anchors.items()},
        stations={name: replace(s, position=s.position + solid) for name, s in rig.stations.items()},
        path_knots=None if rig.path_knots is None else rig.path_knots + MAP,
        walls=None if rig.walls is None else rig.walls + np.tile(MAP, 2),
        outline=None if rig.outline is None else rig.outline + MAP,
    )
    return replace(folder, rig=rig, tables=tables)


@pytest.mark.parametrize(("world", "tracker"), [(tw.simulate.ranges, "uwb"), (tw.simulate.agv, "fix-kf")])
def test_a_site_in_map_coordinates_has_the_errors_of_that_at_the_origin(world, tracker):
    here = world(n=2, rows=60, seed=1).folder()
    there = _on_the_map(here)
    with jax.enable_x64(False):
        own = [tw.build(tracker, folder).run(folder) for folder in (here, there)]
    tables = [tracks.table.filter(pl.col("x_m").is_finite()) for tracks in own]
    for axis, origin in zip(("x_m", "y_m"), MAP, strict=True):
        np.testing.assert_allclose(tables[1][axis].to_numpy() - origin, tables[0][axis].to_numpy(), atol=1e-4)
    one, other = (tw.evaluate(tracks, folder) for tracks, folder in zip(own, (here, there), strict=True))
    for metric in ("rmse_m", "nees_ratio", "nis_ratio"):
        assert other[metric] == pytest.approx(one[metric], rel=1e-3), metric


def test_everything_with_a_place_is_about_the_middle_of_the_site_and_recordings_near_zero_stay():
    rig = Rig(
        "hall",
        anchors={"A": np.array([0.0, 0.0, 2.0]), "B": np.array([8.0, 6.0, 2.5])},
        stations={"S": tw.Station(np.array([4.0, 0.0, 1.0]), np.array([1.0, 0, 0, 0]))},
        path_knots=np.array([[1.0, 1.0], [7.0, 5.0]]),
        walls=np.array([[0.0, 0.0, 8.0, 0.0]]),
        outline=np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0]]),
    )
    truth = pl.DataFrame({"t_s": [0.0], "tag": ["1"], "x_m": [2.0], "y_m": [3.0], "z_m": [1.0]})
    # All fixes are in one corner of the hall: the middle is that of the rig.
    fixes = truth.with_columns(x_m=pl.lit(8.0), y_m=pl.lit(6.0))
    folder = tw.RecordingFolder("hall", None, rig, {"truth": truth, "fixes": fixes})
    assert near_origin(folder) is folder
    moved = near_origin(_on_the_map(folder))
    assert moved.origin == (5e5 + 4, 5.4e6 + 3)
    again = moved.rig
    np.testing.assert_allclose([again.anchors["A"], again.anchors["B"]], [[-4, -3, 2], [4, 3, 2.5]])
    np.testing.assert_allclose(again.stations["S"].position, [0, -3, 1])
    np.testing.assert_allclose(again.path_knots, [[-3, -2], [3, 2]])
    np.testing.assert_allclose(again.walls, [[-4, -3, 4, -3]])
    np.testing.assert_allclose(again.outline, [[-4, -3], [4, -3], [4, 3]])
    assert moved.tables["truth"].row(0) == (0.0, "1", -2.0, 0.0, 1.0)
    assert moved.tables["fixes"].row(0) == (0.0, "1", 4.0, 3.0, 1.0)
