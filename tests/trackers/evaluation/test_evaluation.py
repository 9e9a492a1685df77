"""Scored rows, every metric against NumPy at each level, and conditions on metrics."""

import math

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2, multivariate_normal

import trackwright as tw
from tests.trackers.evaluation.tables import evaluate_table
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.evaluation.evaluate import evaluate, violation
from trackwright.trackers.evaluation.rows import energy_scores, scored_rows


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


def test_truth_is_interpolated_linearly_where_there_is_an_estimate():
    x = [1.0, 1.0, 1.0, None, math.nan, math.inf, 1.0, 1.0]
    status = ["waiting", "non-finite", "lost", "ok", "ok", "ok", None, "restarted"]
    rows = scored_rows(_tracks([0.1 * k for k in range(8)], x, status=status), {"hall": _truth([0.0, 1.0], [0.0, 2.0])})
    none = "no estimate"
    assert rows["why"].to_list() == [none, none, None, none, none, none, None, None]
    np.testing.assert_allclose(rows["true_x_m"].drop_nulls(), [0.4, 1.2, 1.4], rtol=1e-15)


def _expected(rows):
    """The metrics of rows with columns of truth, by NumPy; effective samples and their bands are of test_judge."""
    errors = np.stack([rows[f"{a}_m"] - rows[f"{a}_m_true"] for a in "xyz"], axis=1)
    n = len(errors)
    found = {"n": n, "n_rows": n, "n_no_estimate": 0, "n_no_truth": 0, "n_hole": 0}
    found |= {"variance_m2": np.var(np.linalg.norm(errors[:, :2], axis=1))}
    found |= {f"bias_{a}_m": errors[:, k].mean() for k, a in enumerate("xyz")}
    found |= {"nis_ratio": sum(rows["nis"]) / sum(rows["nis_dof"]), "lost_s": 0.0, "lost_fraction": 0.0, "losses": 0}
    own = [(of[["x_m_true", "y_m_true"]].to_numpy(), of) for _, of in rows.sort("t_s").group_by("recording", "tag")]
    velocity = np.concatenate([np.diff(x, axis=0) / np.diff(of["t_s"])[:, None] for x, of in own]).reshape(-1, 1)
    error = np.concatenate([(of[["x_m", "y_m"]].to_numpy() - x)[:-1] for x, of in own]).ravel()
    last = sum(((of[["x_m", "y_m"]].to_numpy() - x)[-1] ** 2).sum() for x, of in own)
    (late,), *_ = np.linalg.lstsq(velocity, -error)
    rest = np.sum((error + velocity[:, 0] * late) ** 2)
    found |= {"lag_s": late, "rmse_without_lag_m": np.sqrt((rest + last) / n)}
    for d, end, kind in ((2, "", "m"), (3, "_3d", "3d_m")):
        size = np.linalg.norm(errors[:, :d], axis=1)
        nees = np.einsum("ni,ij,nj->n", errors[:, :d], np.linalg.inv(P[:d, :d]), errors[:, :d])
        found |= {f"rmse_{kind}": np.sqrt(np.mean(size**2)), f"mean_{kind}": size.mean(), f"max_{kind}": size.max()}
        shares = {"median": 50, "p90": 90, "p95": 95, "p99": 99}
        found |= {f"{name}_{kind}": np.percentile(size, share) for name, share in shares.items()}
        ratio, density = nees.mean() / d, multivariate_normal(cov=P[:d, :d]).logpdf(errors[:, :d])
        found |= {f"n_no_covariance{end}": 0, f"n_zero_covariance{end}": 0, f"nees{end}_mean": nees.mean()}
        found |= {f"nees{end}_ratio": ratio, f"regret{end}": ratio - 1 - np.log(ratio)}
        found[f"log_density{end}"] = density.mean()
        found[f"energy_score{end}_m"] = energy_scores(errors[:, :d], np.tile(P[:d, :d], (n, 1, 1))).mean()
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
        assert {x for x in rest if not x.endswith(("_low", "_high"))} <= {"recording", "tag"}


