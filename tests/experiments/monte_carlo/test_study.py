from functools import partial

import numpy as np
import polars as pl
import pytest

from tests.experiments.monte_carlo.small_study import SMALL, TOML
from trackwright.experiments.monte_carlo.results import Results, Totals
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.monte_carlo.scores import Scores, arrays_of, cells, sums
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.experiments.pages.study import to_text
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import METRICS
from trackwright.trackers.evaluation.rows import scored_rows


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return folder, run_study(SMALL, folder)


def _normal_tracked(seed, n=7, rows=50):
    """Random errors and covariances of tracks, as `sums` takes them, and these errors (n, rows, 3)."""
    rng = np.random.default_rng(seed)
    truth, scale = rng.normal(size=(n, rows, 3)), np.exp(rng.normal(size=(n, 1, 1)))
    errors, known = 0.3 * scale * rng.normal(size=(n, rows, 3)), rng.uniform(size=(n, rows)) > 0.2
    entries = {(i, j): np.full((n, rows), 0.09 * (i == j)) for i in range(3) for j in range(i, 3)}
    status = np.where(rng.uniform(size=(n, rows)) < 0.01, Status.LOST, Status.OK)
    steps = status, rng.chisquare(2, (n, rows)), np.full((n, rows), 2.0)
    return (truth + errors, truth, entries, known, steps), errors


def _summed(estimates, truth, entries, known, steps):
    """The arrays of a chunk's program for these estimates."""
    n = len(known)
    found, sizes = sums(estimates, truth, entries, known | True, known, steps, partial(np.sum, axis=1, dtype=float))
    of_rows = {kind: cells(size, np.arange(n)[:, None], n) for kind, size in sizes.items()}
    return arrays_of([Scores(found, {kind: size.max(axis=1) for kind, size in sizes.items()}, of_rows)], n)


def _results_of(kept, runs, study=SMALL):
    totals = Totals(runs)
    totals.add(0, kept)
    return Results(study, {(0, "kalman"): totals})


def _as_tables(estimates, truth, _, known, steps):
    """The same as a table of estimates and one of truth."""
    n, rows = known.shape
    keys = {"tag": np.repeat([f"{k:03}" for k in range(n)], rows), "t_s": np.tile(np.arange(rows), n)}
    table = {f"{a}_m": np.where(known, estimates[..., k], np.nan).ravel() for k, a in enumerate("xyz")}
    table |= {f"std_{a}_m": np.full(n * rows, 0.3) for a in "xyz"} | {"nis": steps[1].ravel()}
    table |= {"nis_dof": steps[2].ravel(), "status": np.where(steps[0].ravel() == Status.LOST, "lost", "ok")}
    true = {f"{a}_m": truth[..., k].ravel() for k, a in enumerate("xyz")}
    return pl.DataFrame(keys | table).with_columns(recording=pl.lit("")), pl.DataFrame(keys | true)


def test_the_metrics_of_a_study_are_those_of_evaluate_on_the_same_trajectories():
    tracked, _ = _normal_tracked(3)
    found, status = _results_of(_summed(*tracked), 7), tracked[-1][0]
    tracks, truth = _as_tables(*tracked)
    expected = Evaluation.of(scored_rows(tracks, {"": truth})).overall
    value = {name: found.at(name, SMALL.conditions[0], "kalman").value for name in METRICS}
    value = {name: x for name, x in value.items() if np.isfinite(x)}
    percentiles = {name for name in value if name.startswith(("median", "p90", "p95", "p99"))}
    assert len(value) >= 40
    # A study counts rows lost, and its bins are 2 % wide: with 280 rows order statistics lie up to some percent apart.
    for name in value.keys() - percentiles - {"lost_fraction", "diverged", "failed"}:
        assert value[name] == pytest.approx(expected[name], rel=1e-9), name
    for name in percentiles:
        assert value[name] == pytest.approx(expected[name], rel=0.05), name
    assert value["lost_fraction"] == np.mean(status == Status.LOST)
    assert value["diverged"] == np.mean((status == Status.LOST).any(axis=1))


def test_of_directions_in_the_plane_of_an_array_the_angle_alone_is_judged():
    (*_, known, steps), errors = _normal_tracked(4)
    errors = 0.1 * errors
    azimuth = np.where(np.arange(50) == 5, np.pi / 2, 0.3 + errors[..., 0])
    estimates = np.stack([azimuth, 0.2 + errors[..., 1]], axis=-1)
    entries = {(i, j): np.full(known.shape, 0.09 * (i == j)) for i, j in ((0, 0), (0, 1), (1, 1))}
    kept = _summed(estimates, np.broadcast_to([0.3, 0.2], estimates.shape), entries, known, steps)
    judged = known & (np.arange(50) != 5)
    assert kept["sum n direction_rad"].sum() == known.sum()
    for k, angle in enumerate(("azimuth_rad", "elevation_rad")):
        np.testing.assert_array_equal(kept[f"sum n {angle}"], judged.sum(axis=1))
        np.testing.assert_allclose(kept[f"sum bias {angle}"], np.where(judged, errors[..., k], 0.0).sum(axis=1))


