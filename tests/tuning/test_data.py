"""The data of a fit from folders: the truth that an objective needs, and recordings that lack it."""

from __future__ import annotations

import dataclasses

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.monte_carlo.chunk import tracked_runs
from trackwright.experiments.monte_carlo.errors import scored
from trackwright.experiments.monte_carlo.results import ChunkTotals, Results
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.data import fit_data
from trackwright.tuning.fit_arrays import fit_arrays
from trackwright.tuning.named_objectives import all_metrics
from trackwright.tuning.objectives import MissingQuantityError
from trackwright.tuning.parameters import tuned_by_default

ROWS = 60


def _folder(height, heights_of_truth):
    """A tag on a circle at 1.2 m with noisy fixes; `height`: in its rig; `heights_of_truth`: z_m of the truth's rows."""
    rng, times = np.random.default_rng(1), np.arange(ROWS) * 0.1
    path = np.stack([np.cos(times), np.sin(times), 1.2 + 0 * times], axis=1)
    fixes = path + 0.1 * rng.normal(size=path.shape)
    columns = {"t_s": times, "tag": ["1"] * ROWS}
    tables = {
        "fixes": pl.DataFrame(columns | {f"{a}_m": fixes[:, k] for k, a in enumerate("xyz")}).with_columns(
            **{f"{a}_std_m": pl.lit(None, pl.Float64) for a in "xyz"}
        ),
        "truth": pl.DataFrame(columns | {"x_m": path[:, 0], "y_m": path[:, 1]}).with_columns(
            z_m=pl.Series(heights_of_truth, dtype=pl.Float64)
        ),
    }
    return RecordingFolder("hall", None, Rig("hall", tags={"1": Tag(height)}), tables)


NONE, HALF, ALL = [None] * ROWS, [1.2, None] * (ROWS // 2), [1.2] * ROWS


@pytest.mark.parametrize("heights", [NONE, HALF, ALL], ids=["no height", "every other height", "all heights"])
def test_a_fit_over_the_floor_judges_truth_without_heights_as_evaluate_does(heights):
    folder = _folder(1.2, heights)
    tracker = tw.build("fix-kf", folder)
    data = fit_data(tracker.only_batch(folder), "rmse")
    found = all_metrics(data.tracker, data.rows(), "position", 2)
    evaluation = tw.evaluate(tracker.run(folder), folder)
    assert evaluation["n"] == ROWS
    assert found["rmse"] == pytest.approx(evaluation["rmse_m"], rel=1e-9)


@pytest.mark.parametrize("height", [1.2, None], ids=["over the floor", "in space"])
def test_a_study_judges_truth_without_heights_as_evaluate_does(height):
    folder = _folder(height, NONE)
    study = Study(
        "floor", "", {"hall": World(lambda ids, seed: folder)}, {"mean": TrackerConfig("moving-average")}, runs=1
    )
    runs = tracked_runs(study, "hall", np.array(["1"]))["mean"]
    totals = ChunkTotals(1)
    totals.add(0, scored(runs))
    results = Results(study, {(0, "mean"): totals.totals()}, {0: 1})
    evaluation = tw.evaluate(tw.build("moving-average", folder).run(folder), folder)
    assert int(runs.known.sum()) == evaluation["n"] == ROWS
    assert results.at("rmse_m", study.conditions[0], "mean").value == pytest.approx(evaluation["rmse_m"], rel=1e-9)


@pytest.mark.parametrize("objective", ["rmse", "nll+0.1*state-nll"])
def test_the_error_of_an_estimated_height_needs_truth_with_heights(objective):
    folder = _folder(None, NONE)
    tracker = tw.build("fix-kf", folder)
    with pytest.raises(UnusableInput, match=r"needs truth with z_m, .* have x_m and y_m alone; judge two") as error:
        fit_data(tracker.only_batch(folder), objective, dimensions=3)
    assert "\n" not in str(error.value)
    assert fit_data(tracker.only_batch(folder), "nll", dimensions=3).training
    assert fit_data(tracker.only_batch(folder), objective).training, "the height is not judged"
    half = _folder(None, HALF)
    assert fit_data(tw.build("fix-kf", half).only_batch(half), objective, dimensions=3).training


def test_a_recording_without_truth_has_none_to_fit_to():
    folder = _folder(1.2, ALL)
    blind = dataclasses.replace(folder, tables={"fixes": folder.tables["fixes"]})
    with pytest.raises(UnusableInput, match="objective rmse needs truth, and these recordings have none"):
        fit_data(tw.build("fix-kf", blind).only_batch(blind), "rmse")


def test_truth_over_the_floor_of_a_state_in_space_is_refused_with_the_usual_fix():
    times = np.arange(5) * 0.1
    recording = tw.fix_recording(times, np.zeros((5, 3)), truth=np.zeros((5, 2)))
    with pytest.raises(MissingQuantityError, match="truth of the position has 2 components, and 3 are judged"):
        tw.fit(tw.fix_tracker(), recording, objective="rmse", dimensions=3)


@pytest.mark.parametrize(
    ("height", "heights_of_truth", "objective", "dimensions"),
    [
        (None, ALL, None, 3),
        (None, HALF, "state-nll+0.1*nll", 3),
        (None, NONE, None, 2),
        (1.2, ALL, None, 2),
        (None, ALL, "rmse", 2),
        (None, ALL, "nll", 2),
    ],
)
def test_an_estimated_height_is_judged_by_default_where_the_truth_has_heights(
    height, heights_of_truth, objective, dimensions
):
    folder = _folder(height, heights_of_truth)
    assert fit_data(tw.build("fix-kf", folder).only_batch(folder), objective).dimensions == dimensions


def test_recordings_in_arrays_with_true_heights_are_judged_in_space_by_default():
    times = np.arange(40) * 0.1
    path = np.stack([times, 0 * times, 1.2 + 0 * times], axis=1)
    recording = tw.fix_recording(times, path, truth=path)
    for dimensions, truth in ((3, path), (2, path[:, :2])):
        given = tw.fix_recording(times, path, truth=truth)
        assert fit_arrays(tw.fix_tracker(), given, None, ()).objective.dimensions == dimensions
    assert fit_arrays(tw.fix_tracker(), recording, "rmse", ()).objective.dimensions == 2


def test_the_latency_of_fixes_is_fitted_by_default_where_there_is_truth():
    rng, times = np.random.default_rng(3), np.arange(300) * 0.1
    place = np.stack([4 * np.sin(0.4 * times), 3 * np.cos(0.3 * times), 1.2 + 0 * times], axis=1)
    late = np.stack([np.interp(times - 0.4, times, x) for x in place.T], axis=1) + 0.02 * rng.normal(size=place.shape)
    found = tw.fit(tw.fix_tracker(), tw.fix_recording(times, late, truth=place))
    assert float(found.values["sensors.fixes.latency"]) == pytest.approx(0.4, abs=0.03)
    blind = tuned_by_default(tw.fix_tracker(), needs_truth=False)
    assert "sensors.fixes.latency" not in blind
    assert set(found.values) == {*blind, "sensors.fixes.latency"}
