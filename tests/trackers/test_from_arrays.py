"""Recordings from arrays: what is masked, which heights they carry, and reported noise as variances."""

import dataclasses

import jax
import jaxtyping
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.ranges import RANGES

TIMES = np.array([0.0, 0.5, 2.0])
PATH = np.array([[1.0, 2.0, 3.0], [np.nan, 2.5, 3.5], [1.5, np.nan, np.nan]])


@pytest.mark.parametrize(
    ("positions", "height", "expected"),
    [
        (PATH, None, None),
        (PATH, 1.2, 1.2),
        # Without any z the tag is taken to be on the floor; y alone may be missing in three dimensions.
        (PATH[:, :2], None, 0.0),
        (np.where([True, True, False], PATH, np.nan), None, 0.0),
        (np.where([True, False, True], PATH, np.nan), None, None),
        (PATH[:, :2], 1.2, 1.2),
    ],
)
def test_fixes_carry_the_height_of_the_tag_or_zero_without_any_z(positions, height, expected):
    recording = tw.baselines.fix_recording(TIMES, positions, height=height)
    if expected is None:
        assert "height" not in recording.inputs
    else:
        np.testing.assert_array_equal(recording.inputs["height"], expected)
    fixes, n = recording.readings[FIXES], positions.shape[1]
    there = np.pad(np.isfinite(positions), ((0, 0), (0, 3 - n))) & [True, True, height is None]
    np.testing.assert_array_equal(fixes.seen, there)
    np.testing.assert_array_equal(fixes.values[:, :n], np.nan_to_num(positions))


def test_reported_standard_deviations_of_fixes_become_variances():
    std = np.array([[0.1, 0.2, 0.3], [np.nan, 0.2, 0.3], [0.4, 0.2, 0.3]])
    reported = tw.baselines.fix_recording(TIMES, PATH, std=std).readings[FIXES].reported
    np.testing.assert_allclose(reported, [[0.01, 0.04, 0.09], [0.0, 0.04, 0.09], [0.16, 0.04, 0.09]])
    np.testing.assert_array_equal(tw.baselines.fix_recording(TIMES, PATH).readings[FIXES].reported, 0.0)
    flat = tw.baselines.fix_recording(TIMES, PATH[:, :2], std=std[:, :2]).readings[FIXES].reported
    np.testing.assert_array_equal(flat, reported * [1, 1, 0])


def test_what_an_array_masks_is_missing():
    hidden = np.ma.array(np.nan_to_num(PATH, nan=-1.0), mask=np.isnan(PATH))
    np.testing.assert_array_equal(tw.baselines.fix_recording(TIMES, hidden).readings[FIXES].seen, np.isfinite(PATH))


def test_truth_with_a_missing_coordinate_is_unknown_and_zero():
    place, known = tw.baselines.fix_recording(TIMES, PATH, truth=PATH).truth["position"]
    np.testing.assert_array_equal(known, [True, False, False])
    np.testing.assert_array_equal(place, [PATH[0], np.zeros(3), np.zeros(3)])


def test_a_table_of_ranges_becomes_a_row_for_each_that_is_there():
    anchors = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [0.0, 4.0, 2.0]])
    ranges = np.array([[3.0, 4.0, np.nan], [np.nan, 4.5, -1.0], [3.5, np.nan, 5.0]])
    std, truth = np.arange(9.0).reshape(3, 3) / 10, PATH[[0, 0, 0]] + TIMES[:, None]
    recording = tw.uwb_imu.range_recording(TIMES, ranges, anchors, std=std, height=1.0, truth=truth)
    np.testing.assert_array_equal(recording.times, [0.0, 0.0, 0.5, 0.5, 2.0, 2.0])
    measured = recording.readings[RANGES]
    np.testing.assert_array_equal(measured.values[:, 0], [3.0, 4.0, 4.5, -1.0, 3.5, 5.0])
    # A range below zero is none.
    np.testing.assert_array_equal(measured.seen[:, 0], [True, True, True, False, True, True])
    np.testing.assert_allclose(measured.reported[:, 0], np.array([0.0, 0.1, 0.4, 0.5, 0.6, 0.8]) ** 2)
    np.testing.assert_array_equal(recording.inputs["anchor"][:, 0], [0, 1, 1, 2, 0, 2])
    np.testing.assert_array_equal(recording.inputs["anchors"], anchors[[0, 1, 1, 2, 0, 2]])
    np.testing.assert_array_equal(recording.inputs["height"], 1.0)
    np.testing.assert_array_equal(recording.truth["position"][0], truth[[0, 0, 1, 1, 2, 2]])


