"""Fastening points: probabilities, unlock decisions, their metrics, and `evaluate --worksteps`."""

import json

import numpy as np
import polars as pl
import pytest

from tests.faulty import good_tables
from tests.in_process import assert_refused, trackwright
from trackwright.experiments.lab.questions.worksteps import MEASURES
from trackwright.experiments.monte_carlo.errors import TrackedRuns
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.worksteps.decisions import (
    NO_POINT,
    FasteningPoints,
    decide,
    nearest_point,
    probabilities,
    visit_numbers,
)
from trackwright.trackers.worksteps.metrics import calibration, score, share, unlock_metrics

HOLES = FasteningPoints(("a", "b", "c"), np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.12, 1.05]]))
P = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 3.0]]) * 1e-3


def _visits(spread, believed, seed=0, visits=4000, rows=3, play=0.01):
    """Scored rows of visits to the holes: errors of covariance `spread`, reported as `believed`, the tip with play."""
    rng = np.random.default_rng(seed)
    here = rng.integers(0, 3, visits)
    tip = np.repeat(HOLES.positions[here] + play * rng.standard_normal((visits, 3)), rows, axis=0)
    means = tip + rng.multivariate_normal(np.zeros(3), spread, len(tip))
    starts = np.arange(0, len(tip), rows)
    return score(means, np.broadcast_to(believed, (len(tip), 3, 3)), tip, starts, HOLES, 0.055, play)


def test_a_points_probability_is_that_of_tips_drawn_from_the_estimate_lying_about_it():
    # The tip is drawn from the estimate's distribution; each draw is weighted by the density of the play about a point.
    rng, mean, play = np.random.default_rng(1), np.array([0.04, 0.05, 1.02]), 0.03
    tips = rng.multivariate_normal(mean, P, 400_000)
    weight = np.array([np.exp(-0.5 * np.sum((tips - c) ** 2, axis=1) / play**2) for c in HOLES.positions])
    drawn = weight.mean(axis=1) / weight.mean(axis=1).sum()
    # The spread of the drawn shares over seeds is 0.0015.
    assert probabilities(mean[None], P[None], HOLES, play)[0] == pytest.approx(drawn, abs=6e-3)


def test_far_from_all_points_probabilities_still_add_up_to_one():
    far = probabilities(np.array([[50.0, 0.0, 1.0]]), 1e-6 * np.eye(3)[None], HOLES, 0.0)
    assert far[0] == pytest.approx([0.0, 1.0, 0.0])


def test_an_estimate_without_covariance_counts_as_exact_and_one_with_nan_unlocks_nothing():
    means = np.array([[0.01, 0.0, 1.0], [np.nan, 0.0, 1.0]])
    d = decide(means, np.full((2, 3, 3), np.nan), HOLES, 0.05, 0.02)
    assert d.point.tolist() == [0, NO_POINT]
    assert d.unlocked.tolist() == [True, False]
    assert np.isnan(d.probability[1])


def test_unlocking_needs_both_the_probability_and_the_tolerance():
    means = np.array([[0.0, 0.0, 1.0], [0.05, 0.0, 1.0], [-0.07, 0.0, 1.0]])
    d = decide(means, np.broadcast_to(1e-4 * np.eye(3), (3, 3, 3)), HOLES, 0.06, 0.0)
    assert d.unlocked.tolist() == [True, False, False]  # at the hole; half-way; certain, but beyond the tolerance


def test_right_covariances_make_95_percent_mean_95_percent():
    scored = _visits(P, P)
    w = unlock_metrics(scored)
    assert w.claimed == pytest.approx(w.named.value, abs=0.01)  # the share's own spread is 0.004
    for b in calibration(scored):
        if b.right.n > 300:
            # 3.3 standard errors of a share for some six bins; tips beyond the tolerance, which aren't scored, are 5e-6.
            assert abs(b.right.value - b.claimed) < 3.3 * np.sqrt(0.25 / b.right.n), b
    assert w.false.value < 0.05


def test_too_small_covariances_give_overconfident_probabilities():
    w = unlock_metrics(_visits(P, P / 9))
    assert w.claimed > w.named.value + 0.1
    assert w.false.high > w.false.value > 0.05


def test_right_wrong_and_missed_add_up_to_all_rows_at_a_point():
    w = unlock_metrics(_visits(P, P))
    assert w.right.value + w.wrong.value + w.missed.value == pytest.approx(1.0)
    assert w.right.n == 12_000
    assert w.visits_right.n == 4000