def test_the_order_of_rows_changes_nothing(noisy):
    tracks, truths = noisy
    shuffled = {name: truth.sample(fraction=1, shuffle=True, seed=1) for name, truth in truths.items()}
    same = evaluate_table(tracks.sample(fraction=1, shuffle=True, seed=2), shuffled)
    assert same == evaluate_table(tracks, truths)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize(
    ("bad", "cov", "zero"),
    [(0.0, None, 100), (-0.05, None, 100), (math.nan, None, 0), (math.inf, None, 0)]
    + [(0.05, 0.0025, 100), (0.05, 0.004, 100), (0.05, math.nan, 0), (0.05, math.inf, 0)],
)
def test_rows_without_a_covariance_are_counted_and_a_zero_or_singular_one_counts_as_outside(axes, bad, cov, zero):
    """Normal errors; the standard deviations, or the covariance of x and y, of a quarter of the rows are bad."""
    rng, t, n = np.random.default_rng(7), np.arange(400) / 10, 400
    quarter, noise = np.arange(n) % 4 == 0, {f"{a}_m": rng.normal(0.0, 0.05, n) for a in "xyz"[:axes]}
    columns = {f"std_{name}": np.where(quarter, bad, 0.05) for name in noise}
    columns |= {} if cov is None else {"cov_xy_m2": pl.Series(np.where(quarter, cov, 1e-9))}
    found = evaluate_table(_tracks(t, 0 * t).with_columns(**noise, **columns), {"hall": _truth(t, 0 * t)})
    squares, end = sum((x / 0.05) ** 2 for x in noise.values())[~quarter], "_3d" if axes == 3 else ""
    assert (found[f"n_no_covariance{end}"], found[f"n_zero_covariance{end}"]) == (100, zero)
    inside = (squares <= {2: 5.99146, 3: 7.81473}[axes]).sum()
    assert found[f"coverage_95{end}"] == pytest.approx(inside / (300 + zero))
    assert found[f"nees{end}_ratio"] == pytest.approx(squares.mean() / axes, rel=1e-5)
    (sentence,) = found.statements
    assert sentence.startswith(f"100 of 400 rows are without a covariance, {zero} of them with a zero")


@pytest.mark.parametrize(("z", "expected"), [(0.0, (1.0, 0.0)), (None, (None, None)), (math.nan, (None, None))])
def test_a_known_height_and_a_missing_one_leave_the_horizontal_metrics(z, expected):
    height = pl.Series([z], dtype=pl.Float64)
    tracks = _tracks([0.5], [1.0], z_m=height, std_x_m=[1.0], std_y_m=[1.0], std_z_m=[0.0])
    found = evaluate_table(tracks, {"hall": _truth([0, 1], [0.0, 0.0])})
    assert (found["rmse_m"], found["nees_mean"], found["nees_3d_mean"]) == (1.0, 1.0, None)
    assert (found["rmse_3d_m"], found["bias_z_m"]) == expected


def test_time_lost_and_unscored_rows_add_up_over_tracks():
    lost = _tracks([0.0, 1.0, 4.0], [0.0] * 3, tag="1", status=["ok", "lost", "ok"])
    well = _tracks([0.0, 9.0], [0.0] * 2, tag="2", status=["ok", "ok"])
    rest = _tracks([0.5, 0.6, 1.5, 2.5, 9.5], [0.0] * 5, tag="3", status=["waiting", "ok", "ok", "ok", "ok"])
    truth = [_truth([0.0, 9.0], [0.0, 0.0], tag) for tag in "12"]
    overall = evaluate_table(
        pl.concat([lost, well, rest]), {"hall": pl.concat([*truth, _truth([0.0, 1.0, 3.0], [0.0, 0.0, 5.0], "3")])}
    ).overall
    assert (overall["lost_s"], overall["lost_fraction"]) == (3.0, 3 / 22)
    assert [overall[name] for name in ("n_rows", "n", "n_no_estimate", "n_no_truth", "n_hole")] == [10, 6, 1, 1, 2]


