"""The numbers with which mistakes in a simulated hall are named: places, clocks and frames."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.optimize import least_squares

from tests.trackers.recordings.checks.made import ANCHORS, AXES, hall, height, only, with_anchors, with_columns
from trackwright.trackers.exchange.truth_frame import parsed_placement
from trackwright.trackers.recordings.checks import closing
from trackwright.trackers.recordings.checks.all_checks import quick_check
from trackwright.trackers.recordings.checks.closing import moments


def test_a_wrong_place_of_an_anchor_is_corrected_to_the_side_on_which_rig_toml_has_it():
    (error,) = quick_check(with_anchors(lambda _: {"A4": np.array([12.0, 3.0, 2.7])})(hall()))
    place = [float(x) for x in error.message.partition("at (")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, ANCHORS["A4"], atol=0.4)


def test_a_truth_somewhat_late_is_a_warning_with_the_option_that_shifts_it():
    for table, late in (("ranges", 0.35), ("ranges", -0.25), ("bearings", 0.35)):
        (warning,) = quick_check(with_columns("truth", t_s=pl.col("t_s") + late)(only(table, "truth")(hall())))
        assert (warning.level, warning.where) == ("warning", table)
        assert "again with --align-truth, or --transform 0.000,0.000,0.000,0.000," in warning.message
        assert float(warning.message.rpartition(",")[2]) == pytest.approx(-late, abs=0.03)


@pytest.mark.parametrize("turn", [(0.8, 0.6), (1.0, 0.0)])
def test_a_truth_in_another_frame_and_late_is_named_with_the_numbers_that_bring_it_over(turn):
    x, y, (c, s) = pl.col("x_m"), pl.col("y_m"), turn
    moved = with_columns("truth", x_m=c * x - s * y + 50.0, y_m=s * x + c * y, t_s=pl.col("t_s") + 0.35)
    folder = moved(only("ranges", "truth")(hall()))
    (error,) = quick_check(folder)
    placement = parsed_placement(error.message.rpartition(" ")[2])
    assert placement.later == pytest.approx(-0.35, abs=0.02)
    truth = placement.of_table(folder.tables["truth"])
    assert quick_check(replace(folder, tables={**folder.tables, "truth": truth})) == []


def test_fixes_late_by_the_delay_of_their_filter_are_no_mistake_and_early_ones_are():
    truth = hall().tables["truth"]
    for late, levels in ((0.4, []), (-0.4, ["warning"])):
        fixes = truth.with_columns(t_s=pl.col("t_s") + late)
        assert [one.level for one in quick_check(replace(hall(), tables={"fixes": fixes, "truth": truth}))] == levels


def test_changes_that_explain_contradictions_alike_have_the_causes_of_all(monkeypatch):
    changes, swapped = closing._changes, with_anchors(lambda anchors: {"A2": anchors["A4"], "A4": anchors["A2"]})
    monkeypatch.setattr(
        closing,
        "_changes",
        lambda found: [(words, cause, one) for words, _, one in changes(found) for cause in ("one cause", "another")],
    )
    (error,) = quick_check(swapped(only("ranges")(hall())))
    assert error.message.endswith(": another; or one cause")


@pytest.mark.parametrize(("name", "tall"), [("A1", 1.1), ("A2", None), ("A4", None), ("A5", 1.1)])
def test_an_anchor_that_stands_elsewhere_is_named_without_truth(name, tall):
    # Across the line of sight a shift hardly changes a range.
    away = np.array(ANCHORS[name]) - np.array([6.0, 4.0, 2.7])
    moved = np.array(ANCHORS[name]) + 1.2 * away / np.linalg.norm(away)
    (found,) = quick_check(with_anchors(lambda _: {name: moved})(height(tall)(only("ranges")(hall()))))
    assert found.level == "warning"
    assert ": its place in rig.toml is wrong" in found.message
    where = re.search(rf"anchor {name} 1\.\d m elsewhere, at \((\S+), (\S+), ", found.message)
    if where:
        np.testing.assert_allclose([float(where[1]), float(where[2])], ANCHORS[name][:2], atol=0.2)
    else:
        # The walk does not see where it is.
        assert f"without anchor {name}:" in found.message


def test_the_place_that_fits_best_is_that_of_least_squares_over_all_positions():
    # Weights of moments are nearly alike where only noise is left.
    folder = with_anchors(lambda _: {"A2": np.array([6.9, -0.8, 2.4])})(only("ranges")(hall()))
    found = moments(folder, "ranges")
    place = closing.moved(found, 1)
    at = found.fitted()[0]

    def errors(x):
        places = found.places.copy()
        places[1] = x[-3:]
        flat = np.column_stack([x[:-3].reshape(-1, 2), np.full(len(at), 1.1)])
        return (np.linalg.norm(flat[:, None] - places, axis=2) - found.values[..., 0]).ravel()

    best = least_squares(errors, np.append(at[:, :2].ravel(), found.places[1])).x[-3:]
    np.testing.assert_allclose(place[:2], best[:2], atol=0.1)


def test_anchors_at_one_place_explain_nothing():
    assert moments(with_anchors(lambda anchors: dict.fromkeys(anchors, np.ones(3)))(hall()), "ranges") is None


def test_ranges_close_to_zero_where_they_are_exact_and_bearings_likewise():
    folder = hall()
    truth = folder.tables["truth"].select(*AXES).to_numpy()
    t = folder.tables["truth"]["t_s"].to_numpy()
    for table, noun, names in (("ranges", "anchor", ANCHORS), ("bearings", "station", folder.rig.stations)):
        rows = []
        for name in names:
            head = {"t_s": t, "tag": "T", noun: name}
            if table == "ranges":
                rows.append(pl.DataFrame(head | {"range_m": np.linalg.norm(truth - ANCHORS[name], axis=1)}))
            else:
                azimuth, elevation = np.asarray(folder.rig.stations[name].angles(truth)).T
                rows.append(pl.DataFrame(head | {"azimuth_rad": azimuth, "elevation_rad": elevation}))
        exact = replace(height(None)(folder), tables={table: pl.concat(rows).sort("t_s")})
        assert moments(exact, table).closing() < 2e-3