def test_the_default_tolerance_is_half_the_least_distance_between_two_points():
    # a and b are 10 cm apart, a and c 13 cm.
    assert HOLES.tolerance() == pytest.approx(0.05)


def test_a_tip_is_at_the_nearest_point_within_the_tolerance_and_visits_are_rows_in_a_row():
    truth = np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0], [0.06, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.0, 1.0]])
    at = nearest_point(truth, HOLES, 0.05)
    assert at.tolist() == [0, 0, 1, NO_POINT, 0]
    assert visit_numbers(np.array([0, 0, 1, 1, 1, 0]), np.array([0, 3])).tolist() == [1, 1, 2, 3, 3, 4]


def test_wilsons_interval_of_independent_rows_is_the_textbooks():
    hits = np.arange(100) < 10
    found = share(hits, np.arange(100))
    # Wilson 1927: 10 of 100. The design effect of clusters of one is n / (n - 1).
    assert (found.low, found.high) == pytest.approx((0.0552, 0.1744), abs=5e-4)


def test_intervals_of_rows_that_agree_within_visits_hold_the_truth_as_often_as_they_say():
    rng, hits = np.random.default_rng(0), 0
    for _ in range(600):
        each = rng.beta(0.5 * 1.5, 0.5 * 1.5, 60)
        cluster = np.repeat(np.arange(60), rng.integers(1, 20, 60))
        found = share(rng.random(len(cluster)) < each[cluster], cluster)
        hits += found.low <= 0.5 <= found.high
    assert 0.92 < hits / 600 < 0.98  # 3 standard errors of 600 repeats are 0.027


def test_no_rows_have_no_share():
    assert np.isnan(share(np.zeros(0, bool), np.zeros(0)).value)


