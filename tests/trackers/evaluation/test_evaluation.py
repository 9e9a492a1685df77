"""Scored rows, every metric against NumPy at each level, and conditions on metrics."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2, multivariate_normal

import trackwright as tw
from tests.trackers.evaluation.tables import evaluate_table
from trackwright.experiments.text.evaluation_text import to_json, to_text
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.evaluation.evaluate import evaluate, rows_of, violation
from trackwright.trackers.evaluation.judge import energy_scores
from trackwright.trackers.evaluation.rows import scored_rows

RECORDINGS = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", Path(__file__).parents[3] / ".." / "shared" / "recordings"))


def _tracks(t, x, recording="hall", tag="1", **columns):
    zero = [0.0] * len(t)
    base = {"t_s": t, "x_m": x, "y_m": zero, "z_m": zero}
    return pl.DataFrame({"recording": [recording] * len(t), "tag": [tag] * len(t), **(base | columns)})


def _truth(t, x, tag="1", **columns):
    zero = [0.0] * len(t)
    return pl.DataFrame({"t_s": t, "tag": [tag] * len(t), "x_m": x, "y_m": zero, "z_m": zero} | columns)


P = np.array([[0.09, 0.02, -0.03], [0.02, 0.01, 0.004], [-0.03, 0.004, 0.04]])


@pytest.fixture
def noisy():
    """Two recordings, one of them with two tags, of different length, with their truth and covariances."""
    rng = np.random.default_rng(7)
    tracks, truths = [], {}
    for recording, tag, n in (("hall", "a", 120), ("yard", "b", 50), ("yard", "c", 31)):
        t = np.sort(rng.uniform(0, 10, n))
        places = np.stack([np.cos(t), np.sin(2 * t), 0.1 * t], axis=1)
        e = rng.multivariate_normal(np.zeros(3), P, n)
        columns = {f"{axis}_m": places[:, k] + e[:, k] for k, axis in enumerate("xyz")}
        columns |= {f"std_{axis}_m": np.full(n, np.sqrt(P[k, k])) for k, axis in enumerate("xyz")}
        columns |= {f"cov_{'xyz'[i]}{'xyz'[j]}_m2": np.full(n, P[i, j]) for i, j in ((0, 1), (0, 2), (1, 2))}
        columns |= {"nis": rng.chisquare(4, n), "nis_dof": np.full(n, 4.0), "status": ["ok"] * n}
        tracks.append(_tracks(t, columns.pop("x_m"), recording, tag, **columns))
        truth = _truth(t, places[:, 0], tag, y_m=places[:, 1], z_m=places[:, 2])
        truths[recording] = pl.concat([truths[recording], truth]) if recording in truths else truth
    return pl.concat(tracks), truths


@pytest.mark.parametrize(
    ("times", "truth", "why"),
    [
        ([0.9, 1.0, 1.5, 2.0, 2.1], _truth([1.0, 2.0], [0.0, 0.0]), ["no truth", None, None, None, "no truth"]),
        ([0.75], _truth([0.0, 1.5], [0.0, 0.03]), ["hole"]),
        ([0.75], _truth([0.0, 1.5], [0.0, 0.01]), [None]),
        ([0.45], _truth([0.0, 0.9], [0.0, 5.0]), [None]),
        ([50.0], _truth([0.0, 100.0], [0.0, 0.0]), [None]),
        ([0.5], _truth([0.0, 1.01], [0.0, 0.021]), ["hole"]),
        ([1.0], _truth([0.0, 1.0, 2.0], [0.0, None, 3.0]), ["hole"]),
        ([0.5], _truth([0.0, 1.0], [0.0, 0.0]).with_columns(tag=pl.lit(1)), [None]),
    ],
    ids=["span", "hole", "long, but at rest", "moved, but short", "at rest", "just", "empty cells", "integer tags"],
)
def test_estimates_are_scored_inside_the_truth_and_not_in_holes(times, truth, why):
    assert scored_rows(_tracks(times, [0.0] * len(times)), {"hall": truth})["why"].to_list() == why


def test_rows_without_an_estimate_are_not_scored():
    x = [1.0, 1.0, 1.0, None, math.nan, math.inf, 1.0, 1.0]
    status = ["waiting", "non-finite", "lost", "ok", "ok", "ok", None, "restarted"]
    rows = scored_rows(_tracks([0.1 * k for k in range(8)], x, status=status), {"hall": _truth([0.0, 1.0], [1.0, 1.0])})
    none = "no estimate"
    assert rows["why"].to_list() == [none, none, None, none, none, none, None, None]


def test_truth_is_interpolated_linearly_at_the_estimates_times():
    rows = scored_rows(_tracks([0.25, 0.5, 1.0], [0.0] * 3), {"hall": _truth([0.0, 0.5, 1.0], [0.0, 2.0, 3.0])})
    np.testing.assert_allclose(rows["true_x_m"], [1.0, 2.0, 3.0], rtol=1e-15)


def _expected(rows):
    """The metrics of rows with columns of truth, by NumPy; effective samples and their bands are of test_judge."""
    errors = np.stack([rows[f"{a}_m"] - rows[f"{a}_m_true"] for a in "xyz"], axis=1)
    n = len(errors)
    found = {"n": n, "n_rows": n, "n_no_estimate": 0, "n_no_truth": 0, "n_hole": 0}
    found |= {"variance_m2": np.var(np.linalg.norm(errors[:, :2], axis=1))}
    found |= {f"bias_{a}_m": errors[:, k].mean() for k, a in enumerate("xyz")}
    found |= {"nis_ratio": sum(rows["nis"]) / sum(rows["nis_dof"]), "lost_s": 0.0, "lost_fraction": 0.0, "losses": 0}
    for d, end, kind in ((2, "", "m"), (3, "_3d", "3d_m")):
        size = np.linalg.norm(errors[:, :d], axis=1)
        nees = np.einsum("ni,ij,nj->n", errors[:, :d], np.linalg.inv(P[:d, :d]), errors[:, :d])
        found |= {f"rmse_{kind}": np.sqrt(np.mean(size**2)), f"mean_{kind}": size.mean(), f"max_{kind}": size.max()}
        shares = {"median": 50, "p90": 90, "p95": 95, "p99": 99}
        found |= {f"{name}_{kind}": np.percentile(size, share) for name, share in shares.items()}
        ratio, density = nees.mean() / d, multivariate_normal(cov=P[:d, :d]).logpdf(errors[:, :d])
        found |= {f"n_no_covariance{end}": 0, f"n_zero_covariance{end}": 0, f"nees{end}_mean": nees.mean()}
        found |= {
            f"nees{end}_ratio": ratio,
            f"regret{end}": ratio - 1 - np.log(ratio),
            f"log_density{end}": density.mean(),
        }
        found[f"energy_score{end}_m"] = energy_scores(errors[:, :d], np.tile(P[:d, :d], (n, 1, 1))).mean()
        found[f"sigma_factor{end}"] = np.sqrt(np.median(nees) / chi2.ppf(0.5, d))
        found |= {f"coverage_{p}{end}": np.mean(nees <= chi2.ppf(p / 100, d)) for p in (50, 68, 90, 95, 99)}
    return found


def test_every_metric_is_that_of_numpy_for_each_track_each_recording_and_overall(noisy):
    tracks, truths = noisy
    every = pl.concat([truths[name].with_columns(recording=pl.lit(name)) for name in truths])
    joined = tracks.join(every, on=["recording", "tag", "t_s"], suffix="_true")
    evaluation = evaluate_table(tracks, truths)
    levels = [(evaluation.overall, joined)]
    levels += [(f, joined.filter(recording=f["recording"])) for f in evaluation.recordings]
    levels += [(f, joined.filter(recording=f["recording"], tag=f["tag"])) for f in evaluation.tracks]
    assert [metrics["n"] for metrics, _ in levels] == [201, 120, 81, 120, 50, 31]
    for metrics, rows in levels:
        expected = _expected(rows)
        assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-9, abs=1e-12)
        rest = {name for name in metrics if name not in expected and "effective" not in name}
        assert {x for x in rest if not x.endswith(("_low", "_high"))} <= {
            "recording", "tag", "residual_ratio_5s", "residual_part_5s",
        }  # fmt: skip


def test_the_order_of_rows_changes_nothing(noisy):
    tracks, truths = noisy
    shuffled = {name: truth.sample(fraction=1, shuffle=True, seed=1) for name, truth in truths.items()}
    parts = [tracks[100:], tracks[:100]]  # the first track is cut in two
    for same in (
        tracks.sample(fraction=1, shuffle=True, seed=2),
        pl.concat(parts),
        pl.concat(tracks.partition_by("recording", "tag")[::-1]),
    ):
        assert evaluate_table(same, shuffled) == evaluate_table(tracks, truths)


def _with_covariances(axes, bad, n=400, sigma=0.05, **columns):
    """Normal errors along so many axes; the standard deviations of a quarter of the rows are `bad`."""
    rng = np.random.default_rng(7)
    t, at = np.arange(n) / 10, np.zeros(n)
    noise = {f"{a}_m": rng.normal(0.0, sigma, n) for a in "xyz"[:axes]}
    stds = {f"std_{a}_m": np.where(np.arange(n) % 4 == 0, bad, sigma) for a in "xyz"[:axes]}
    table = _tracks(t, at).with_columns(**noise, **(stds | columns))
    squares = sum((x / sigma) ** 2 for x in noise.values())[np.arange(n) % 4 > 0]
    truth = _truth(t, at, **({"z_m": at} if axes == 3 else {}))
    return evaluate_table(table, {"hall": truth}), squares


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(("bad", "zero"), [(0.0, 100), (-0.05, 100), (math.nan, 0), (math.inf, 0)])
def test_rows_without_a_covariance_are_counted_and_a_zero_counts_as_outside(axes, bad, zero):
    (found, squares), limit = _with_covariances(axes, bad), {2: 5.99146, 3: 7.81473}[axes]
    suffix = "_3d" if axes == 3 else ""
    assert found[f"n_no_covariance{suffix}"] == 100
    assert found[f"n_zero_covariance{suffix}"] == zero
    assert found[f"coverage_95{suffix}"] == pytest.approx((squares <= limit).sum() / (300 + zero))
    assert found[f"nees{suffix}_ratio"] == pytest.approx(squares.mean() / axes)
    (sentence,) = found.statements
    assert sentence.startswith(f"100 of 400 rows are without a covariance, {zero} of them with a zero")
    assert sentence.endswith("covariances are not judged.")
    assert json.loads(to_json(found))["overall"][f"n_zero_covariance{suffix}"] == zero


@pytest.mark.parametrize(("cov", "zero"), [(0.0025, 100), (0.004, 100), (math.nan, 0), (math.inf, 0)])
def test_a_singular_covariance_counts_as_outside_and_a_missing_entry_as_none(cov, zero):
    cov = pl.Series(np.where(np.arange(400) % 4 == 0, cov, 1e-9))
    found, squares = _with_covariances(2, 0.05, cov_xy_m2=cov)
    assert (found["n_no_covariance"], found["n_zero_covariance"]) == (100, zero)
    assert found["coverage_95"] == pytest.approx((squares <= 5.99146).sum() / (300 + zero))
    assert found["nees_ratio"] == pytest.approx(squares.mean() / 2, rel=1e-5)


def test_where_all_covariances_are_singular_no_truth_is_inside_and_there_is_no_verdict():
    tracks = _tracks([0.0, 1.0], [0.1, 0.2], std_x_m=[0.0, 0.0], std_y_m=[0.1, 0.1])
    found = evaluate_table(tracks, {"hall": _truth([0.0, 1.0], [0.0, 0.0])})
    assert (found["coverage_95"], found["nees_ratio"]) == (0.0, None)
    assert found.statements == [
        "2 of 2 rows are without a covariance, 2 of them with a zero or singular one, which has no truth inside; with "
        "more than a tenth, covariances are not judged."
    ]


def test_a_height_known_in_some_rows_alone_counts_as_zero():
    deviations = pl.Series(np.where(np.arange(400) % 4, 0.05, 0.0))
    found, squares = _with_covariances(3, 0.05, std_z_m=deviations)
    assert found["n_no_covariance"] == 0
    assert (found["n_no_covariance_3d"], found["n_zero_covariance_3d"]) == (100, 100)
    assert found["coverage_95_3d"] == pytest.approx((squares <= 7.81473).sum() / 400)
    assert "100 of 400 rows are without a covariance in three dimensions" in found.statements[1]


@pytest.mark.parametrize(("z", "expected"), [(0.0, (1.0, 0.0)), (None, (None, None)), (math.nan, (None, None))])
def test_a_known_height_and_a_missing_one_leave_the_horizontal_metrics(z, expected):
    height = pl.Series([z], dtype=pl.Float64)
    tracks = _tracks([0.5], [1.0], z_m=height, std_x_m=[1.0], std_y_m=[1.0], std_z_m=[0.0])
    found = evaluate_table(tracks, {"hall": _truth([0, 1], [0.0, 0.0])})
    assert (found["rmse_m"], found["nees_mean"], found["nees_3d_mean"]) == (1.0, 1.0, None)
    assert (found["rmse_3d_m"], found["bias_z_m"]) == expected


def test_time_lost_adds_up_over_tracks():
    lost = _tracks([0.0, 1.0, 4.0], [0.0] * 3, tag="1", status=["ok", "lost", "ok"])
    well = _tracks([0.0, 9.0], [0.0] * 2, tag="2", status=["ok", "ok"])
    truth = pl.concat([_truth([0.0, 9.0], [0.0, 0.0], tag) for tag in "12"])
    overall = evaluate_table(pl.concat([lost, well]), {"hall": truth}).overall
    assert (overall["lost_s"], overall["lost_fraction"]) == (3.0, 3 / 13)


def test_without_a_span_of_time_the_share_lost_is_that_of_the_rows():
    status = ["lost", "ok", "lost", "ok", "ok"]
    tracks = pl.concat([_tracks([1.0], [0.0], tag=f"{k}", status=[what]) for k, what in enumerate(status)])
    evaluation = evaluate_table(tracks, {"hall": pl.concat([_truth([0.0, 9.0], [0.0, 0.0], f"{k}") for k in range(5)])})
    assert [track["lost_fraction"] for track in evaluation.tracks] == [1, 0, 1, 0, 0]
    assert (evaluation["lost_s"], evaluation["lost_fraction"]) == (0.0, 0.4)


def test_unscored_rows_are_counted_by_reason():
    tracks = _tracks([0.5, 0.6, 1.5, 2.5, 9.0], [0.0] * 5, status=["waiting", "ok", "ok", "ok", "ok"])
    overall = evaluate_table(tracks, {"hall": _truth([0.0, 1.0, 3.0], [0.0, 0.0, 5.0])}).overall
    assert [overall[name] for name in ("n_rows", "n", "n_no_estimate", "n_no_truth", "n_hole")] == [5, 1, 1, 1, 2]


def test_only_the_last_estimate_of_each_interval_can_be_scored():
    # 0.3 s opens an interval although 0.3 / 0.1 is just under 3 in binary.
    tracks = _tracks([0.0, 0.05, 0.09, 0.1, 0.25, 0.3, 0.31], [9.0, 9.0, 1.0, 2.0, 3.0, 9.0, 4.0])
    evaluation = evaluate_table(tracks, {"hall": _truth([0.0, 1.0], [0.0, 0.0])}, every=0.1)
    assert (evaluation.overall["n"], evaluation.overall["max_m"], evaluation.overall["median_m"]) == (4, 4.0, 2.5)


@pytest.fixture
def stations():
    half = math.sqrt(0.5)
    north = Station(np.array([0.0, 5.0, 3.0]), np.array([half, half, 0.0, 0.0]))
    return {"hall": {"N": north, "S": Station(np.array([0.0, -5.0, 3.0]), np.array([0.0, 0.0, half, half]))}}


def _bearing_tracks(stations, offset, t=(0.2, 0.8)):
    """What each station reports of a tag at (t, 1, 1), with a constant error of azimuth and elevation."""
    frames = []
    for ident, station in stations["hall"].items():
        angles = station.angles(np.array([[x, 1.0, 1.0] for x in t])) + offset
        azimuth = np.angle(np.exp(1j * angles[:, 0]))
        values = {"azimuth_rad": azimuth, "elevation_rad": angles[:, 1]}
        values |= {"std_azimuth_rad": 0.1, "std_elevation_rad": 0.2}
        frames.append(pl.DataFrame({"recording": "hall", "tag": "1", "station": ident, "t_s": t, **values}))
    return pl.concat(frames)


def _still_walk():
    return {"hall": _truth([0.0, 1.0], [0.0, 1.0], y_m=[1.0, 1.0], z_m=[1.0, 1.0])}


def test_bearings_are_scored_against_the_true_direction_from_their_station(stations):
    evaluation = evaluate_table(_bearing_tracks(stations, [0.05, -0.1]), _still_walk(), stations)
    assert [(f["station"], f["n"]) for f in evaluation.tracks] == [("N", 2), ("S", 2)]
    overall = evaluation.overall
    # Sines and cosines of single angles come and go: some roundings of 1e-16.
    assert overall["rmse_azimuth_rad"] == pytest.approx(0.05, rel=1e-12)
    assert overall["bias_elevation_rad"] == pytest.approx(-0.1, rel=1e-12)
    assert overall["nees_mean"] == pytest.approx(0.25 + 0.25, rel=1e-12)


@pytest.mark.parametrize(("bad", "zero"), [(0.0, 2), (math.nan, 0), (math.inf, 0)])
def test_bearings_without_a_covariance_are_counted_too(stations, bad, zero):
    tracks = _bearing_tracks(stations, [0.05, -0.1])
    tracks = tracks.with_columns(std_azimuth_rad=pl.when(pl.col("t_s") < 0.5).then(bad).otherwise(0.1))
    overall = evaluate_table(tracks, _still_walk(), stations).overall
    assert (overall["n"], overall["n_no_covariance"], overall["n_zero_covariance"]) == (4, 2, zero)
    assert overall["coverage_95"] == 2 / (2 + zero)
    assert overall["nees_mean"] == pytest.approx(0.25 + 0.25, rel=1e-12)


def test_the_angle_between_directions_is_the_great_circle(stations):
    evaluation = evaluate_table(_bearing_tracks(stations, [0.0, 0.1]), _still_walk(), stations)
    assert evaluation.overall["rmse_direction_rad"] == pytest.approx(0.1, rel=1e-12)


def test_azimuth_errors_are_wrapped(stations):
    north = {"hall": {"N": Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))}}
    behind = {"hall": _truth([0.0, 1.0], [0.01, 0.01], z_m=[-1.0, -1.0])}
    row = {"recording": "hall", "tag": "1", "station": "N", "t_s": [0.5], "azimuth_rad": [-math.pi + 0.01]}
    overall = evaluate_table(pl.DataFrame({**row, "elevation_rad": [0.0]}), behind, north).overall
    # The true azimuth is π − atan(0.01); the estimate lies beyond the cut.
    assert overall["bias_azimuth_rad"] == pytest.approx(0.01 + math.atan(0.01), rel=1e-9)


def test_of_directions_in_the_plane_of_an_array_the_angle_alone_is_judged():
    flat = {"hall": {"N": Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))}}
    truth = {"hall": _truth([0.0, 1.0], [math.cos(0.1)] * 2, y_m=[math.sin(0.1)] * 2, z_m=[0.0, 0.0])}
    row = {"recording": "hall", "tag": "1", "station": "N", "t_s": [0.5], "azimuth_rad": [math.pi / 2]}
    evaluation = evaluate_table(pl.DataFrame({**row, "elevation_rad": [0.3]}), truth, flat)
    assert evaluation.overall["rmse_azimuth_rad"] is None
    assert evaluation.overall["bias_elevation_rad"] is None
    assert evaluation.overall["rmse_direction_rad"] == pytest.approx(0.2, rel=1e-9)
    head = to_text(evaluation, 80).split("─")[0]
    assert "angle" in head
    assert "az" not in head


def test_tracks_at_other_times_are_refused_with_both_spans():
    with pytest.raises(UnusableInput, match=r"from 100 to 101 s of tags 1, truth of 'hall' from 0 to 1 s"):
        evaluate_table(_tracks([100.0, 101.0], [0.0] * 2), {"hall": _truth([0.0, 1.0], [0.0, 0.0])})


@pytest.mark.parametrize(
    ("tracks", "truth", "words"),
    [
        (_tracks([0.5], [0.0]).drop("tag"), _truth([0.0], [0.0]), "the tracks: no column tag"),
        (_tracks([0.5], [0.0], status=[1]), _truth([0.0], [0.0]), "column status holds numbers"),
        (_tracks([0.5], ["east"]), _truth([0.0], [0.0]), "column x_m holds text"),
        (_tracks([0.5], [0.0]), _truth([0.0], [0.0]).drop("x_m"), "truth of recording 'hall': no column x_m"),
        (_tracks([0.5], [0.0]), _truth([0.0], [0.0]).clear(), "no estimate lies inside a truth"),
    ],
)
def test_tables_that_do_not_fit_are_refused_in_one_line(tracks, truth, words):
    with pytest.raises(UnusableInput, match=words) as caught:
        evaluate_table(tracks, {"hall": truth})
    assert "\n" not in str(caught.value)


@pytest.fixture
def one_metre():
    """An evaluation whose horizontal metrics are all 1 m and that has no NEES."""
    return evaluate_table(_tracks([0.5], [1.0]), {"hall": _truth([0.0, 1.0], [0.0, 0.0])})


@pytest.mark.parametrize(
    ("expression", "failure"),
    [
        ("p95_m>0.5", "p95_m>0.5 (p95_m is 1)"),
        ("p95_m > 1", None),
        ("n<1e1 and rmse_m==1", "n<1e1 and rmse_m==1 (n is 1, rmse_m is 1)"),
        ("n>10 and rmse_m<1 or max_m<=.1e1", "n>10 and rmse_m<1 or max_m<=.1e1 (n is 1, rmse_m is 1, max_m is 1)"),
        ("(n>10 or rmse_m=1) and max_m>1", None),
    ],
)
def test_a_condition_holds_or_does_not(one_metre, expression, failure):
    assert violation(one_metre, expression) == failure


@pytest.mark.parametrize(
    "expression",
    ["", "p95_m", "p95_m>", "p95_m>>1", "p95_m>1 and", "p95_m>'a'", "1>0", "print('x')>1", "n>1,n>2", "rmse_m=>1"],
)
def test_a_condition_that_cannot_be_read_is_refused_with_the_names(one_metre, expression):
    with pytest.raises(UnusableInput, match=r"NAME OPERATOR NUMBER.*names: n, .*rmse_m"):
        violation(one_metre, expression)


def test_a_metric_without_a_value_does_not_pass_silently(one_metre):
    with pytest.raises(UnusableInput, match="'nees_mean' has no value"):
        violation(one_metre, "n>1 and nees_mean>3")


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not here; set TRACKWRIGHT_RECORDINGS")
@pytest.mark.parametrize(
    ("name", "n", "flat", "solid"),
    [
        ("tiers-1tag-01", 1800, (0.318, 0.202, 0.669), (0.974, 0.445, 2.004)),
        ("tiers-2tag-06", 1295, (0.215, 0.135, 0.466), (0.645, 0.543, 1.151)),
        ("iasl-drone-1", 4936, (0.101, 0.083, 0.158), (2.383, 2.441, 2.873)),
    ],
)
def test_the_makers_fixes_have_the_errors_their_readme_prints(name, n, flat, solid):
    folder = RECORDINGS / name
    if not folder.is_dir():
        pytest.skip(f"{name} is not among the recordings")
    fixes, truth = (
        pl.read_csv(folder / f"{table}.csv.gz", schema_overrides={"tag": pl.String}) for table in ("fixes", "truth")
    )
    overall = evaluate_table(fixes.with_columns(recording=pl.lit(name)), {name: truth}).overall
    assert overall["n"] == n
    # Half a unit of the last printed digit.
    assert [overall[f"{f}_m"] for f in ("rmse", "median", "p95")] == pytest.approx(flat, abs=5.1e-4)
    assert [overall[f"{f}_3d_m"] for f in ("rmse", "median", "p95")] == pytest.approx(solid, abs=5.1e-4)


def test_recordings_given_as_the_first_argument_are_refused_with_the_order_of_both():
    recording = tw.fix_recording(np.arange(3.0), np.zeros((3, 3)), truth=np.zeros((3, 3)))
    estimates = tw.fix_tracker().run(recording)
    for wrong, found in ((estimates, "Estimates"), ([], "nothing"), (3, "int"), ([recording, "a"], "str")):
        with pytest.raises(UnusableInput, match=rf"found {found}; expected recordings .*evaluate\(estimates, rec"):
            evaluate(recording, wrong)


def _still(offset, rows=20, **named):
    """Fixes of a tag that stands `offset` m along x, and its truth; 5 mm apart."""
    place = np.tile([offset, 0.0, 0.0], (rows, 1))
    return tw.fix_recording(0.1 * np.arange(rows), place + 0.005, truth=place, **named)


def test_recordings_of_one_name_are_told_apart_by_their_place():
    unnamed, named = [_still(0.0), _still(5.0)], [_still(0.0, name="a"), _still(5.0, name="b")]
    tracker = tw.fix_tracker()
    found, expected = (evaluate(tracker.run(own), own) for own in (unnamed, named))
    assert len(found.tracks) == 2
    assert found["rmse_m"] == expected["rmse_m"] < 0.05
    estimates = tracker.run(named)
    for given in (estimates, estimates.to_polars().with_columns(tag=pl.lit(""))):
        assert evaluate(given, iter(named))["rmse_m"] == expected["rmse_m"]
    assert [one["recording"] for one in found.recordings] == ["recording", "recording 2"]
    assert (
        evaluate(tracker.run(unnamed).to_polars().with_columns(tag=pl.lit("")), unnamed)["rmse_m"] == expected["rmse_m"]
    )
    with pytest.raises(UnusableInput, match=r"2 recordings of the run are named 'recording'.*in the same order"):
        evaluate(tracker.run(unnamed), unnamed[:1])


def test_recordings_in_arrays_may_have_truth_in_some_rows_or_none_or_without_height():
    own = [_still(float(k), name=f"{k}") for k in range(4)]
    estimates = tw.fix_tracker().run(own)

    def known(recording, rows, d=3):
        return replace(recording, truth={"position": (recording.truth["position"][0][:, :d], rows)})

    rows = np.arange(20) % 7 < 5
    given = [known(own[0], ~rows), known(own[1], 0 * rows > 0), known(own[2], rows, 2), known(own[3], 0 * rows > 0)]
    found = rows_of(estimates, given).partition_by("recording", as_dict=True)
    true = {name: part["true_x_m"].to_numpy() for (name,), part in found.items()}
    inside = {"0": slice(5, 20), "2": slice(0, 19)}
    for name, x in true.items():
        expected = np.full(20, np.nan)
        if name in inside:
            expected[inside[name]] = float(name)
        np.testing.assert_allclose(x, expected, rtol=1e-12)
    assert found["2",]["true_z_m"].is_null().all()
