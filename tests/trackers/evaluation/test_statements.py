"""Sentences on reported covariances: on tracks with known errors, and on innovations alone."""

import numpy as np
import polars as pl
import pytest

from tests.trackers.evaluation.tables import evaluate_table
from trackwright.trackers.evaluation.association import associate_truth
from trackwright.trackers.evaluation.evaluate import evaluate_association
from trackwright.trackers.evaluation.statements import covariance_statements, holds

N = 4000


def _tracks(factor=1.0, recording="hall", seed=1, tails=None, nis=None, **columns):
    """Tracks of N rows at 20 Hz whose errors are `factor` times the reported 0.1 m, with their truth."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(N)
    e = 0.1 * factor * (rng.normal(size=(N, 2)) if tails is None else rng.standard_t(tails, size=(N, 2)))
    base = {"recording": recording, "tag": "1", "t_s": t, "x_m": t + e[:, 0], "y_m": e[:, 1], "z_m": 0 * t + 1}
    base |= {"std_x_m": 0 * t + 0.1, "std_y_m": 0 * t + 0.1, "std_z_m": 0 * t}
    base |= {"nis": rng.chisquare(2, N) if nis is None else nis, "nis_dof": 0 * t + 2}
    truth = pl.DataFrame({"t_s": t, "tag": "1", "x_m": t, "y_m": 0 * t, "z_m": 0 * t + 1})
    return pl.DataFrame(base | columns), truth


def _statements(tracks, truth):
    return evaluate_table(tracks, {"hall": truth}).statements


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (
            1.0,
            "Reported covariances hold: the 95 % ellipse holds the truth in 95 % of the rows (limits 88 to 99 %), NEES",
        ),
        (2.3, "Reported standard deviations are 2.3 times too small: the 95 % ellipse holds the truth in"),
        (1000.0, "Reported standard deviations are 1,000 times too small: the 95 % ellipse holds the truth in"),
        (1 / 3, "Reported standard deviations are 3 times too large: the 95 % ellipse holds the truth in 100 %"),
        (0.0, "Reported standard deviations are over 1000 times too large: the 95 % ellipse holds the truth in 100 %"),
    ],
)
def test_the_factor_of_the_standard_deviations_is_found(factor, words):
    (sentence,) = _statements(*_tracks(factor))
    assert sentence.startswith(words)
    assert "e+" not in sentence


def test_the_factor_is_that_of_the_median_whatever_the_largest_errors():
    tracks, truth = _tracks(2.3)
    spoilt = tracks.with_columns(x_m=pl.when(pl.int_range(N) % 50 == 0).then(1e6).otherwise("x_m"))
    # 2 % of gross errors move the median of chi-square by 3 %.
    assert evaluate_table(spoilt, {"hall": truth})["sigma_factor"] == pytest.approx(2.3, rel=0.05)


def test_a_recording_that_does_not_hold_is_named_although_all_rows_together_do():
    good, truth = _tracks(1.0)
    bad, _ = _tracks(2.0, "yard", seed=2)
    many = pl.concat([good.with_columns(tag=pl.lit(f"{k}")) for k in range(9)])
    truths = {"hall": pl.concat([truth.with_columns(tag=pl.lit(f"{k}")) for k in range(9)]), "yard": truth}
    evaluation = evaluate_table(pl.concat([many, bad]), truths)
    (sentence,) = evaluation.statements
    assert sentence.startswith("Reported covariances do not hold in 1 of 2 recordings: yard (5")
    assert "In all rows the 95 % ellipse holds the truth in 9" in sentence


def test_correlated_innovations_are_named_besides_the_errors():
    nis = np.repeat(np.random.default_rng(1).chisquare(2, N // 40), 40)  # each for 2 s
    tracks, truth = _tracks(2.0, nis=nis)
    evaluation = evaluate_table(tracks, {"hall": truth})
    sentence = evaluation.statements[-1]
    assert sentence.startswith("NIS is correlated over 1 s (0.4")
    assert sentence.endswith(" rows carry the information of one): errors last longer than the model assumes.")
    for inflation in (0.98, 1.04, None):
        one = evaluation.recordings[0] | {"nis_inflation_1s": inflation}
        last = covariance_statements(evaluation.overall, [one])[-1]
        assert last.startswith("NIS is correlated over 1 s (0.4")
        assert "): errors last longer" in last
        assert "rows" not in last


@pytest.mark.parametrize(
    ("scale", "repeats", "words"),
    [
        (1.0, 1, "The innovations are as the tracker's model expects (NIS/dof "),
        (3.0, 1, "The readings scatter more than the tracker's model expects (NIS/dof 3, 1 expected, "),
        (0.1, 1, "The readings scatter less than the tracker's model expects (NIS/dof 0.099, 1 expected, "),
        (1.0, 40, "Innovations are correlated over 1 s (0.4"),
        (1.0, 16, "Innovations are correlated within 1 s ("),  # of 0.8 s: the correlation over 1 s is small
    ],
)
def test_without_truth_the_innovations_are_judged(scale, repeats, words):
    nis = scale * np.repeat(np.random.default_rng(3).chisquare(2, N // repeats), repeats)
    tracks, _ = _tracks(nis=nis)
    (sentence,) = evaluate_association(associate_truth(tracks, {})).statements
    assert sentence.startswith(words)


@pytest.mark.parametrize(
    ("share", "ratio", "hold"),
    [(0.8751, 1.4049, True), (0.8749, 1.0, False), (0.95, 1.4051, False), (0.9904, 1.0, True), (0.9906, 0.665, False)],
)
def test_the_verdict_is_that_of_the_figures_as_they_are_printed(share, ratio, hold):
    assert holds({"coverage_95": share, "nees_ratio": ratio}) == hold


def test_losses_speak_where_the_innovations_are_as_expected():
    status = np.where(np.arange(N) % 400 == 399, "lost", "ok").astype(object)
    status[400::400] = "restarted"
    tracks, truth = _tracks(nis=np.random.default_rng(3).chisquare(2, N), status=status)
    evaluation = evaluate_association(associate_truth(tracks, {}))
    # Nine losses with a start after them, and the last at the end of the rows.
    assert (evaluation.overall["losses"], evaluation.overall["lost_s"]) == (10, pytest.approx(9 * 0.05))
    (first,) = evaluation.statements
    assert first.startswith("Tracks were lost 10 times, for 0.45 s in all. ")
    assert evaluate_table(tracks, {"hall": truth}).statements[0] == first
    # What is left of a track that starts again in every fifth row has no covariances to judge.
    again = tracks.with_columns(status=pl.when(pl.int_range(N) % 5 == 0).then(pl.lit("restarted")).otherwise("status"))
    (alone,) = evaluate_table(again, {"hall": truth}).statements
    assert alone.startswith("Tracks were lost 8")
    assert alone.endswith(" With a suitable model a track is lost only where readings are missing.")
