"""The biases of anchors in range differences: against known ones, a dense likelihood, and in the tracker."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import t as student_t

import trackwright as tw
from tests.tuning.calibration_worlds import ANCHORS, differences
from trackwright.experiments.pages.calibration import report_on
from trackwright.tuning.calibrating import calibrate


def _site(seed, walks=3, **options):
    """Biases that sum to zero, and walks with them."""
    rng = np.random.default_rng(seed)
    biases = 0.1 * rng.normal(size=4)
    biases -= biases.mean()
    return biases, [differences(rng, f"walk {k + 1}", biases, **options) for k in range(walks)]


@pytest.mark.parametrize("outliers", [0.0, 1.5])
def test_intervals_hold_the_biases_although_errors_last(outliers):
    errors = []
    for seed in range(12):
        biases, folders = _site(seed, outliers=outliers)
        found = calibrate(folders).differences
        assert found.anchors == tuple(ANCHORS)
        assert found.biases.sum() == pytest.approx(0.0, abs=1e-12)
        errors.append((found.biases - biases) / np.sqrt(np.diag(found.covariance)))
        # Three walks of a minute; the lasting error of an arrival is 7 cm.
        assert np.sqrt(np.diag(found.covariance)).max() < 0.02
    # The standard error of a share of 36 independent biases is 4 %.
    assert 0.86 < (np.abs(errors) < 1.96).mean() <= 1.0


def test_biases_are_the_most_likely_ones_of_a_dense_likelihood():
    _, (folder,) = _site(3, walks=1, every=0.5)
    found, table = calibrate(folder).differences, folder.tables["tdoa"]
    row = (table["t_s"].to_numpy() / 0.5).round().astype(int)
    place = folder.tables["truth"].select("x_m", "y_m", "z_m").to_numpy()[row]
    ends = [table[name].to_list() for name in ("anchor", "anchor_2")]
    first, second = (np.linalg.norm(place - np.array([ANCHORS[a] for a in of]), axis=1) for of in ends)
    error = table["range_difference_m"].to_numpy() - (first - second)
    x = np.array([[(a == name) - (b == name) for name in ANCHORS] for a, b in zip(*ends, strict=True)], float)

    def unlikely(biases):
        # The square pins the sum, which no difference sees.
        return -student_t.logpdf((error - x @ biases) / found.spread, 4.0).sum() + biases.sum() ** 2

    # The weak prior moves a bias by less than a tenth of its standard error, 1 to 2 cm.
    np.testing.assert_allclose(found.biases, minimize(unlikely, np.zeros(4)).x, atol=1e-3)


@pytest.mark.slow
def test_a_calibration_on_other_walks_makes_tracks_better_and_their_ellipses_hold_the_truth():
    _, folders = _site(4, walks=4)
    plain = folders[-1]
    calibrated = plain.calibrated(calibrate(folders[:-1]))
    scores = [tw.evaluate(tw.build("tdoa", f).run(f), f).overall for f in (plain, calibrated)]
    assert scores[1]["rmse_m"] < 0.8 * scores[0]["rmse_m"]
    assert scores[1]["coverage_95"] > 0.85
    (batch,) = tw.build("tdoa", calibrated).batches(calibrated)
    assert float(batch.tracker.motion.sigma_bias.value) == pytest.approx(
        calibrated.calibration.differences.spread / np.sqrt(2.0)
    )
    assert not batch.tracker.lasting_errors


def test_the_report_counts_the_differences_of_an_anchor_with_both_signs():
    _, folders = _site(5, walks=2)
    calibration = calibrate(folders)
    report = report_on(calibration, folders)
    assert "anchors" not in report.tables
    rows = report.tables["differences"].rows
    assert [row[0] for row in rows] == list(ANCHORS)
    assert [row[2] for row in rows] == [str(count) for count in calibration.differences.rows]
    # Three pairs of A, two of B and D: A, B; A, C; D, A.
    assert calibration.differences.rows == (3600, 2400, 3600, 2400)
    by_name = {source.name: source for source in report.sources}
    measured, left = (by_name["B"].errors(c) for c in (None, calibration))
    biases = dict(zip(calibration.differences.anchors, calibration.differences.biases, strict=True))
    others = np.array([biases[other] for other in by_name["B"].pairs.other])
    np.testing.assert_allclose(measured - left, biases["B"] - others, atol=1e-12)


def test_one_anchor_that_moved_leaves_the_others_calibrated():
    _, folders = _site(6)
    calibration = calibrate(folders)
    elsewhere = {name: place + (name == "B") for name, place in ANCHORS.items()}
    left = calibration.at_rest(tw.Rig("room", anchors=elsewhere))
    assert left.differences.anchors == ("A", "C", "D")
    number, known = np.array([[0, 2], [1, 0], [3, 3]]), calibration.differences
    found, added = left.of_differences(list(ANCHORS), number, np.zeros(3))
    np.testing.assert_allclose(found, [known.biases[2] - known.biases[0], known.biases[0], 0.0], atol=1e-15)
    cov = known.covariance
    np.testing.assert_allclose(added, [cov[0, 0] + cov[2, 2] - 2 * cov[0, 2], cov[0, 0], 0.0], rtol=1e-9, atol=1e-18)
