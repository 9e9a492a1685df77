"""Sentences on reported covariances: on tracks with known errors, and on innovations alone."""

import numpy as np
import polars as pl
import pytest

from tests.trackers.evaluation.tables import evaluate_table
from trackwright.trackers.evaluation.evaluate import Evaluation, verdict
from trackwright.trackers.evaluation.rows import scored_rows

N = 4000


def _lasting(seconds, seed=1):
    """Unit normal errors (N, 2) at 20 Hz that last."""
    x, a = np.random.default_rng(seed).normal(size=(N, 2)), np.exp(-0.05 / seconds)
    for k in range(1, N):
        x[k] = a * x[k - 1] + np.sqrt(1 - a * a) * x[k]
    return x


def _tracks(errors, recording="hall", nis=None, **columns):
    """Tracks of N rows at 20 Hz with these errors in units of the reported 0.1 m, with their truth."""
    rng, t = np.random.default_rng(1), 0.05 * np.arange(N)
    x, y = 0.1 * errors.T
    base = {"recording": recording, "tag": "1", "t_s": t, "x_m": t + x, "y_m": y, "z_m": 0 * t + 1}
    base |= {"std_x_m": 0 * t + 0.1, "std_y_m": 0 * t + 0.1, "std_z_m": 0 * t}
    base |= {"nis": rng.chisquare(2, N) if nis is None else nis, "nis_dof": 0 * t + 2}
    truth = pl.DataFrame({"t_s": t, "tag": "1", "x_m": t, "y_m": 0 * t, "z_m": 0 * t + 1})
    return pl.DataFrame(base | columns), truth


@pytest.mark.parametrize(
    ("factor", "seconds", "words"),
    [
        (1.0, 0.001, "are as those of a perfect filter: NEES/dof "),
        (2.3, 0.001, "are 2.3 times too small: NEES/dof 5.2"),
        (1000.0, 0.001, "are 1,000 times too small: NEES/dof 9"),
        (1 / 3, 0.001, "are 3 times too large: NEES/dof 0.11"),
        (0.0, 0.001, "are inf times too large: NEES/dof 0, band 0.9"),
        (1.0, 2.0, "are as those of a perfect filter: NEES/dof "),
        (1.0, 400.0, "are not judged, the recording is too short: NEES/dof "),
    ],
)
def test_the_factor_of_the_standard_deviations_is_found_and_the_band_allows_for_errors_that_last(
    factor, seconds, words
):
    tracks, truth = _tracks(factor * _lasting(seconds))
    (sentence,) = evaluate_table(tracks, {"hall": truth}).statements
    assert sentence.startswith(f"Reported standard deviations {words}")
    assert ("regret" in sentence) == (factor > 0)


def test_a_recording_outside_its_band_is_named():
    (good, truth), (bad, _) = _tracks(_lasting(0.001)), _tracks(2 * _lasting(0.001, 2), "yard")
    many = pl.concat([good.with_columns(tag=pl.lit(f"{k}")) for k in range(9)])
    truths = {"hall": pl.concat([truth.with_columns(tag=pl.lit(f"{k}")) for k in range(9)]), "yard": truth}
    overall, named = evaluate_table(pl.concat([many, bad]), truths).statements
    assert " 1.1 times too small: NEES/dof 1.29, band 0.99 to 1.01 (40,000 effective samples)" in overall
    assert named == "Outside their band: 1 of 2 recordings, yard (2 times too small)."


@pytest.mark.parametrize(
    ("scale", "repeats", "words"),
    [
        (1.0, 1, "as those of a perfect filter: NIS/dof "),
        (3.0, 1, "1.7 times too small: NIS/dof "),
        (0.1, 1, "3.2 times too large: NIS/dof 0.09"),
        (1.0, 40, "as those of a perfect filter"),
        (1.0, 800, "not judged, the recording is too short"),
    ],
)
def test_without_truth_the_innovations_are_judged(scale, repeats, words):
    nis = scale * np.repeat(np.random.default_rng(3).chisquare(2, N // repeats), repeats)
    tracks, _ = _tracks(_lasting(0.001), nis=nis)
    (sentence,) = Evaluation.of(scored_rows(tracks, {})).statements
    assert sentence.startswith(f"Standard deviations of the innovations are {words}")


def test_the_bands_hold_a_perfect_filter_in_95_of_100_tracks():
    rng, rows, tags = np.random.default_rng(4), 300, 300
    root = np.linalg.cholesky([[0.04, 0.03, 0.01], [0.03, 0.09, 0.02], [0.01, 0.02, 0.25]])
    errors = rng.normal(size=(tags, rows, 3))
    for k in range(1, rows):
        errors[:, k] = 0.8 * errors[:, k - 1] + 0.6 * errors[:, k]
    errors, dof = (errors @ root.T).reshape(-1, 3), rng.integers(1, 5, tags * rows)
    keys = {"recording": "hall", "tag": np.repeat([f"{k:03}" for k in range(tags)], rows)}
    keys["t_s"] = np.tile(0.1 * np.arange(rows), tags)
    place = {f"{a}_m": x for a, x in zip("xyz", errors.T, strict=True)}
    P = root @ root.T
    stds = {f"std_{a}_m": np.full(len(errors), np.sqrt(P[k, k])) for k, a in enumerate("xyz")}
    covs = {f"cov_{'xyz'[i]}{'xyz'[j]}_m2": np.full(len(errors), P[i, j]) for i, j in ((0, 1), (0, 2), (1, 2))}
    nis = {"nis": rng.chisquare(dof), "nis_dof": dof.astype(float)}
    truth = pl.DataFrame({"t_s": keys["t_s"], "tag": keys["tag"]} | {name: 0 * x for name, x in place.items()})
    found = evaluate_table(pl.DataFrame(keys | place | stds | covs | nis), {"hall": truth})
    for name in ("nees", "nees_3d", "nis"):
        verdicts = [verdict(track, name) for track in found.tracks]
        assert 0.92 <= verdicts.count("hold") / tags <= 0.98
        assert verdict(found.overall, name) == "hold"


def test_a_lag_is_told_where_a_bias_does_not_do_as_well():
    t = 0.05 * np.arange(N)
    truth = pl.DataFrame({"t_s": t, "tag": "1", "x_m": 3 * np.cos(0.4 * t), "y_m": 3 * np.sin(0.4 * t)})
    late = truth.with_columns(pl.lit("hall").alias("recording"), pl.col("t_s") + 0.3)
    (said,) = evaluate_table(late, {"hall": truth}).statements
    assert said.startswith("Estimates are 0.3 s late along the true path, without which RMSE is 0.0")
    biased, straight = _tracks(np.tile([3.0, 0.0], (N, 1)))
    assert not any("true path" in one for one in evaluate_table(biased, {"hall": straight}).statements)


def test_losses_speak_where_the_innovations_are_as_expected():
    status = np.where(np.arange(N) % 400 == 399, "lost", "ok").astype(object)
    status[400::400] = "restarted"
    tracks, truth = _tracks(_lasting(0.001), status=status)
    evaluation = Evaluation.of(scored_rows(tracks, {}))
    # Nine losses with a start after them, and the last at the end of the rows.
    assert (evaluation.overall["losses"], evaluation.overall["lost_s"]) == (10, pytest.approx(9 * 0.05))
    first, _ = evaluation.statements
    assert first.startswith("Tracks were lost 10 times, for 0.45 s in all. ")
    assert evaluate_table(tracks, {"hall": truth}).statements[0] == first