HALF = math.sqrt(0.5)
STATIONS = {
    "hall": {
        "N": Station(np.array([0.0, 5.0, 3.0]), np.array([HALF, HALF, 0.0, 0.0])),
        "S": Station(np.array([0.0, -5.0, 3.0]), np.array([0.0, 0.0, HALF, HALF])),
        "0": Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
    }
}


@pytest.mark.parametrize(("bad", "zero"), [(0.1, 0), (0.0, 2), (math.nan, 0), (math.inf, 0)])
def test_bearings_are_scored_against_the_true_direction_from_their_station(bad, zero):
    frames, t, offset = [], np.array([0.2, 0.8]), np.array([0.05, -0.1])
    for ident in "NS":
        angles = STATIONS["hall"][ident].angles(np.array([[x, 1.0, 1.0] for x in t])) + offset
        values = {"azimuth_rad": np.angle(np.exp(1j * angles[:, 0])), "elevation_rad": angles[:, 1]}
        values |= {"std_azimuth_rad": [bad, 0.1], "std_elevation_rad": 0.2}
        frames.append(pl.DataFrame({"recording": "hall", "tag": "1", "station": ident, "t_s": t, **values}))
    truth = {"hall": _truth([0.0, 1.0], [0.0, 1.0], y_m=[1.0, 1.0], z_m=[1.0, 1.0])}
    found = evaluate_table(pl.concat(frames), truth, STATIONS)
    assert [(f["station"], f["n"]) for f in found.tracks] == [("N", 2), ("S", 2)]
    # Sines and cosines of single angles come and go: some roundings of 1e-16.
    assert (found["rmse_azimuth_rad"], found["bias_elevation_rad"]) == pytest.approx((0.05, -0.1), rel=1e-12)
    assert found["nees_mean"] == pytest.approx(0.25 + 0.25, rel=1e-12)
    assert (found["n_no_covariance"], found["n_zero_covariance"]) == (0 if bad == 0.1 else 2, zero)
    with pytest.raises(UnusableInput, match="station 'N' is not in its rig; found no stations"):
        evaluate_table(pl.concat(frames), truth)


@pytest.mark.parametrize(
    ("place", "azimuth", "elevation", "metric", "expected"),
    [
        # The true azimuth is π − atan(0.01); the estimate lies beyond the cut.
        ((0.01, 0.0, -1.0), 0.01 - math.pi, 0.0, "bias_azimuth_rad", 0.01 + math.atan(0.01)),
        ((0.0, 1.0, 1.0), 0.0, math.pi / 4 + 0.1, "rmse_direction_rad", 0.1),
        # Of directions in the plane of an array the angle alone is judged.
        ((math.cos(0.1), math.sin(0.1), 0.0), math.pi / 2, 0.3, "rmse_direction_rad", 0.2),
        ((math.cos(0.1), math.sin(0.1), 0.0), math.pi / 2, 0.3, "rmse_azimuth_rad", None),
    ],
)
def test_errors_of_angles_are_wrapped_and_those_between_directions_on_the_great_circle(
    place, azimuth, elevation, metric, expected
):
    x, y, z = ([axis, axis] for axis in place)
    row = {"recording": "hall", "tag": "1", "station": "0", "t_s": [0.5], "azimuth_rad": [azimuth]}
    truth = {"hall": _truth([0.0, 1.0], x, y_m=y, z_m=z)}
    found = evaluate_table(pl.DataFrame({**row, "elevation_rad": [elevation]}), truth, STATIONS)[metric]
    assert found == (None if expected is None else pytest.approx(expected, rel=1e-9))


