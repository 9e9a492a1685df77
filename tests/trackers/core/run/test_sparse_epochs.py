"""Epochs that are rarer than the time after which a track is lost."""

import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.core.data.estimates import is_usable

ANCHORS = np.array([[0, 0, 2.6], [10, 0, 2.4], [10, 8, 2.7], [0, 8, 1.0]])


@pytest.mark.filterwarnings("ignore:range_recording. times")
def test_a_day_of_epochs_every_216_s_has_an_estimate_in_every_row_and_errors_as_reported():
    times, rng = np.arange(400) * 216.0, np.random.default_rng(1)
    truth = np.stack([5 + 3 * np.sin(0.25 * times), 4 + 2 * np.cos(0.25 * times), np.full(400, 1.2)], axis=1)
    ranges = np.linalg.norm(truth[:, None] - ANCHORS, axis=2) + rng.normal(0, 0.05, (400, 4))
    estimates = tw.range_tracker(4).run(tw.range_recording(times, ranges, ANCHORS))
    assert is_usable(estimates.status)[4:].all()
    errors = np.stack(list(estimates.mean.position), axis=-1) - np.repeat(truth, 4, axis=0)
    last = errors[7::4]
    assert np.sqrt((last[:, :2] ** 2).sum(axis=1).mean()) < 0.15
    P = estimates.marginal("position")
    distance = np.einsum("ni,nij,nj->n", errors[4:], np.linalg.inv(P[4:]), errors[4:])
    assert np.quantile(distance, 0.99) < 16.3
