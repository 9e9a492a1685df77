"""The data of a fit from folders: the truth that an objective needs, recordings that lack it, and fingerprints."""

from __future__ import annotations

import dataclasses

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.tuning.worlds import figure, line_tracker, walks
from trackwright.sim import worlds
from trackwright.sim.worlds import ranges
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.checkpoint import fingerprint
from trackwright.tuning.data import fit_arrays, fit_data, trajectory_weights
from trackwright.tuning.objectives import parse_objective
from trackwright.tuning.parameters import flatten, select_parameters, tuned_by_default
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import optimum

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
    evaluation = tw.evaluate(tracker.run(folder), folder)
    assert evaluation["n"] == ROWS
    assert figure(data.tracker, data.rows.batches, data.objective) == pytest.approx(evaluation["rmse_m"], rel=1e-9)


@pytest.mark.parametrize("objective", ["rmse", "state-nll"])
def test_the_error_of_an_estimated_height_needs_truth_with_heights(objective):
    folder = _folder(None, NONE)
    tracker = tw.build("fix-kf", folder)
    with pytest.raises(UnusableInput, match="needs truth with z_m, and these recordings have none"):
        fit_data(tracker.only_batch(folder), objective, dimensions=3)
    assert fit_data(tracker.only_batch(folder), "nll", dimensions=3).training
    assert fit_data(tracker.only_batch(folder), objective).training, "the height is not judged"
    half = _folder(None, HALF)
    assert fit_data(tw.build("fix-kf", half).only_batch(half), objective, dimensions=3).training


