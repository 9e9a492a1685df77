"""Trackers by name on recording folders, and the same rows from arrays."""

from __future__ import annotations

import dataclasses
import sys

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import UnusableInput


@pytest.fixture(scope="module")
def folders():
    return [dataclasses.replace(tw.simulate.agv(n=2, seed=k, rows=40).folder(), name=f"agv {k}") for k in range(2)]


@pytest.fixture(scope="module")
def tracker(folders):
    return tw.build("fix-kf", folders)


def test_one_recording_or_several_run_by_name_and_give_a_table_of_all_tags(tracker, folders):
    tracks = tracker.run(folders)
    assert tracks.summaries == {"ok": 4}
    assert tracks.to_polars().select("recording", "tag").n_unique() == 4
    alone = tracker.run(folders[0]).table
    # Bit-identical: batches of two and of four trajectories run in chunks of one shape.
    assert tracks.table.filter(pl.col("recording") == "agv 0").drop("recording").equals(alone.drop("recording"))


def test_values_reach_the_tracker_of_every_recording(tracker, folders):
    louder = tracker.with_values({"sensors.fixes.sigma_*": 0.7})
    for batch in louder.batches(folders):
        assert float(tw.tunables(batch.tracker)["sensors.fixes.sigma_horizontal"].value) == pytest.approx(0.7)
    assert float(tracker.tunables["sensors.fixes.sigma_horizontal"].value) != pytest.approx(0.7)
    with pytest.raises(tw.UnusableInput, match=r"mine: this tracker has no 'sensors\.x'"):
        tracker.with_values({"sensors.x": 1.0}, "mine")


def test_smoothing_lowers_the_error_and_a_lag_is_positive(tracker, folders):
    filtered, smoothed = (tw.evaluate(t.run(folders), folders)["rmse_m"] for t in (tracker, tracker.smoothing()))
    assert smoothed < filtered
    with pytest.raises(tw.UnusableInput, match="lag -1: expected seconds above zero"):
        tracker.smoothing(-1)
    with pytest.raises(tw.UnusableInput, match="cannot be smoothed"):
        tw.build("moving-average", folders).smoothing()


def test_a_fit_by_name_returns_the_tracker_by_name_with_other_values(tracker, folders):
    result = tw.fit(
        tracker,
        folders[0],
        "nll",
        tune="sensors.fixes.sigma_horizontal",
        options=tw.FitOptions(steps=3, held_out=folders[1]),
    )
    assert result.value <= result.start_value
    assert isinstance(result.tracker, type(tracker))
    found = float(result.tracker.tunables["sensors.fixes.sigma_horizontal"].value)
    assert found == pytest.approx(float(result.values["sensors.fixes.sigma_horizontal"]))
    with pytest.raises(tw.UnusableInput, match="foo"):
        tw.fit(tracker, folders, "foo")
    with pytest.raises(ValueError, match="fit: found RecordingFolder; expected a Recording, several, or a Batch"):
        tw.fit(tw.fix_tracker(), folders[0], "nll")


def test_fixes_in_arrays_give_the_rows_of_the_folder(folders):
    fixes = folders[0].tables["fixes"].filter(pl.col("tag") == "0")
    (rows, *_) = (t.recording for t in spec_of("fix-kf").trajectories(folders[0], free_height=False) if t.tag == "0")
    mine = tw.fix_recording(fixes["t_s"].to_numpy(), fixes.select("x_m", "y_m", "z_m").to_numpy())
    np.testing.assert_array_equal(mine.readings["fixes"].values, rows.readings["fixes"].values)
    np.testing.assert_array_equal(mine.readings["fixes"].reported, rows.readings["fixes"].reported)