def test_the_studys_measures_count_rows_at_rest_alone():
    # Two trajectories of four rows: moving, at rest and unlocked, at rest with a large covariance, at rest elsewhere.
    truth = np.array([[0.03, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    seen = np.array([[0.03, 0.0, 0.0], [0.01, 0.0, 0.0], [0.04, 0.0, 0.0], [0.0, 0.0, 0.0]])
    spread = np.array([1e-4, 1e-4, 1.0, 1e-4])[:, None, None] * np.eye(3)
    table = pl.DataFrame({"name": ["a", "b"], "x_m": [0.0, 0.1], "y_m": [0.0, 0.0], "z_m": [0.0, 0.0]})
    twice = [np.stack([x, x]) for x in (np.array([1.0, 2.0, 3.0, 4.0]), seen, spread, truth)]
    known, status = np.array([[True] * 4, [False] * 4]), np.zeros((2, 4), int)
    folder = RecordingFolder("bench", None, Rig("bench"), {"points": table})
    tracked = TrackedRuns(*twice, known, status, np.zeros((2, 4)), np.zeros((2, 4)), folder)
    found = {name: measure(tracked) for name, measure in MEASURES.items()}
    third = 1 / 3
    assert found["named_right"] == pytest.approx([2 * third, np.nan], nan_ok=True)
    assert [found[k][0] for k in ("released_right", "released_wrong", "missed")] == pytest.approx([third] * 3)


# the command line


@pytest.fixture
def tracked(beginnings, tmp_path):
    """Tracks with a covariance 1 cm off the truth, and a table of points on the way of one tag."""
    truth = good_tables()["truth"]
    tracks = truth.select(
        recording=pl.lit("good"), tag="tag", t_s="t_s", x_m=pl.col("x_m") + 0.01, y_m="y_m", z_m="z_m",
        std_x_m=pl.lit(0.02), std_y_m=pl.lit(0.02), std_z_m=pl.lit(0.02), status=pl.lit("ok"),
    )  # fmt: skip
    tracks.write_parquet(tmp_path / "tracks.parquet")
    (tmp_path / "recordings.txt").write_text(f"{beginnings / 'good'}\n")
    (tmp_path / "points.csv").write_text("name,x_m,y_m\nstart,3.0,2.0\nright,4.0,2.0\nfar,9.0,9.0\n")
    return tmp_path


def test_evaluate_prints_right_and_wrong_unlock_decisions(tracked):
    said = trackwright("evaluate", tracked, "--worksteps", tracked / "points.csv", "--tolerance", 0.2)
    assert said.code == 0, said
    assert "Unlock decisions" in said.out
    assert "The tool was never at 1 of the 3 points." in said.out
    found = json.loads((tracked / "evaluation.json").read_text())
    assert found["worksteps"]["overall"]["right"]["value"] > 0.7
    assert found["overall"]["work_wrong"] == 0.0
    assert found["recordings"][0]["work_right"] == found["overall"]["work_right"]


def test_the_text_says_where_covariances_are_too_large_or_too_small(tracked):
    # A hundred points on the way, 5 cm apart: with 2 m of spread none is likely, yet the nearest is the right one.
    (tracked / "dense.csv").write_text(
        "name,x_m,y_m\n"
        + "".join(f"p{k},{2 + np.cos(a):.6f},{2 + np.sin(a):.6f}\n" for k, a in enumerate(np.arange(0, 5, 0.05)))
    )
    tracks = pl.read_parquet(tracked / "tracks.parquet")
    for spread, shift, words in ((2.0, 0.0, "covariances are too large"), (1e-4, 0.06, "covariances are too small")):
        told = tracks.with_columns(
            pl.lit(spread).alias("std_x_m"), pl.lit(spread).alias("std_y_m"), x_m=pl.col("x_m") + shift
        )
        told.write_parquet(tracked / "tracks.parquet")
        assert words in trackwright("evaluate", tracked, "--worksteps", tracked / "dense.csv", "--tolerance", 0.01).out


def test_a_pipeline_can_stop_on_missed_unlock_decisions(tracked):
    said = trackwright(
        "evaluate", tracked, "--worksteps", tracked / "points.csv", "--tolerance", 0.2, "--fail-if", "work_missed > 0.9"
    )
    assert said.code == 0
    points = tracked / "points.csv"
    said = trackwright("evaluate", tracked, "--worksteps", points, "--tolerance", 0.2, "--fail-if", "work_right > 0")
    assert said.code == 1


def test_the_last_estimate_of_every_interval_can_be_scored_alone(tracked):
    given = ("evaluate", tracked, "--worksteps", tracked / "points.csv", "--tolerance", 0.2, "--json")
    whole, thinned = (json.loads(trackwright(*given, *more).out)["worksteps"] for more in ((), ("--every", 0.2)))
    assert 0 < thinned["overall"]["right"]["n"] < whole["overall"]["right"]["n"]


BAD_POINTS = {
    "columns": ("name,x,y\na,1,2\n", "no column x_m"),
    "unknown column": ("name,x_m,y_m,z\na,3,2,1\n", "unknown column 'z'"),
    "duplicate name": ("name,x_m,y_m\na,3,2\nb,4,2\na,5,2\n", "duplicate of row 1"),
    "same position": ("name,x_m,y_m\na,3,2\nb,3,2\n", "have the same position"),
    "no name": ("name,x_m,y_m\n,3,2\n", "expected a name"),
    "infinite": ("name,x_m,y_m\na,inf,2\nb,4,2\n", "'inf', expected a finite number"),
    "empty cell": ("name,x_m,y_m\na,3,\nb,4,2\n", "empty, expected a finite number"),
    "text": ("name,x_m,y_m\na,3,two\nb,4,2\n", "'two', expected a finite number"),
    "no rows": ("name,x_m,y_m\n", "no rows"),
    "nothing near": ("name,x_m,y_m\na,3000,2000\nb,4000,2000\n", "check units and origin"),
    "one point": ("name,x_m,y_m\na,3,2\n", "expected a tolerance in metres; give one"),
}


@pytest.mark.parametrize("name", BAD_POINTS)
def test_points_that_cannot_be_used_are_refused_in_one_line(tracked, name):
    text, words = BAD_POINTS[name]
    (tracked / "bad.csv").write_text(text)
    given = ("--tolerance", 0.1) if name == "nothing near" else ()
    assert_refused(trackwright("evaluate", tracked, "--worksteps", tracked / "bad.csv", *given), words)
    assert not (tracked / "evaluation.json").exists()


def test_a_missing_file_and_a_senseless_tolerance_are_refused(tracked):
    assert_refused(trackwright("evaluate", tracked, "--worksteps", tracked / "none.csv"), "no such file")
    for tolerance in (0, -1, "nan"):
        said = trackwright("evaluate", tracked, "--worksteps", tracked / "points.csv", "--tolerance", tolerance)
        assert_refused(said, "expected a number of metres above 0")
    assert_refused(trackwright("evaluate", tracked, "--tolerance", 0.1), "--worksteps")