def _accumulated(sizes, histogram):
    """Accumulators of errors (n, T)."""
    n = np.full(len(sizes), float(sizes.shape[1]))
    found = {"n": n, "n m": n, "sum m": sizes.sum(axis=1), "squares m": (sizes**2).sum(axis=1)}
    of_rows = {"m": cells(sizes, np.arange(len(sizes))[:, None], len(sizes))} if histogram else {}
    kept = arrays_of([Scores(found, {"m": sizes.max(axis=1)} if histogram else {}, of_rows)], len(sizes))
    return kept | {"largest m": sizes.max(axis=1)}


def _coverage(metric, true, rng, repeats=1000, n=200, rows=20):
    """How often the interval holds the truth: Rayleigh errors whose scale differs from trajectory to trajectory."""
    inside = 0
    for _ in range(repeats):
        scale = np.exp(0.3 * rng.normal(size=(n, 1, 1)))
        sizes = np.linalg.norm(scale * rng.normal(size=(n, rows, 2)), axis=-1)
        value = _results_of(_accumulated(sizes, metric != "rmse_m"), n).at(metric, SMALL.conditions[0], "kalman")
        inside += value.low <= true <= value.high
    return inside / repeats


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["rmse_m", "median_m"])
def test_95_percent_intervals_hold_the_true_metric_in_93_to_97_percent_of_1000_repeats(metric):
    rng = np.random.default_rng(12)
    # The mean square is 2 E[s²] = 2 exp(2·0.3²); the median has no such form.
    true = np.sqrt(2 * np.exp(2 * 0.3**2))
    if metric == "median_m":
        draws = rng.normal(size=(4_000_000, 2)) * np.exp(0.3 * rng.normal(size=(4_000_000, 1)))
        true = np.median(np.linalg.norm(draws, axis=1))
    assert 0.93 <= _coverage(metric, true, rng) <= 0.97


def test_a_paired_difference_has_a_narrower_interval_than_an_unpaired_one(whole):
    results = whole[1]
    difference = results.difference("rmse_m", "constant", "stiffer", "kalman")
    parts = [results.value("rmse_m", "constant", t) for t in ("kalman", "stiffer")]
    assert difference.value == pytest.approx(parts[1].value - parts[0].value)
    unpaired = np.hypot(*(p.high - p.low for p in parts))
    assert difference.high - difference.low < unpaired


def test_every_condition_and_tracker_has_its_metrics(whole):
    text = to_text(whole[1], [])
    assert "RMSE" in text
    assert "last" in text
    for metric in ("rmse_m", "last_m"):
        for condition in SMALL.conditions:
            value = whole[1].at(metric, condition, "kalman")
            assert value.low <= value.value <= value.high
    assert len(whole[1].numbers("last_m", "halts", "window")) == SMALL.runs
    # A moving average has no model and hence no bound.
    assert np.isnan(whole[1].value("bound_m", "halts", "window").value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("fix-kf", "fix-kg"), "fix-kg"),
        (('metrics = ["rmse_m"]', 'metrics = ["rmse_m"]\n[grid]\n"world.rate_hz" = []'), "is empty"),
        (("[trackers.fix-kf]", "[trackers.fix-kf]\ntunables = {'motion.sigma_a' = -1.0}"), "found -1.0"),
        (('metrics = ["rmse_m"', 'metrics = ["rmse"'), "no metric 'rmse' (did you mean rmse_m?); names: "),
        (('metrics = ["rmse_m"', 'metrics = [5, "rmse_m"'), "no metric 5; names: "),
        (("rate_hz = 1.0", "rate = 1.0"), "parameter 'rate' is unknown; expected one of situation, speed, rate_hz"),
        (("rate_hz = 1.0", "rate_hz = 0.0"), "rate_hz = 0.0: expected a number from 0.1 to 1000"),
        (("[worlds.line]", "[grid]\n'motion.sigma_q' = [1.0]\n[worlds.line]"), "motion.sigma_q"),
    ],
)
def test_a_study_that_cannot_be_run_is_refused_in_one_line(tmp_path, change, message):
    file = tmp_path / "study.toml"
    file.write_text(TOML.replace(*change))
    with pytest.raises(UnusableInput) as refused:
        run_study(load_study(str(file)), tmp_path / "out")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    # Nothing is written before the refusal: a corrected study may use the same folder.
    assert not (tmp_path / "out").exists()
