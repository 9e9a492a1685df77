"""Objectives by name: weights, sums of several, and texts that are none."""

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.tuning.named_objectives import all_metrics, parse_objective
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError, StateLogLikelihood, Weighted

SUMS = np.array([12.0, 3.0])
"""A mean of 4, a root mean square of 2."""


def test_a_name_alone_is_its_objective():
    assert parse_objective("nll") == NegativeLogLikelihood()
    assert parse_objective(" 1*rmse ", "position", 3) == RootMeanSquareError("position", 3)
    assert parse_objective("state-nll", "direction", 2) == StateLogLikelihood("direction", 2)


@pytest.mark.parametrize(
    ("text", "value"), [("2*nll", 8.0), ("0.5 * rmse", 1.0), ("1e1*rmse", 20.0), ("1*nll", 4.0), ("rmse", 2.0)]
)
def test_a_weight_multiplies_the_objective(text, value):
    assert float(parse_objective(text).value(SUMS)) == pytest.approx(value)


def test_a_sum_adds_its_parts_in_the_order_of_the_text():
    objective = parse_objective("0.25*rmse + 3*nll", dimensions=1)
    assert objective == Weighted((RootMeanSquareError("position", 1), NegativeLogLikelihood()), (0.25, 3.0))
    assert float(objective.value(np.array([12.0, 3.0, 10.0, 4.0]))) == pytest.approx(0.25 * 2.0 + 3 * 2.5)
    # A likelihood in another unit is one still; a sum of two objectives is none.
    assert parse_objective("2*nll").nats_per_unit(np.array([5.0, 6.0])) == pytest.approx(3.0)
    assert not objective.is_likelihood


@pytest.mark.parametrize("text", ["", "nll+", "nll+nll", "2nll", "mse", "nll rmse", "1.2.3*nll", "0*nll", "nll+-rmse"])
def test_texts_that_name_no_objective_are_refused(text):
    with pytest.raises(ValueError):
        parse_objective(text)


def test_a_tag_whose_true_place_is_the_origin_has_an_error():
    (walk,) = walks([8], 1)
    walk.truth["position"] = np.zeros((8, 1)), np.ones(8, bool)
    tracker, batch = line_tracker(), stack([walk])
    places = np.asarray(tracker.run(batch).mean.position[0])
    assert all_metrics(tracker, batch, dimensions=1)["rmse"] == pytest.approx(np.sqrt(np.mean(places**2)), rel=1e-6)