@pytest.mark.parametrize(
    ("tracks", "truth", "words"),
    [
        (_tracks([0.5], [0.0]).drop("tag"), _truth([0.0], [0.0]), "the tracks: no column tag"),
        (_tracks([0.5], [0.0], status=[1]), _truth([0.0], [0.0]), "column status holds numbers"),
        (_tracks([0.5], ["east"]), _truth([0.0], [0.0]), "column x_m holds text"),
        (_tracks([0.5], [0.0]), _truth([0.0], [0.0]).drop("x_m"), "truth of recording 'hall': no column x_m"),
        (_tracks([0.5], [0.0]), _truth([0.0], [0.0]).clear(), "no estimate lies inside a truth"),
        (_tracks([9.0], [0.0]), _truth([0.0], [0.0]), "of tag 1, from 9 to 9 s, truth of 'hall' of tag 1, from 0 to 0"),
        (_tracks(100.0 * np.arange(200), [0.0] * 200), _truth([0.0, 50.0], [0.0, 1.0]), "only 1 of 200 estimates lie"),
    ],
)
def test_tables_that_do_not_fit_are_refused_in_one_line(tracks, truth, words):
    with pytest.raises(UnusableInput, match=words) as caught:
        evaluate_table(tracks, {"hall": truth})
    assert "\n" not in str(caught.value)


NO_CONDITION = r"NAME OPERATOR NUMBER.*names: n, .*rmse_m"


@pytest.mark.parametrize(
    ("expression", "outcome"),
    [
        ("p95_m>0.5", "p95_m>0.5 (p95_m is 1)"),
        ("p95_m > 1", None),
        ("n>10 and rmse_m<1 or max_m<=.1e1", "n>10 and rmse_m<1 or max_m<=.1e1 (n is 1, rmse_m is 1, max_m is 1)"),
        ("(n>10 or rmse_m=1) and max_m>1", None),
        *((text, UnusableInput(NO_CONDITION)) for text in ("", "p95_m", "p95_m>", "p95_m>1 and", "p95_m>'a'", "1>0")),
        *((text, UnusableInput(NO_CONDITION)) for text in ("print('x')>1", "n>1,n>2", "rmse_m=>1")),
        ("p95>1", UnusableInput("no metric 'p95' .did you mean p95_m")),
        ("n>1 and nees_mean>3", UnusableInput("'nees_mean' has no value")),
    ],
)
def test_a_condition_holds_or_does_not_or_is_refused(expression, outcome):
    """Of an evaluation whose horizontal metrics are all 1 m and that has no NEES."""
    found = evaluate_table(_tracks([0.5], [1.0]), {"hall": _truth([0.0, 1.0], [0.0, 0.0])})
    if isinstance(outcome, UnusableInput):
        with pytest.raises(UnusableInput, match=str(outcome)):
            violation(found, expression)
    else:
        assert violation(found, expression) == outcome


def test_recordings_given_as_the_first_argument_are_refused_with_the_order_of_both():
    recording = tw.baselines.fix_recording(np.arange(3.0), np.zeros((3, 3)), truth=np.zeros((3, 3)))
    estimates = tw.baselines.fix_tracker().run(recording)
    for wrong, found in ((estimates, "Estimates"), ([], "nothing"), (3, "int"), ([recording, "a"], "str")):
        with pytest.raises(UnusableInput, match=rf"found {found}; expected recordings .*evaluate\(estimates, rec"):
            evaluate(recording, wrong)


@pytest.mark.slow
def test_recordings_of_one_name_are_told_apart_by_their_place():
    def still(offset, **named):
        place = np.tile([offset, 0.0, 0.0], (20, 1))
        return tw.baselines.fix_recording(0.1 * np.arange(20), place + 0.005, truth=place, **named)

    unnamed, named = [still(0.0), still(5.0)], [still(0.0, name="a"), still(5.0, name="b")]
    tracker = tw.baselines.fix_tracker()
    found, expected = (evaluate(tracker.run(own), own) for own in (unnamed, named))
    assert found["rmse_m"] == expected["rmse_m"] < 0.05
    assert [one["recording"] for one in found.recordings] == ["recording", "recording 2"]
    table = tracker.run(named).to_polars().with_columns(tag=pl.lit(""))
    assert evaluate(table, iter(named))["rmse_m"] == expected["rmse_m"]
    with pytest.raises(UnusableInput, match=r"share a name .recording, recording.*in the same order"):
        evaluate(tracker.run(unnamed), unnamed[:1])