@pytest.mark.parametrize(
    ("height", "heights_of_truth", "objective", "dimensions"),
    [
        (None, ALL, None, 3),
        (None, HALF, "state-nll", 3),
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


@pytest.mark.parametrize(("highest", "dimensions"), [(1.4, 2), (2.6, 3)])
def test_a_height_near_the_plane_of_level_anchors_is_not_judged_by_default(highest, dimensions):
    anchors = {"A": np.array([0.0, 0.0, 0.6]), "B": np.array([5.0, 0.0, highest]), "C": np.array([0.0, 5.0, 1.0])}
    folder = _folder(None, ALL)
    folder = dataclasses.replace(folder, rig=dataclasses.replace(folder.rig, anchors=anchors))
    assert fit_data(tw.build("fix-kf", folder).only_batch(folder), None).dimensions == dimensions


def test_recordings_in_arrays_with_true_heights_are_judged_in_space_by_default():
    times = np.arange(40) * 0.1
    path = np.stack([times, 0 * times, 1.2 + 0 * times], axis=1)
    recording = tw.baselines.fix_recording(times, path, truth=path)
    for dimensions, truth in ((3, path), (2, path[:, :2])):
        given = tw.baselines.fix_recording(times, path, truth=truth)
        assert fit_arrays(tw.baselines.fix_tracker(), given, None, ()).objective.dimensions == dimensions
    assert fit_arrays(tw.baselines.fix_tracker(), recording, "rmse", ()).objective.dimensions == 2


@pytest.mark.slow
def test_the_latency_of_fixes_is_fitted_by_default_where_there_is_truth():
    rng, times = np.random.default_rng(3), np.arange(300) * 0.1
    place = np.stack([4 * np.sin(0.4 * times), 3 * np.cos(0.3 * times), 1.2 + 0 * times], axis=1)
    late = np.stack([np.interp(times - 0.4, times, x) for x in place.T], axis=1) + 0.02 * rng.normal(size=place.shape)
    found = tw.fit(tw.baselines.fix_tracker(), tw.baselines.fix_recording(times, late, truth=place))
    assert float(found.values["sensors.fixes.latency"]) == pytest.approx(0.4, abs=0.03)
    blind = tuned_by_default(tw.baselines.fix_tracker(), needs_truth=False)
    assert "sensors.fixes.latency" not in blind
    assert {*found.values} ^ {*blind} == {"sensors.fixes.latency", "sensors.fixes.dof"}


LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


def test_the_rows_of_every_recording_add_up_to_the_same():
    batches = [stack(walks([30, 60], 1)), stack(walks([200], 2))]
    found = trajectory_weights(batches, [["a", "b"], ["b"]], needs_truth=False)
    # 290 rows of two recordings: 145 each
    np.testing.assert_allclose(np.concatenate(found), [145 / 30, 145 / 260, 145 / 260])
    equal = trajectory_weights([stack(walks([50, 50, 50], 1))], [["a", "b", "c"]], needs_truth=False)
    assert equal[0].tolist() == [1.0] * 3
    made = walks([50, 50], 1)
    made[1].readings["gauge"] = dataclasses.replace(made[1].readings["gauge"], seen=np.zeros((50, 1), bool))
    (found,) = trajectory_weights([stack(made)], [["a", "b"]], needs_truth=False)
    assert found[0] == 1.0


def test_rows_with_truth_count_where_the_objective_judges_them():
    made = walks([40, 40], 3)
    position, known = made[1].truth["position"]
    made[1].truth["position"] = (position, known & (np.arange(40) < 10))
    (found,) = trajectory_weights([stack(made)], [["a", "b"]], needs_truth=True)
    np.testing.assert_allclose(found, [25 / 40, 25 / 10])


@pytest.mark.parametrize("objective", ["nll", "state-nll", pytest.param("rmse", marks=pytest.mark.slow)])
@pytest.mark.parametrize("copies", [pytest.param(1, id="few"), pytest.param(20, id="many", marks=pytest.mark.slow)])
def test_a_weight_of_three_is_three_trajectories(objective, copies):
    tracker, made = line_tracker(), walks([30, 45] * copies, 4)
    parameters, goal = select_parameters(tracker, LEVELS), parse_objective(objective, "position", 1)
    weights = np.tile([1.0, 3.0], copies)
    weighted = Problem(tracker, [stack(made)], goal, parameters, weights=[weights])
    thrice = [r for r, w in zip(made, weights, strict=True) for _ in range(int(w))]
    repeated = Problem(tracker, [stack(thrice)], goal, parameters)
    vectors = flatten(parameters) + np.array([[0.0, 0.0], [0.4, -0.3]])
    one, other = weighted.evaluate(vectors), repeated.evaluate(vectors)
    np.testing.assert_allclose(one.values, other.values, rtol=1e-12)
    np.testing.assert_allclose(one.gradients, other.gradients, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(weighted.values(vectors), repeated.values(vectors), rtol=1e-12)
    model, copy = optimum(weighted, vectors[0]), optimum(repeated, vectors[0])
    np.testing.assert_allclose(model.hessian, copy.hessian, rtol=1e-7, atol=1e-10)
    assert figure(tracker, [stack(made)], goal, [weights]) == pytest.approx(other.values[0], rel=1e-9)


def test_a_long_recording_decides_a_fit_no_more_than_a_short_one():
    made = [*walks([600], 6, sigma=0.2), *walks([60], 7, sigma=0.8)]
    result = tw.fit(line_tracker(), made, "nll", "sensors.gauge.sigma", tw.FitOptions(prior="flat"))
    # squares average to (0.2² + 0.8²) / 2 = 0.58², by rows to 0.30²; the motion takes a part of the errors
    assert 0.45 < float(result.values["sensors.gauge.sigma"]) < 0.65


@pytest.mark.slow
@pytest.mark.parametrize("objective", [pytest.param("rmse", marks=pytest.mark.slow), "state-nll"])
def test_vertical_noise_keeps_its_start_where_the_position_over_the_floor_is_judged(objective):
    folder = ranges(n=1, seed=3, rows=120).folder()
    named = tw.build("uwb", dataclasses.replace(folder, rig=dataclasses.replace(folder.rig, tags={})))
    tune, options = ["motion.sigma_a", "motion.sigma_z"], tw.FitOptions(dimensions=2, steps=4, prior="flat")
    result = tw.fit(named, folder, objective, tune, options)
    assert result.values["motion.sigma_z"] == result.before.motion.sigma_z.value
    assert result.values["motion.sigma_a"] != result.before.motion.sigma_a.value
    texts = [issue.text for issue in result.issues]
    assert "motion.sigma_z: kept at the starting value, which the objective does not determine" in texts
    assert f"\n  caution: {texts[0]}" in repr(result)
    free = tw.fit(named, folder, objective, "motion.sigma_z", options)
    assert np.all(free.limits[0] < free.limits[1]), "alone it is not held"


@pytest.fixture(scope="module")
def data():
    """Segments of nine vehicles in two recordings, of different lengths."""
    folders = [worlds.agv(n=n, seed=n, rows=rows).folder() for n, rows in ((5, 90), (4, 60))]
    named = build("fix-kf", folders)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trackwright.tuning.data.SEGMENT_ROWS", 25)
        return fit_data(named.only_batch(folders), "state-nll")


def test_a_checkpoint_tells_recordings_that_differ_in_one_number_apart(data):
    last = data.training[-1]
    readings = {
        name: dataclasses.replace(r, values=np.append(r.values[:-1], r.values[-1:] + 1e-3, axis=0))
        for name, r in last.recording.readings.items()
    }
    changed = dataclasses.replace(last, recording=dataclasses.replace(last.recording, readings=readings))
    other = dataclasses.replace(data, training=[*data.training[:-1], changed])
    assert len({fingerprint({}, own.rows.batches, np.zeros(2)) for own in (data, other)}) == 2