@pytest.mark.parametrize("name", ["fixes", "ranges", "bearings"])
def test_rows_of_arrays_are_those_of_the_same_table_in_a_folder(name):
    folder = (tw.simulate.agv if name == "fixes" else tw.simulate.fusion)(n=1, seed=2, rows=40).folder()
    columns = [c for c in folder.tables[name].columns if c.endswith(("_m", "_rad"))]
    said = {c.replace("_m", "_std_m").replace("_rad", "_std_rad"): 0.1 + 0.1 * k for k, c in enumerate(columns)}
    last = pl.when(pl.int_range(pl.len()) != 5).then(columns[-1]).alias(columns[-1])
    table = folder.tables[name].with_columns(last, **{c: pl.lit(std) for c, std in said.items()})
    folder = dataclasses.replace(folder, tables={**folder.tables, name: table})
    times, values, std = (table.select(c).to_numpy() for c in ("t_s", columns, said.keys()))
    rig = folder.rig
    if name == "fixes":
        (row,) = tw.parts.fix_trajectories(folder, True)
        made = tw.baselines.fix_recording(times[:, 0], values, std=std)
    elif name == "ranges":
        (row,), anchors = tw.parts.range_trajectories(folder, True), list(rig.anchors)
        given = {"std": std[:, 0], "anchor": [anchors.index(a) for a in table["anchor"]]}
        made = tw.uwb_imu.range_recording(times[:, 0], values[:, 0], np.stack([*rig.anchors.values()]), **given)
    else:
        (row,) = tw.aoa.bearing_trajectories(folder, True)
        made = tw.aoa.bearing_recording(times[:, 0], values, list(table["station"]), rig.stations, std=std)
        row.recording.inputs.pop("nearby")  # zero in the first second, when no track starts
    one, other = (stack([r]) for r in (row.recording, made))
    jax.tree_util.tree_map(np.testing.assert_array_equal, one.readings, other.readings)
    for key in one.inputs.keys() & other.inputs.keys():
        np.testing.assert_allclose(one.inputs[key], other.inputs[key], err_msg=key)


HALL = np.array([[0.0, 0.0, 2.0], [8.0, 0.0, 2.5], [8.0, 6.0, 2.0], [0.0, 6.0, 2.5]])
STATION = tw.Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
RANGES_M = np.linalg.norm(HALL - np.array([3.0, 2.0, 1.0]), axis=1) * np.ones((3, 1))


@pytest.mark.parametrize(
    ("times", "ranges", "anchors", "words"),
    [
        (TIMES, RANGES_M * 1000, HALL, "range_recording: typical range_m 5,405 m, .* looks like .*millimetres"),
        (TIMES, RANGES_M, HALL * 1000, "anchors .* m apart, ranges of .* looks like millimetres"),
        (TIMES, np.where(np.eye(3, 4) > 0, np.inf, RANGES_M), HALL, "ranges: row 0 is infinite"),
        (np.array([0.0, 1.0, 0.9]), RANGES_M, HALL, r"times\[2\] = 0.9 s comes before"),
    ],
)
def test_ranges_in_another_unit_or_order_are_refused_in_one_line_about_the_arrays_given(times, ranges, anchors, words):
    with pytest.raises(tw.UnusableInput, match=words):
        tw.uwb_imu.range_recording(times, ranges, anchors)