def test_ranges_in_a_matrix_give_the_rows_of_the_folder():
    folder = tw.simulate.ranges(n=1, seed=2, rows=30).folder()
    table = folder.tables["ranges"]
    anchors = sorted(folder.rig.anchors)
    times = np.unique(table["t_s"].to_numpy())
    matrix = np.full((len(times), len(anchors)), np.nan)
    row, column = np.searchsorted(times, table["t_s"].to_numpy()), [anchors.index(a) for a in table["anchor"]]
    matrix[row, column] = table["range_m"].to_numpy()
    places = np.stack([folder.rig.anchors[a] for a in anchors])
    mine = tw.range_recording(times, matrix, places)
    (theirs,) = (t.recording for t in spec_of("uwb").trajectories(folder, free_height=True))
    for name in ("anchors", "anchor", "nearby"):
        np.testing.assert_allclose(mine.inputs[name], theirs.inputs[name], rtol=1e-12)
    np.testing.assert_array_equal(mine.readings["ranges"].values, theirs.readings["ranges"].values)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda t: tw.range_recording(t, np.ones((5, 3)), np.zeros((4, 3))), r"expected \(T, 4\)"),
        (lambda t: tw.range_recording(t, np.ones(5), np.zeros((4, 3)), anchor=np.full(5, 4)), "anchors 0 to 3"),
        (lambda t: tw.fix_recording(t, np.ones((4, 3))), r"expected \(5, n\)"),
        (lambda t: tw.fix_recording(t, np.full((5, 3), np.inf)), "row 0 is infinite"),
        (lambda t: tw.bearing_recording(t, np.ones((5, 2)), ["x"] * 5, {}), "unknown among them: x"),
        (lambda t: tw.phase_recording(t, {"1": np.ones(5)}), r"phases\['1'\] have shape \(5,\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make(np.arange(5.0))


def test_estimates_of_several_recordings_become_one_table_with_their_times():
    rng = np.random.default_rng(1)
    several = [
        tw.fix_recording(np.arange(n) * 0.5, rng.normal(size=(n, 3)), truth=np.zeros((n, 3)), name=f"n = {n}")
        for n in (4, 7)
    ]
    estimates = tw.fix_tracker().run(several)
    table = estimates.to_polars()
    assert table["recording"].to_list() == ["n = 4"] * 4 + ["n = 7"] * 7
    assert table["t_s"].to_list() == [*several[0].times, *several[1].times]
    np.testing.assert_array_equal(table["x_m"].to_numpy()[4:], estimates[1].mean.position[0][:7])
    assert len(tw.evaluate(estimates, several).tracks) == 2
    with pytest.raises(ValueError, match="have no times"):
        tw.fix_tracker().run(tw.stack(several)).to_polars()
    with pytest.raises(ValueError, match="found nothing"):
        tw.fix_tracker().run([])


def test_a_trackers_file_may_import_the_one_beside_it(tmp_path, monkeypatch):
    (tmp_path / "beside_for_test.py").write_text(
        "from trackwright.trackers.catalogue import spec_of\n\nBASE = spec_of('fix-kf')\n"
    )
    (tmp_path / "mine.py").write_text("from beside_for_test import BASE\n\nMINE = BASE\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert spec_of(f"{tmp_path / 'mine.py'}:MINE").table == "fixes"


def test_a_trackers_file_that_fails_is_named_with_its_line_and_a_notebook_as_such(tmp_path):
    path = tmp_path / "mine.py"
    for text, words in (
        ("LEVELS = {}\n\nMINE = LEVELS['sigma']\n", r"\(KeyError in line 3: 'sigma'\); correct the file"),
        ('{"cells": [{"execution_count": null}]}', "it is a notebook: export it as a Python file"),
    ):
        path.write_text(text)
        with pytest.raises(UnusableInput, match=words):
            spec_of(f"{path}:MINE")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            "trajectories=lambda folder, free_height: folder.tables['fix']",
            "trajectories failed (KeyError in line 4: 'f",
        ),
        ("trajectories=lambda folder: []", "trajectories failed (TypeError: <lambda>() takes 1 positional argument"),
        ("planar=lambda trajectory, free_height: trajectory.hight", "planar failed (AttributeError in line 4: "),
        ("build=lambda trajectory, planar: {}[planar]", "build failed (KeyError in line 4: "),
        ("build=lambda t, planar: None", "build returned NoneType; expected a tracker"),
        ("build=lambda t, planar: tw.range_tracker(3)", "found readings of fixes; expected 'ranges'"),
        ("build=lambda t, p: dataclasses.replace(F.build(t, p), motion=None)", "run failed (AttributeError"),
    ],
)
def test_a_tracker_of_ones_own_that_fails_is_refused_in_one_line(folders, tmp_path, monkeypatch, changed, words):
    monkeypatch.setattr(sys, "path", list(sys.path))
    lines = ["import dataclasses", "import trackwright as tw", "F = tw.TRACKERS['fix-kf']"]
    (tmp_path / "mine.py").write_text("\n".join([*lines, f"OWN = dataclasses.replace(F, {changed})"]), "utf-8")
    with pytest.raises(tw.UnusableInput) as refused:
        tw.build(f"{tmp_path / 'mine.py'}:OWN", folders).run(folders)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_tracker_by_name_lists_its_tunables_and_filters_a_folder_as_a_pure_function():
    folder = tw.simulate.ranges(n=2, rows=40, seed=1).folder()
    named = tw.build("uwb", folder)
    assert tw.tunables(named).keys() == named.tunables.keys() != set()
    (batch,) = named.batches(folder)
    rows = tw.stack([trajectory.recording for trajectory in batch.trajectories])
    jax.tree.map(np.testing.assert_array_equal, tw.stack(folder, tracker=named), rows)
    found, expected = tw.filter_batch(named, folder), tw.filter_batch(batch.tracker, rows)
    for one, other in zip(found.mean.position, expected.mean.position, strict=True):
        np.testing.assert_array_equal(one, other)