@pytest.mark.parametrize(
    ("times", "positions", "words"),
    [
        (TIMES, np.arange(9.0).reshape(3, 3) * 1e3, "fix_recording: typical distance .* looks like .*millimetres"),
        (TIMES, PATH * np.nan, r"positions of shape \(3, 3\) are all NaN"),
        ((TIMES + 1.7e9) * 1e3, PATH, "fix_recording: times: .* looks like milliseconds since 1970"),
        ((TIMES + 1.7e9) * 1e9, PATH, "fix_recording: times: .* looks like nanoseconds since 1970"),
    ],
)
def test_fixes_in_another_unit_or_without_any_are_refused(times, positions, words):
    with pytest.raises(tw.UnusableInput, match=words):
        tw.baselines.fix_recording(times, positions)


def test_times_in_milliseconds_are_refused_or_warned_of_by_the_arrays_of_both_kinds():
    with pytest.raises(tw.UnusableInput, match="range_recording: times: .* looks like milliseconds since 1970"):
        tw.uwb_imu.range_recording((TIMES + 1.7e9) * 1e3, RANGES_M, HALL)
    with pytest.warns(UserWarning, match="fix_recording: times: rows 1000 s apart .* looks like milliseconds"):
        tw.baselines.fix_recording(TIMES * 1e3, PATH)


def test_coordinates_of_a_map_are_a_warning_in_single_precision_alone():
    far = np.array([5e5, 5.4e6, 0.0])
    tw.uwb_imu.range_recording(TIMES, RANGES_M, HALL + far)
    with jax.enable_x64(False):
        with pytest.warns(UserWarning, match=r"range_recording: coordinates reach 5.4e\+06 m, .* resolves 0.5 m"):
            tw.uwb_imu.range_recording(TIMES, RANGES_M, HALL + far)
        with pytest.warns(UserWarning, match="fix_recording: coordinates"):
            tw.baselines.fix_recording(TIMES, np.ones((3, 3)) + far)
        # A single wild fix is none of a map.
        tw.baselines.fix_recording(TIMES, np.ones((3, 3)) + np.eye(3) * 1e9)


@pytest.fixture
def unchecked():
    """Without the checks of shapes that tests alone have."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: tw.Rig("hall", anchors={"A1": [0, 0]}), r"Rig: anchor A1 is at \[0, 0\]; expected \[x, y, z\], m"),
        (lambda: tw.Station(np.zeros(2), np.array([1.0, 0, 0, 0])), r"Station: position = \[0.0, 0.0\]; expected"),
        (lambda: tw.tracker_for(pl.DataFrame({"x": [1.0]})), "found DataFrame; expected one or more recording folders"),
        (lambda: tw.survey("walk"), "found str; expected one or more recording folders, as `read`"),
        (lambda: tw.Scale(-1.0), "a Scale is positive"),
        (lambda: tw.baselines.fix_recording(TIMES, PATH, std=-PATH), "std has -1.0; expected 0 or more"),
        (lambda: tw.baselines.fix_recording(["a", "b", "c"], PATH), "times: could not convert string"),
        (lambda: tw.aoa.phase_recording(TIMES, {"a": 60 * PATH}), "phase_recording: .* looks like degrees"),
        (lambda: tw.aoa.bearing_recording(TIMES, 60 * PATH[:, :2], ["a"] * 3, {"a": STATION}), "like degrees"),
        (lambda: tw.uwb_imu.range_recording(TIMES, TIMES + 1, HALL, anchor=[0, 1, 1.5]), "anchors 0 to 3"),
        (
            lambda: tw.baselines.fix_recording(TIMES, PATH, height=TIMES),
            r"height has shape \(3,\); expected one number",
        ),
        (lambda: tw.aoa.phase_recording(TIMES, PATH), "found ndarray; expected phases"),
    ],
)
def test_arguments_of_another_kind_are_refused_as_unusable_input(make, words, unchecked):
    with pytest.raises(tw.UnusableInput, match=words):
        make()
